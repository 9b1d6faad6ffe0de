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

"""Simulated wall time in the world: when a process goes on that waits for a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from diffdrive_jacobian.lockstep._clock import MAX_SECONDS, Agenda
from diffdrive_jacobian.lockstep.external.wall_time import WallTime
from diffdrive_jacobian.time_units import NANOSECONDS


class WallClock:
    """The wall time of a process that follows the world."""

    def __init__(self, wall_time: WallTime, agenda: Agenda, go_on: Callable[[], None]) -> None:
        """Begin with the time that the process has.

        Args:
            wall_time: What is shared with the process.
            agenda: What happens later.
            go_on: Called when a time has come for which somebody waits.
        """
        self._wall_time, self._agenda, self._go_on = wall_time, agenda, go_on
        self._begin = wall_time.steady - agenda.now
        """Wall time when the world began (ns)."""
        self._planned = 0
        """World time at which wall time goes on for somebody (ns)."""
        self.plan()

    @property
    def _now(self) -> int:
        return self._begin + self._agenda.now

    def give(self, now: int) -> None:
        """Give the process its wall time, and what the clocks of the world show (ns)."""
        self._wall_time.give(self._now, now)

    def due(self) -> Callable[[], None] | None:
        """Return what lets the first go on whose time has come; None: there is none."""
        first = self._wall_time.next()
        if first is None or first[0] > self._now:
            return None
        return partial(self._wall_time.let_go_on, first[1])

    def plan(self) -> None:
        """Let the process go on when the time has come for which it waits."""
        first = self._wall_time.next()
        if first is None:
            return
        at = first[0] - self._begin
        if at != self._planned and self._agenda.now < at < MAX_SECONDS * NANOSECONDS:
            self._planned = at
            self._agenda.at(at, self._arrive)

    def _arrive(self) -> None:
        if self._planned == self._agenda.now:
            self._go_on()
