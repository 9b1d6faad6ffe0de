# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Simulated time that advances from one timer to the next."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import rclpy
from rclpy.executors import ExternalShutdownException

from diffdrive_jacobian.lockstep._clock import MAX_SECONDS
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._guard import Guard, Stuck
from diffdrive_jacobian.lockstep._pause import Pauses
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.numerics.checks import between
from diffdrive_jacobian.ros.rclpy_internals import RCLError
from diffdrive_jacobian.time_units import NANOSECONDS

__tracebackhide__ = True

T = TypeVar('T')
SHUT_DOWN = 'rclpy was shut down: only lockstep may do that'


class Process(Protocol):
    """Another process, as far as time is concerned."""

    def check(self) -> bool:
        """Return whether it has caused callbacks at the present time."""


class SimulatedTime:
    """Lets time pass: from one timer to the next, when all callbacks have been executed."""

    def __init__(
        self,
        scheduler: Scheduler,
        guard: Guard,
        *,
        check_open: Callable[[], None],
        report: Callable[[], str],
    ) -> None:
        """Start where the clocks are.

        Args:
            scheduler: Executes the nodes.
            guard: Notices callbacks that block.
            check_open: Raises an error if time cannot advance any more.
            report: Returns the last messages of all topics as text.
        """
        self._scheduler = scheduler
        self._clocks, self._agenda = scheduler.clocks, scheduler.agenda
        self._guard = guard
        self._check_open = check_open
        self._report = report
        # Time until the next timer or action (ns).
        self._until_next = math.inf
        self.processes: Sequence[Process] = []
        """The other processes, which are checked when all callbacks of a time have been executed."""
        self.check: Callable[[], None] | None = None
        """Called after that, at each simulated time."""
        self.pauses: Pauses | None = None
        """Where to stop in a debugger."""
        self.busy = False
        """Whether callbacks are being executed."""

    def settle(self) -> None:
        """Execute all callbacks that are due at the current time."""
        self._check_open()
        self._until_next = self.execute(self._scheduler.settle)
        self._finish()

    def settle_unless_busy(self) -> None:
        """Settle, except within a callback, after which it happens anyway."""
        if not self.busy:
            self.settle()

    def _catch_up(self) -> None:
        """Execute what was caused since the last callback."""
        self._check_open()
        self._until_next = self.execute(self._scheduler.catch_up)
        self._settle_processes()

    def _settle_processes(self) -> None:
        """Check the other processes, and execute what that causes."""
        # One at a time: what a process still sends may be for another one.
        while any(process.check() for process in self.processes):
            self._until_next = self.execute(self._scheduler.settle)

    def _finish(self) -> None:
        """Check the processes and what is required, when all callbacks of a time have been executed."""
        if self.processes:
            self._settle_processes()
        if self.check is not None:
            self.check()

    def step(self, at_most: float | None) -> None:
        """Advance to the time at which the next timer expires, as `Lockstep.step`."""
        end = math.inf if at_most is None else self._agenda.now + checked_nanoseconds('at_most', at_most)
        self._scheduler.warn_of_missing()
        self._catch_up()
        if self._until_next == math.inf and at_most is None:
            raise LockstepError('no timer is running, so step needs at_most')
        self._advance(end)

    def run_for(self, seconds: float) -> None:
        """Advance by a duration (s), as `Lockstep.run_for`."""
        end = self._agenda.now + checked_nanoseconds('seconds', seconds)
        self._scheduler.warn_of_missing()
        self.settle()
        while self._agenda.now < end:
            self._advance(end)

    def run_until(self, condition: Callable[[], object], timeout: float, what: str) -> None:
        """Advance until a condition is true, as `Lockstep.run_until`."""
        if not callable(condition):
            raise ValueError(f'condition must be a function, got {condition!r}')
        end = self._agenda.now + checked_nanoseconds('timeout', timeout)
        self._scheduler.warn_of_missing()
        self.settle()
        while not condition():
            if self._agenda.now >= end:
                what = what or _place(condition)
                raise LockstepError(
                    f'not within {timeout:g} s of simulated time: {what}\n{self._report()}'
                )
            # The condition may have published something.
            self._catch_up()
            self._advance(end)

    def jump(self, seconds: float) -> None:
        """Jump by a duration (s), as `Lockstep.jump`."""
        number = isinstance(seconds, (int, float)) and not isinstance(seconds, bool)
        if not (number and math.isfinite(seconds) and seconds):
            raise ValueError(f'seconds must be finite and not zero, got {seconds!r}')
        before = self._clocks.now / NANOSECONDS
        fits = before + seconds <= MAX_SECONDS
        now = self._clocks.now + round(seconds * NANOSECONDS) if fits else 0
        if now <= 0:
            raise ValueError(
                f'seconds must lead to a time after 0, at most {MAX_SECONDS} s, '
                f'got {seconds!r} at {before:g} s'
            )
        self.settle()
        self._clocks.now = now
        self.arrive()

    def _advance(self, end: float) -> None:
        """Advance to the next timer or action, but not beyond an end of world time (ns)."""
        agenda = self._agenda
        # The minimum of integers is exact, also beside infinity.
        passed = int(min(self._until_next, end - agenda.now))
        if self.pauses is not None and self.pauses.times and agenda.now + passed >= self.pauses.times[0]:
            self.pauses.pause(agenda.now + passed)
            if agenda.now >= end:
                return
            # Who looks into the world may have published something, or let time pass.
            self._catch_up()
            passed = int(min(self._until_next, end - agenda.now))
        agenda.now += passed
        if not self._clocks.pauses:
            self._clocks.now += passed
        self.arrive()

    def arrive(self) -> None:
        """Set the clocks of the nodes to the present time, and execute what is due then."""
        self._until_next = self.execute(self._scheduler.advance)
        if self.processes or self.check is not None:
            self._finish()

    # --- Execution

    def execute(self, work: Callable[[], T]) -> T:
        """Call a function that executes callbacks, and return its result."""
        if self.busy:
            raise LockstepError('a callback cannot advance time, and cannot add or remove nodes')
        self.busy, guard = True, self._guard
        guard.since = time.monotonic()
        try:
            result = work()
            if self._scheduler.links.elsewhere:
                self.check_threads()
            if guard.raised is not None:
                # A callback has caught it.
                raise guard.raised
            return result
        except ExternalShutdownException:
            raise LockstepError(SHUT_DOWN) from None
        except (Stuck, RuntimeError) as error:
            if isinstance(error, RCLError) and not rclpy.ok():
                raise LockstepError(SHUT_DOWN) from None
            # pybind11 replaces an exception that is raised while it converts an argument.
            stuck, guard.raised = error if isinstance(error, Stuck) else guard.raised, None
            if stuck is None:
                raise
            at = self._clocks.now / NANOSECONDS
            raise LockstepError(f'at {at:g} s: {stuck}\n{self._report()}') from stuck
        finally:
            guard.since, self.busy = None, False
            if guard.seen is not None:
                guard.stop_observing()

    def check_threads(self) -> None:
        """Check that nodes have sent nothing from threads of their own since they were added.

        Raises:
            LockstepError: One has, or one that was not added has sent something to those that were.
        """
        elsewhere = self._scheduler.links.elsewhere
        while elsewhere:
            # Other threads may add to it meanwhile.
            _, sent = elsewhere.popitem()
            if sent.added or sent.node not in self._scheduler.nodes:
                remedy = (
                    '' if sent.added else 'it was created, but not added: add it with lockstep.add, and '
                )
                raise LockstepError(
                    f"{sent.what} from a thread of its own ('{sent.thread}'): when that is done cannot "
                    f'be known, so it cannot run in lockstep; {remedy}do it in a callback, for example '
                    f'of a timer\n{self._report()}'
                )


def checked_nanoseconds(name: str, seconds: float) -> int:
    """Return a positive duration (s) in nanoseconds.

    Raises:
        ValueError: It is not positive or does not fit into a stamp. `name` is its name in the message.
    """
    return round(between(1e-9, MAX_SECONDS, unit='s')(name, seconds) * NANOSECONDS)


def _place(condition: Callable[[], object]) -> str:
    code = getattr(inspect.unwrap(condition), '__code__', None)
    where = f' ({code.co_filename}:{code.co_firstlineno})' if code else ''
    return f'condition {getattr(condition, "__qualname__", condition)}{where}'
