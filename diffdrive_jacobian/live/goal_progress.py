"""What is known of the goals of one robot, from the topics that carry them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Arrival
from diffdrive_jacobian.live.quantities import rounded
from diffdrive_jacobian.messages.goal_status import GoalState

ACTIVE = (GoalState.ACCEPTED, GoalState.EXECUTING, GoalState.CANCELING)
"""States in which a controller drives to a goal."""
ENDED = (GoalState.SUCCEEDED, GoalState.CANCELED, GoalState.ABORTED)
"""States of a goal that no controller drives to any more."""
MAX_KNOWN = 8
"""Number of earlier goals that are kept, in case the later ones are refused."""


class GoalEnd(NamedTuple):
    """The end of a goal."""

    robot: str
    """Namespace of the robot, `/` or `/NAME`."""
    state: GoalState
    """One of `ENDED`."""
    goal: NDArray[np.float64]
    """`[x, y, theta]` of the goal that was driven to last, shape (3,) (m, m, rad)."""
    pose: NDArray[np.float64] | None
    """`[x, y, theta]` of the robot, shape (3,) (m, m, rad). None: there is no odometry."""
    distance: float
    """Distance from the driven point to the goal by the odometry (m). NaN without odometry."""
    true_distance: float
    """The same by the ground truth (m). NaN: it is not known."""


class GoalProgress:
    """The goals of a robot, and how far it is."""

    def __init__(self) -> None:
        """Start without goals."""
        self.goals: NDArray[np.float64] | None = None
        """`[x, y, theta]` of each, shape (n, 3) (m, m, rad). None: unknown."""
        self.index = 0
        """Index of the goal that is driven to."""
        self.state = GoalState.UNKNOWN
        """State of the last goal that has a status."""
        self._stamp: tuple[int, int] | None = None
        self._ended: tuple[int, int] | None = None
        self._newest: tuple[int, int] | None = None
        self._answered = False
        self._early: tuple[tuple[int, int], GoalState] | None = None
        self._known: dict[tuple[int, int], NDArray[np.float64]] = {}

    @property
    def active(self) -> bool:
        """Whether a controller drives the robot to a goal."""
        return self.state in ACTIVE

    @property
    def current(self) -> NDArray[np.float64] | None:
        """The goal that is driven to, shape (3,). None: none or unknown."""
        return None if self.goals is None or not self.active else self.goals[self.index]

    @property
    def reached(self) -> NDArray[np.float64] | None:
        """The goal at which the robot arrived, shape (3,). None: none or unknown."""
        return None if self.goals is None or self.state is not GoalState.SUCCEEDED else self.goals[-1]

    @property
    def last(self) -> bool:
        """Whether the goal that is driven to is the last one."""
        return self.goals is not None and self.index == len(self.goals) - 1

    def remaining(self, *, fresh: bool = False) -> NDArray[np.float64]:
        """Return the goals that are not reached yet, shape (n, 3).

        Args:
            fresh: Whether they were sent just now: they count although no status is known yet.
        """
        if self.goals is None or not (self.active or (fresh and not self._answered)):
            return np.empty((0, 3))
        return self.goals[self.index :]

    def sent(self, goals: NDArray[np.float64], stamp: tuple[int, int]) -> None:
        """Take goals that somebody has sent, with their stamp."""
        if not len(goals) or (stamp == self._stamp and any(stamp)):
            # Those that this program has sent come back by their topic.
            return
        self.goals, self.index, self._stamp, self._answered = goals, 0, stamp, False
        self._known[stamp], self._newest = goals, stamp
        while len(self._known) > MAX_KNOWN:
            del self._known[next(iter(self._known))]
        if self._early is not None and self._early[0] == stamp:
            # The status overtook the goal.
            self.state, self._answered = self._early[1], True

    def reported(self, state: GoalState, stamp: tuple[int, int]) -> None:
        """Take a status of a controller, with the stamp of its goal."""
        self._early = stamp, state
        if self._stamp is not None and stamp != self._stamp:
            if state in ACTIVE:
                # The goals after them were refused, or they were sent before this program listened.
                self.goals, self.index, self._stamp = self._known.get(stamp), 0, stamp
            elif self.active:
                # The end of goals that were replaced by the present ones.
                return
        self.state, self._answered = state, True

    def has_ended(self) -> bool:
        """Return whether the latest goals have ended. True only once for each of them.

        Goals that were replaced by others do not count.
        """
        own = self._early is not None and self._early[0] == self._stamp
        # Unless the newest ones were refused.
        own &= self._newest in (self._stamp, self._ended)
        if not own or self.state not in ENDED or self.goals is None or self._ended == self._stamp:
            return False
        self._ended = self._stamp
        return True

    def moved(self, pose: NDArray[np.float64], arrival: Arrival) -> None:
        """Take a pose of the robot, `[x, y, theta]`: a waypoint may be reached."""
        if self.goals is None or not self.active:
            return
        x, y, theta = pose.tolist()
        while self.index + 1 < len(self.goals):
            if not arrival.reached(x, y, theta, *self.goals[self.index, :2].tolist()):
                return
            self.index += 1

    def shown(self) -> dict[str, Any]:
        """Return what the page shows."""
        return {
            'state': self.state.name.lower(),
            'active': self.active,
            'goals': None if self.goals is None else rounded(self.goals),
            'index': self.index,
        }
