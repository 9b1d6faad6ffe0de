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

"""Driving by hand, with a dead-man's switch: a page that stops asking stops the robot.

A page that was silent, because its machine froze for example, still holds the key when it is back. It
must release it before it drives again.

The page is watched by a monotonic clock; commands are spaced by the robot's, which may be simulated. An
active goal is canceled first, and driving begins when that is confirmed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto

DEAD_MAN = 0.4
"""Time without a command of the page after which the robot stops (s)."""
PERIOD = 0.04
"""Shortest time between two commands to the robot, by its clock (s)."""
CANCEL_PATIENCE = 2.0
"""Longest wait until the goal is canceled (s)."""
STANDSTILL = (0.0, 0.0)


class Act(Enum):
    """What the caller must do."""

    NOTHING = auto()
    CANCEL_GOAL = auto()
    PUBLISH = auto()
    STOP = auto()
    """Publish a zero: driving has ended."""
    EXPIRE = auto()
    """Publish a zero: the page was silent, and must release the keys before it drives again."""
    GIVE_UP = auto()
    """Publish a zero if it has driven (`moved`), and report that the goal was not canceled."""


class HandDriving:
    """Driving of one robot by hand."""

    def __init__(self) -> None:
        """Start at rest."""
        self.page: int | None = None
        """The page that drives. None: none does."""
        self.twist = STANDSTILL
        """`(v, omega)` that is to be published (m/s, rad/s)."""
        self._commanded, self._published = -1.0, -math.inf
        self._canceling: float | None = None
        self._moved = self._released = False
        self._silent: set[int] = set()
        """Pages that were silent while they drove, and have not released the keys since."""

    def command(self, page: int, twist: tuple[float, float], now: float) -> bool:
        """Take a command of a page. Return False if another page drives."""
        if self.page not in (None, page):
            return False
        if page == self.page and now - self._commanded > DEAD_MAN:
            # The program was busy, and has not noticed yet.
            self._silent.add(page)
        if page in self._silent:
            return True
        if self.page is None:
            self._canceling, self._moved, self._published = None, False, -math.inf
        self.page, self.twist, self._commanded, self._released = page, twist, now, False
        return True

    @property
    def moved(self) -> bool:
        """Whether anything was published since the page began to drive."""
        return self._moved

    def release(self, page: int) -> None:
        """Take the end of driving by a page."""
        self._silent.discard(page)
        if self.page == page:
            self._released = True

    def update(
        self, now: float, robot_time: float, is_open: Callable[[int], bool], goal_active: bool
    ) -> Act:
        """Return what must be done now (s, and by the robot's clock); to be called often.

        `is_open` tells whether a page is connected, `goal_active` that a controller drives the robot.
        """
        if self.page is None:
            return Act.NOTHING
        if self._released or not is_open(self.page):
            self.page = None
            return Act.STOP if self._moved else Act.NOTHING
        if now - self._commanded > DEAD_MAN:
            self._silent.add(self.page)
            self.page = None
            return Act.EXPIRE
        if goal_active:
            if self._canceling is None:
                self._canceling = now
                return Act.CANCEL_GOAL
            if now - self._canceling > CANCEL_PATIENCE:
                self._silent.add(self.page)
                self.page = None
                return Act.GIVE_UP
            return Act.NOTHING
        self._canceling = None
        # A clock that was set back must not stop the robot.
        if 0.0 <= robot_time - self._published < PERIOD:
            return Act.NOTHING
        self._published, self._moved = robot_time, True
        return Act.PUBLISH
