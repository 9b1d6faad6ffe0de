"""What is known of the goals of one robot, from the topics that carry them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Arrival, Path
from diffdrive_jacobian.control.path_progress import PathProgress
from diffdrive_jacobian.live.quantities import rounded
from diffdrive_jacobian.messages.goal_status import (
    UNSTAMPED,
    Fate,
    FollowedGoal,
    GoalFollower,
    GoalState,
    Stamp,
)

Goals = NDArray[np.float64]
"""`[x, y, theta]` of each, shape (n, 3) (m, m, rad)."""
MAX_POINTS = 300
"""Number of points of a path that the page draws."""


def poses_of(goals: Goals | Path) -> Goals:
    """Return goals, of a path its poses."""
    return goals.poses if isinstance(goals, Path) else goals


class GoalEnd(NamedTuple):
    """The end of a goal."""

    robot: str
    """Namespace of the robot, `/` or `/NAME`."""
    state: GoalState
    """SUCCEEDED, CANCELED or ABORTED."""
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
        self.index = 0
        """Index of the goal that is driven to."""
        self._points: Any = None
        self.path: PathProgress | None = None
        """The path that is driven along, and the progress. None: goals are driven to."""
        self._follower: GoalFollower[Goals | Path] = GoalFollower()
        self._shown: FollowedGoal[Goals | Path] | None = None

    @property
    def goals(self) -> Goals | None:
        """The goals that were sent last, or that the controller has reported since. None: unknown."""
        goal = None if self._shown is None else self._shown.goal
        return None if goal is None else poses_of(goal)

    @property
    def state(self) -> GoalState:
        """Their state. While they wait for an answer, that of the goals before, if they are active."""
        shown, driving = self._shown, self._follower.driving
        if shown is None:
            return GoalState.UNKNOWN
        return driving.state if driving is not None and shown.fate is Fate.WAITING else shown.state

    @property
    def active(self) -> bool:
        """Whether a controller drives the robot to a goal."""
        return self.state.active

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

    def remaining(self, *, fresh: bool = False) -> Goals:
        """Return the goals that are not reached yet, shape (n, 3).

        Args:
            fresh: Whether they were sent just now: they count although no status is known yet.
        """
        waiting = fresh and self._shown is not None and self._shown.fate is Fate.WAITING
        if self.goals is None or not (self.active or waiting):
            return np.empty((0, 3))
        return self.goals[self.index :]

    def sent(self, goals: Goals | Path, stamp: Stamp) -> None:
        """Take goals or a path that somebody has sent, with their stamp."""
        shown = self._shown
        if shown is not None and shown.goal is not None and shown.stamp == stamp != UNSTAMPED:
            # Those that this program has sent come back by their topic.
            return
        if len(poses_of(goals)):
            self._show(self._follower.sent(goals, stamp))

    def reported(self, status: int, stamp: Stamp) -> FollowedGoal[Goals | Path] | None:
        """Take a status of a controller, with the stamp of its goal.

        Returns:
            The goals of which something else became. None: there are none.
        """
        changed = self._follower.reported(status, stamp)
        driving = self._follower.driving
        if driving is not None and (driving.stamp == stamp or changed is self._shown):
            # The goals after them were refused, or they were sent before this program listened.
            self._show(driving)
        elif self._shown is None:
            self._shown = changed
        return changed

    def replay(self, goals: Goals | Path | None, index: int, state: GoalState) -> None:
        """Show recorded goals or a recorded path, and their state."""
        self._shown, self.index = FollowedGoal(goals, UNSTAMPED, state), index
        self._use(goals)

    def moved(self, pose: NDArray[np.float64], arrival: Arrival) -> None:
        """Take a pose of the robot, `[x, y, theta]`: a waypoint may be reached."""
        if self.goals is None or not self.active:
            return
        if self.path is not None:
            self.path.moved(pose)
            passed = self.path.path.arc_lengths.searchsorted(self.path.s, 'right')
            self.index = min(int(passed), len(self.goals) - 1)
            return
        x, y, theta = pose.tolist()
        while self.index + 1 < len(self.goals):
            if not arrival.reached(x, y, theta, *self.goals[self.index, :2].tolist()):
                return
            self.index += 1

    def shown(self) -> dict[str, Any]:
        """Return what the page shows."""
        if self.path is not None:
            path = self.path.path
            return {
                'state': self.state.name.lower(),
                'active': self.active,
                # All poses would be too many, many times a second.
                'goals': rounded(path.poses[-1:]),
                'index': 0,
                'path': self._points,
            }
        return {
            'state': self.state.name.lower(),
            'active': self.active,
            'goals': None if self.goals is None else rounded(self.goals),
            'index': self.index,
        }

    def _show(self, followed: FollowedGoal[Goals | Path]) -> None:
        if followed is not self._shown:
            self._shown, self.index, self.path = followed, 0, None
            self._use(followed.goal)

    def _use(self, goals: Goals | Path | None) -> None:
        """Take what is driven to, the progress along a path as it was if it is the same."""
        if not isinstance(goals, Path):
            self.path = None
        elif self.path is None or self.path.path is not goals:
            self.path = PathProgress(goals)
            s = np.linspace(0.0, goals.length, MAX_POINTS)
            self._points = rounded(goals.poses_at(s)[:, :2])
