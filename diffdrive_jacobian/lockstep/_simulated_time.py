"""Simulated time that advances from one timer to the next.

`__tracebackhide__` lets pytest show the line of the test instead of those of this module.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import rclpy
from rclpy.executors import ExternalShutdownException

from diffdrive_jacobian.lockstep._errors import LockstepError, PropertyViolation
from diffdrive_jacobian.lockstep._executor import QuiescentExecutor
from diffdrive_jacobian.lockstep._external import External
from diffdrive_jacobian.lockstep._guard import Guard, Stuck
from diffdrive_jacobian.lockstep._report import Traffic
from diffdrive_jacobian.lockstep._requirement import Required, Requirement
from diffdrive_jacobian.numerics.fields import between
from diffdrive_jacobian.ros.rclpy_internals import RCLError
from diffdrive_jacobian.time_units import NANOSECONDS

MAX_SECONDS = 2**31 - 1
"""Largest time that fits into a stamp (s)."""
SHUT_DOWN = 'rclpy was shut down: only lockstep may do that'
CONNECTION = 30.0
"""Longest wall time for the discovery of external nodes (s)."""


class SimulatedTime:
    """Simulated time. Base class of `Lockstep`."""

    _executor: QuiescentExecutor
    _guard: Guard

    def __init__(self, start: int) -> None:
        """Start at a time (ns)."""
        self._now = self._start = start
        self._until_next: int | None = None
        self._busy = False
        self._external: External | None = None
        self._traffic = Traffic(lambda: self._now)
        self._watches: list[Required] = []

    def _check_open(self) -> None:
        """Raise LockstepError after `close`."""
        raise NotImplementedError

    @property
    def now(self) -> int:
        """Simulated time (ns)."""
        return self._now

    @property
    def elapsed(self) -> float:
        """Simulated time since the start, by the clock of the nodes (s)."""
        return (self._now - self._start) / NANOSECONDS

    @property
    def world_time(self) -> int:
        """Time that has passed in the world since the start (ns).

        It always advances. The clock of the nodes, `now`, may jump or stand still.
        """
        return self._executor.agenda.now

    def settle(self) -> None:
        """Execute all callbacks that are due at the current time."""
        __tracebackhide__ = True
        self._check_open()
        with self._watched():
            self._until_next = self._executor.settle()
        self._await_others()
        if self._watches:
            self._check_requirements()

    def _catch_up(self) -> None:
        """Execute what was caused since the last callback."""
        self._check_open()
        with self._watched():
            self._until_next = self._executor.catch_up()
        self._await_others()

    def step(self, at_most: float | None = None) -> None:
        """Advance to the time at which the next timer expires.

        Args:
            at_most: Largest duration of the step (s).

        Raises:
            ValueError: `at_most` is not positive, or too long.
            LockstepError: No timer is running and `at_most` is not given, or time cannot advance.
        """
        __tracebackhide__ = True
        end = math.inf if at_most is None else self.world_time + checked_nanoseconds('at_most', at_most)
        self.connect()
        self._catch_up()
        if self._until_next is None and at_most is None:
            raise LockstepError('no timer is running, so step needs at_most')
        self._advance(end)

    def run_for(self, seconds: float) -> None:
        """Advance by a duration (s), from one timer to the next.

        Raises:
            ValueError: `seconds` is not positive, or too long.
            LockstepError: Time cannot advance.
        """
        __tracebackhide__ = True
        end = self.world_time + checked_nanoseconds('seconds', seconds)
        self.connect()
        self.settle()
        while self.world_time < end:
            self._advance(end)

    def run_until(self, condition: Callable[[], object], timeout: float, what: str = '') -> None:
        """Advance until a condition is true.

        Args:
            condition: The condition. It is called once at each simulated time, after all callbacks.
            timeout: Longest simulated time (s).
            what: Description of the condition for the error message.

        Raises:
            ValueError: `timeout` is not positive, or too long.
            LockstepError: The condition did not become true in time, or time cannot advance.
        """
        __tracebackhide__ = True
        end = self.world_time + checked_nanoseconds('timeout', timeout)
        self.connect()
        self.settle()
        while not condition():
            if self.world_time >= end:
                what = what or _place(condition)
                raise LockstepError(
                    f'not within {timeout:g} s of simulated time: {what}\n{self.report()}'
                )
            # The condition may have published something.
            self._catch_up()
            self._advance(end)

    def jump(self, seconds: float) -> None:
        """Jump by a duration of time (s), forward or back, as when a simulator is reset.

        Timers do not expire one by one in between. rcl determines how they react to the jump.

        Raises:
            ValueError: `seconds` is zero or not finite, or the new time does not fit into a stamp.
        """
        __tracebackhide__ = True
        if not math.isfinite(seconds) or seconds == 0.0:
            raise ValueError(f'seconds must be finite and not zero, got {seconds!r}')
        before = self._now / NANOSECONDS
        now = self._now + round(seconds * NANOSECONDS) if before + seconds <= MAX_SECONDS else 0
        if now <= 0:
            raise ValueError(
                f'seconds must lead to a time after 0, at most {MAX_SECONDS} s, '
                f'got {seconds!r} at {before:g} s'
            )
        self.connect()
        self.settle()
        self._now = now
        self._publish_clock()

    def _advance(self, end: float) -> None:
        """Advance to the next timer or action, but not beyond an end of world time (ns)."""
        __tracebackhide__ = True
        self.connect()
        until_next = math.inf if self._until_next is None else self._until_next
        agenda = self._executor.agenda
        # The minimum of integers is exact, also beside infinity.
        passed = int(min(until_next, end - agenda.now))
        agenda.now += passed
        if not self._executor.clock_pauses:
            self._now += passed
        self._publish_clock()

    def _publish_clock(self) -> None:
        __tracebackhide__ = True
        if self._external is not None and self._external.announce():
            with self._watched():
                self._executor.clocks.set(self._now)
                self._external.release()
        with self._watched():
            self._until_next = self._executor.advance(self._now)
        self._await_others()
        if self._watches:
            self._check_requirements()

    def _await_others(self) -> None:
        """Wait for the messages from other processes that are due, and execute what they cause."""
        external = self._external
        if external is None:
            return
        while external.await_answers():
            with self._watched():
                external.release()
                self._until_next = self._executor.settle()
        until_next = external.until_next()
        if until_next is not None:
            self._until_next = min(until_next, self._until_next or until_next)

    def connect(self, timeout: float = CONNECTION) -> None:
        """Wait until the external nodes are discovered, and have discovered the nodes of the world.

        The methods that let time pass do so themselves, also after new nodes were added or started. Only
        then do external nodes receive the time. In an isolated world there is nothing to wait for.

        Args:
            timeout: Longest wall time (s).

        Raises:
            ValueError: `timeout` is not positive.
            LockstepError: Nodes are not discovered in time, or a process has ended.
        """
        checked_nanoseconds('timeout', timeout)
        self._check_open()
        external = self._external
        if external is None or self._busy:
            return
        if external.connected():
            return
        self.settle()
        while not external.connected():
            external.connect(timeout)
            # Recorders subscribe to topics that were discovered.
            self._on_discovery()
            self.settle()
        with self._watched():
            external.begin()
        self.settle()

    def _on_discovery(self) -> None:
        """Note that topics may have been discovered."""

    @contextmanager
    def _watched(self) -> Iterator[None]:
        if self._busy:
            raise LockstepError('a callback cannot advance time, and cannot add or remove nodes')
        self._busy = True
        self._guard.arm()
        try:
            yield
            if self._executor.deliveries.elsewhere:
                self._check_threads()
        except ExternalShutdownException:
            raise LockstepError(SHUT_DOWN) from None
        except (Stuck, RuntimeError) as error:
            if isinstance(error, RCLError) and not rclpy.ok():
                raise LockstepError(SHUT_DOWN) from None
            # pybind11 replaces an exception that is raised while it converts an argument.
            stuck = error if isinstance(error, Stuck) else self._guard.raised
            if stuck is None:
                raise
            raise LockstepError(f'at {self._now / NANOSECONDS:g} s: {stuck}\n{self.report()}') from stuck
        finally:
            self._guard.disarm()
            self._busy = False

    def _check_threads(self) -> None:
        """Check that nodes have sent nothing from threads of their own since they were added.

        Raises:
            LockstepError: One has, or one that was not added has sent something to those that were.
        """
        elsewhere = self._executor.deliveries.elsewhere
        while elsewhere:
            # Other threads may add to it meanwhile.
            _, sent = elsewhere.popitem()
            if sent.added or sent.node not in self._executor.nodes:
                remedy = (
                    '' if sent.added else 'it was created, but not added: add it with lockstep.add, and '
                )
                raise LockstepError(
                    f"{sent.what} from a thread of its own ('{sent.thread}'): when that is done cannot "
                    f'be known, so it cannot run in lockstep; {remedy}do it in a callback, for example '
                    f'of a timer\n{self.report()}'
                )

    def _check_requirements(self) -> None:
        """Check what is required at the current time, when all callbacks have been executed."""
        __tracebackhide__ = True
        for required in self._watches:
            if (text := required.watch.check()) is not None:
                self._watches.remove(required)
                required.end()
                raise self._violation(required.requirement, text)

    def _violation(self, requirement: Requirement, text: str) -> PropertyViolation:
        return PropertyViolation(requirement, self.world_time / NANOSECONDS, text, self.report())

    def report(self) -> str:
        """Return the last messages of all topics as text."""
        executor = self._executor
        text = self._traffic.describe(executor.nodes, executor.existing, self.world_time)
        lines = [] if self._external is None else self._external.waiting.describe()
        return '\n  '.join([text, *lines])


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
