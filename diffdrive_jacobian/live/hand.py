"""Driving by hand, with a dead-man's switch: who stops asking stops the robot.

A pure state machine; times are monotonic seconds. While a goal is active, driving by hand first cancels
it and begins when that is confirmed.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto

DEAD_MAN = 0.4
"""Time without a command of the page after which the robot stops (s)."""
PERIOD = 0.04
"""Time between two commands to the robot (s)."""
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
    GIVE_UP = auto()
    """Report that the goal was not canceled; nothing was driven."""


class HandDriving:
    """Driving of one robot by hand."""

    def __init__(self, period: float = PERIOD) -> None:
        """Start at rest.

        Args:
            period: Shortest time between two commands (s).
        """
        self._period = period
        self.page: int | None = None
        """The page that drives. None: none does."""
        self.twist = STANDSTILL
        """`(v, omega)` that is to be published (m/s, rad/s)."""
        self._commanded = self._published = -1.0
        self._canceling: float | None = None
        self._moved = self._released = False

    def command(self, page: int, twist: tuple[float, float], now: float) -> bool:
        """Take a command of a page. Return False if another page drives."""
        if self.page not in (None, page):
            return False
        if self.page is None:
            self._canceling, self._moved, self._published = None, False, -1.0
        self.page, self.twist, self._commanded, self._released = page, twist, now, False
        return True

    def release(self, page: int) -> None:
        """Take the end of driving by a page."""
        if self.page == page:
            self._released = True

    def update(self, now: float, is_open: Callable[[int], bool], goal_active: bool) -> Act:
        """Return what must be done now; to be called often.

        Args:
            now: Present time (s).
            is_open: Whether a page is connected.
            goal_active: Whether a controller drives the robot.
        """
        if self.page is None:
            return Act.NOTHING
        if self._released or now - self._commanded > DEAD_MAN or not is_open(self.page):
            self.page = None
            return Act.STOP if self._moved else Act.NOTHING
        if goal_active:
            if self._canceling is None:
                self._canceling = now
                return Act.CANCEL_GOAL
            if now - self._canceling > CANCEL_PATIENCE:
                self.page = None
                return Act.GIVE_UP
            return Act.NOTHING
        self._canceling = None
        if now - self._published < self._period:
            return Act.NOTHING
        self._published, self._moved = now, True
        return Act.PUBLISH
