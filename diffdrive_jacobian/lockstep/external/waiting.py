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

"""Waiting until a process has done what it was given, and taking what it has sent meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager

from diffdrive_jacobian.lockstep._clock import Clocks
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep.external.command import Command
from diffdrive_jacobian.lockstep.external.discovery import Discovery
from diffdrive_jacobian.lockstep.external.domain import Domain
from diffdrive_jacobian.lockstep.external.linux import LIMIT, QUEUE, largest_queue
from diffdrive_jacobian.lockstep.external.presence import Presence
from diffdrive_jacobian.lockstep.external.quiet import LONGEST
from diffdrive_jacobian.lockstep.external.relays import CALL, Arrived
from diffdrive_jacobian.time_units import NANOSECONDS

SIMULATED = "start(..., wall_time='simulated')"
"""What lets a program that lives by wall time take part."""


class Waiting:
    """Waits for the process of a domain."""

    def __init__(
        self,
        domain: Domain,
        discovery: Discovery,
        presence: Presence,
        clocks: Clocks,
        extend: Callable[[float], None],
    ) -> None:
        """Start without having waited.

        Args:
            domain: The domain of the process.
            discovery: Its nodes.
            presence: Whether they are still there.
            clocks: The clocks of the world.
            extend: Receives the wall time (s) that was spent waiting for the process.
        """
        self._domain, self._discovery, self._presence = domain, discovery, presence
        self._clocks, self._extend = clocks, extend
        self._calls: list[Arrived] = []

    def wait(self, asks: Callable[[], bool] | None = None) -> None:
        """Wait until the process and the threads that receive from it are quiet.

        Args:
            asks: Returns whether callbacks that wait with a timeout wait for the world, and so for as
                long as they have to. None: whether the process has called a service of the world.

        Raises:
            LockstepError: They do not become quiet.
        """
        domain, discovery = self._domain, self._discovery
        try:
            domain.quiet.wait(domain.command.patience, asks or self._asks)
        except LockstepError as error:
            if domain.wall_time is not None:
                domain.wall_time.check(domain.title)
            if discovery.joined:
                # What it did may be the cause.
                self._presence.check()
            if domain.wall_time is None:
                remedy = f'a loop or a thread that sleeps or waits on wall time: {SIMULATED}'
            else:
                remedy = (
                    'a loop that polls cannot run in lockstep, also in a program that it has started'
                )
            raise LockstepError(
                f'{discovery.names} {error}\n  {remedy}; a callback that takes longer: '
                f'start(..., patience=); a debugger: pause_at\n{domain.child.describe()}'
            ) from None

    def _asks(self) -> bool:
        """Return whether the process waits for responses of the world."""
        for (role, _), relay in self._discovery.relays.items():
            if role == CALL:
                self._calls += relay.take()
        return bool(self._calls or self._discovery.unanswered)

    def uncounted(self) -> AbstractContextManager[None]:
        """Return a context manager in which wall time is not that of callbacks, as `uncounted`."""
        return uncounted(self._domain.command, self._extend)

    def check_waits(self) -> None:
        """Check that a callback which waits for a response of the world still does."""
        with self.uncounted():
            self.wait()
        if not self._domain.quiet.waits_in_callback:
            raise LockstepError(
                f'a callback of {self._discovery.names} waited for the response of a service until its '
                f'timeout, which is wall time, at {self._seconds:g} s: this machine is too slow\n'
                + self._domain.child.describe()
            )

    # --- What has arrived

    def take(self) -> list[Arrived]:
        """Return what has arrived: messages by the names of their topics, responses, requests."""
        calls, self._calls = self._calls, []
        relays = self._discovery.relays.values()
        try:
            return [*(arrived for relay in relays for arrived in relay.take()), *calls]
        except LockstepError:
            self.check_lost(now=True)
            raise

    def refuse(self, arrived: Sequence[Arrived]) -> None:
        """Raise LockstepError if something has arrived, because nothing was delivered."""
        if arrived:
            # What was lost is sent again, later.
            self.check_lost(now=True)
            domain = self._domain
            what = ', '.join(dict.fromkeys(one.what for one in arrived))
            raise LockstepError(
                f'{self._discovery.names} {what} at {self._seconds:g} s, while nothing was delivered '
                'to it: what it sends then differs from run to run. Likely '
                f'{"" if domain.command.use_sim_time else "use_sim_time=False, "}a timer on wall time '
                '(create_wall_timer), a thread of its own, or a callback that had not ended, because it '
                'waited for something else than a message'
                f'{"; " + SIMULATED if domain.wall_time is None else ""}\n' + domain.child.describe()
            )

    def check_lost(self, *, now: bool = False) -> None:
        """Raise LockstepError if messages between the world and the process are known to be lost.

        They are the cause of other errors, and this one has the remedy.

        Args:
            now: Whether to look, even if that was done just before.
        """
        if self._discovery.joined and self._domain.datagrams.lost(now=now):
            raise LockstepError(
                f'messages to or from {self._discovery.names} were lost at {self._seconds:g} s or '
                f'before: more was sent at once than a socket can hold; {LIMIT} allows '
                f'{largest_queue()} bytes, and may need {QUEUE}: '
                f'sysctl -w net.core.rmem_max={QUEUE}'
            )

    @property
    def _seconds(self) -> float:
        return self._clocks.now / NANOSECONDS


@contextmanager
def uncounted(command: Command, extend: Callable[[float], None]) -> Iterator[None]:
    """Let wall time pass that is not that of callbacks in this process. It has limits of its own.

    Args:
        command: The command that has the limits.
        extend: Receives the time (s).
    """
    begin, longest = time.monotonic(), LONGEST * max(command.patience, command.timeout)
    extend(longest)
    try:
        yield
    finally:
        extend(time.monotonic() - begin - longest)
