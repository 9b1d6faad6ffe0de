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

"""Simulated time beside the clock on the wall: pause, step and speed."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from diffdrive_jacobian.live.commands import Command, Pause, SetSpeed, Step
from diffdrive_jacobian.live.session import Session

NAP = 0.02
"""Longest time for which `pace` waits before it looks at commands again (s)."""
MAX_LAG = 0.1
"""Time that is made up for at most (s). A machine that is too slow shows time as it comes."""


class Pacing:
    """Decides when simulated time may advance."""

    def __init__(self, *, speed: float = 1.0, paused: bool = False) -> None:
        """Start at a speed relative to the clock on the wall."""
        self.speed, self.paused = speed, paused
        self._steps = 0
        self._simulated = self._wait = 0.0
        self._anchor: tuple[float, float] | None = None

    def now(self) -> float:
        """Return the simulated time at which it was asked last whether time may advance (s)."""
        return self._simulated

    def obey(self, command: Pause | Step | SetSpeed) -> None:
        """Do what a page asks for."""
        self._anchor = None
        if isinstance(command, Pause):
            self.paused = command.paused
        elif isinstance(command, Step):
            self.paused = True
            self._steps += 1
        else:
            self.speed = command.speed

    def may_advance(self, simulated: float, now: float) -> bool:
        """Return whether time may advance beyond a simulated time, at a time on the wall (s)."""
        self._simulated = simulated
        if self.paused:
            self._anchor = None
            if not self._steps:
                return False
            self._steps -= 1
            return True
        if self._anchor is None:
            self._anchor = simulated, now
        lag = (now - self._anchor[1]) * self.speed - (simulated - self._anchor[0])
        if lag > MAX_LAG * self.speed:
            self._anchor = simulated, now
        self._wait = -lag / self.speed
        return lag >= 0.0

    def pace(self, simulated: float, meanwhile: Callable[[], bool]) -> bool:
        """Wait until time may advance beyond a simulated time (s), or `meanwhile` returns True.

        Returns:
            Whether `meanwhile` ended the wait.
        """
        while not self.may_advance(simulated, time.monotonic()):
            if meanwhile():
                return True
            time.sleep(NAP if self.paused else min(NAP, max(0.0, self._wait)))
        return False

    def shown(self) -> dict[str, Any]:
        """Return what the page shows."""
        return {
            'kind': 'lockstep',
            'time': round(self._simulated, 3),
            'paused': self.paused,
            'speed': self.speed,
        }


def control_time(session: Session, pacing: Pacing | None, command: Command) -> None:
    """Do what a page asks of time, or say why not. Without `pacing` time is real."""
    if pacing is not None and isinstance(command, (Pause, Step, SetSpeed)):
        pacing.obey(command)
        return
    text = 'time is real here: it can neither pause nor change its speed'
    if pacing is not None:
        text = 'only a recording has times to go to'
    session.notify(text, 'warning')
