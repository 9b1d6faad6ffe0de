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

"""Waypoints: poses to reach in order, and when one counts as reached.

Document A's law needs a tolerance, because the heading to the goal is undefined at distance zero. For
document B's law the distance is measured from the offset point (doc/mathematics.md, "Control laws").
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control.goal_laws import turn_in_place
from diffdrive_jacobian.kinematics.diff_drive import offset_point
from diffdrive_jacobian.numerics.checks import (
    Comparable,
    NotNegative,
    NotNegativeOrInfinite,
    array,
    boolean,
    constant,
    finite,
    integer,
    read_only,
)
from diffdrive_jacobian.numerics.elementary import hypot, wrap
from diffdrive_jacobian.numerics.formula import Number, Scalar, formula

Pose: TypeAlias = NDArray[np.float64] | tuple[float, float, float]
STANDSTILL = (0.0, 0.0)
LawWithGains: TypeAlias = Callable[[Any, Any], tuple[Any, Any]]
"""A control law with its gains: pose and goal, tuples of three floats, to `(v, omega)`."""


@formula('(),(),(),(),(),() -> ()')
def distance_to_goal(
    x: Number, y: Number, theta: Number, x_goal: Number, y_goal: Number, offset: Number
) -> Scalar:
    """Compute the distance of the point at x = offset in the body frame from a goal, shape (...) (m)."""
    x_d, y_d = offset_point.formula((x, y, theta), offset)
    return hypot(x_goal - x_d, y_goal - y_d)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Arrival(Comparable):
    """Arrival criterion. Immutable, comparable and hashable.

    A tolerance that is negative or not finite, a velocity that is negative or NaN, an offset that is not
    finite, and a `use_heading` that is not a Boolean raise ValueError.
    """

    xy_tolerance: NotNegative = 0.02
    """Largest distance to a goal that counts as arrived (m)."""
    yaw_tolerance: NotNegative = 0.02
    """Largest heading error at the goal, if the heading counts (rad)."""
    use_heading: bool = False
    """Whether the heading of the last goal counts."""
    offset: Annotated[Any, partial(constant, check=finite)] = 0.0
    """X coordinate in the body frame of the point that is to arrive (m), a number or an array."""
    trans_stopped_velocity: NotNegativeOrInfinite = math.inf
    """Largest speed with which the last goal counts as reached, as in Nav2's goal checker (m/s)."""
    rot_stopped_velocity: NotNegativeOrInfinite = math.inf
    """Largest yaw rate with which it does (rad/s)."""

    def distance(self, x: Any, y: Any, theta: Any, x_goal: Any, y_goal: Any) -> Any:
        """Compute the distance of the driven point from a goal.

        Positions x, y (m), headings theta (rad) and positions of the goal (m) have the shape (...), and
        so has the distance (m). One that is not finite, shapes that do not broadcast, and a distance
        that overflows raise ValueError.
        """
        return distance_to_goal(x, y, theta, x_goal, y_goal, self.offset)

    def reached(self, x: float, y: float, theta: float, x_goal: float, y_goal: float) -> bool:
        """Return whether the distance to a goal is within the tolerance, without checks."""
        distance = distance_to_goal.floats(x, y, theta, x_goal, y_goal, self.offset)
        return bool(distance <= self.xy_tolerance)

    def stopped(self, v: Any, omega: Any) -> Any:
        """Return whether a robot with a twist is slow enough, numbers or arrays; NaN is not."""
        return (abs(v) <= self.trans_stopped_velocity) & (abs(omega) <= self.rot_stopped_velocity)

    def progress(self, near: Any, turning: Any, twist: Any, theta: Any, heading: Any) -> tuple[Any, ...]:
        """Return what a robot does at its last goal: Booleans, or arrays of them, without checks.

        Args:
            near: Whether it is within the tolerance of the position.
            turning: Whether it was, and only the heading remains.
            twist: Its twist `(v, omega)` (m/s, rad/s).
            theta: Its heading (rad).
            heading: That of the goal (rad).

        Returns:
            Whether only the heading remains, whether it turns to it, and whether it has arrived. One
            that is near and does neither stops.
        """
        stopped = self.stopped(*twist)
        if not self.use_heading:
            return turning, turning & False, (near | turning) & stopped
        turning = turning | (near & stopped)
        faces = abs(wrap(heading - theta)) <= self.yaw_tolerance
        return turning, turning & (faces ^ True), turning & faces & stopped


@dataclass(frozen=True, slots=True, eq=False)
class Waypoints:
    """Poses to reach in order, and the progress along them. Immutable.

    Poses that have another shape than (n, 3) with n >= 1 or are not finite, an index without a pose, and
    a `turning` that is not a Boolean raise ValueError.
    """

    poses: NDArray[np.float64]
    """`[x, y, theta]` each, shape (n, 3), n >= 1."""
    index: int = 0
    """Index of the waypoint that is driven to."""
    turning: bool = False
    """Whether the last position was reached and only the heading remains."""
    _goal: tuple[float, ...] = field(init=False, repr=False)
    """The waypoint that is driven to."""

    def __post_init__(self) -> None:
        """Check every value."""
        poses = array('poses', self.poses, 'n', 3)
        if poses.ndim != 2:
            raise ValueError(f'poses must have shape (n, 3), got {poses.shape}')
        object.__setattr__(self, 'poses', read_only(poses))
        index = integer('index', self.index, 0, len(poses) - 1)
        object.__setattr__(self, 'index', index)
        object.__setattr__(self, '_goal', tuple(self.poses[index].tolist()))
        object.__setattr__(self, 'turning', boolean('turning', self.turning))

    def follow(
        self,
        pose: Pose,
        law: LawWithGains,
        arrival: Arrival,
        turning_gain: float,
        twist: tuple[float, float] = STANDSTILL,
    ) -> tuple[Waypoints, tuple[Any, Any] | None]:
        """Compute the next command.

        Args:
            pose: Pose of the robot, shape (3,), as an array or as a tuple of floats.
            law: The control law that drives to a waypoint.
            arrival: Arrival criterion.
            turning_gain: Gain of the turn in place (1/s).
            twist: Twist of the robot, which must be slow enough if the criterion says so.

        Returns:
            The waypoints with their new progress, and the command `(v, omega)` (m/s, rad/s). The
            command is None when all waypoints are reached. It is zero where the robot is at the last
            one and has yet to stop.

        What the law raises is passed on. The pose is not checked again.
        """
        x, y, theta = pose
        index, goal = self.index, self._goal
        near = self.turning or arrival.reached(x, y, theta, goal[0], goal[1])
        while near and not self.turning and index + 1 < len(self.poses):
            index += 1
            goal = tuple(self.poses[index].tolist())
            near = arrival.reached(x, y, theta, goal[0], goal[1])
        if not near:
            return self._progressed(index, False) if index > self.index else self, law(pose, goal)
        turning, turns, arrived = arrival.progress(near, self.turning, twist, theta, goal[2])
        here = self
        if (index, turning) != (self.index, self.turning):
            here = self._progressed(index, turning)
        if turns:
            return here, turn_in_place.formula(theta, goal[2], turning_gain)
        return here, None if arrived else STANDSTILL

    def remaining(self, pose: Pose, arrival: Arrival, turn: float = 0.0) -> tuple[float, float]:
        """Return how far a robot may still roll and turn, so that it can stop at the last goal (m, rad).

        It may roll to that goal by way of the waypoints, but not out of the tolerance again where it
        heads past the goal. While it turns in place it may turn to the heading, and what is left of the
        tolerance limits how far it rolls. The turn is infinite before. A fiftieth of the tolerance is
        always left, so that a robot at its rim gets on.

        Args:
            pose: Pose of the robot, shape (3,).
            arrival: Arrival criterion.
            turn: The turn until it rests (rad): it rolls along an arc.
        """
        x, y, theta = pose
        tolerance, goal = arrival.xy_tolerance, self._goal
        distance = float(distance_to_goal.formula(x, y, theta, *goal[:2], arrival.offset))
        if self.turning:
            left = abs(wrap(goal[2] - theta))
            return max(tolerance - distance, tolerance / 50.0), left
        if self.index + 1 < len(self.poses):
            legs = np.hypot(*np.diff(self.poses[self.index :, :2], axis=0).T)
            return distance + float(legs.sum()), math.inf
        # Of the chord of the arc: where it leaves the circle of the tolerance, if it meets it.
        cosine, sine = math.cos(theta + turn / 2.0), math.sin(theta + turn / 2.0)
        dx, dy = goal[0] - x, goal[1] - y
        ahead, beside = cosine * dx + sine * dy - arrival.offset, cosine * dy - sine * dx
        leaves = ahead + math.sqrt(max(tolerance**2 - beside**2, 0.0))
        if abs(beside) > tolerance or leaves < 0.0:
            leaves = 0.0
        return max(distance - 0.98 * tolerance, min(distance, leaves)), math.inf

    def resumed(self) -> Waypoints:
        """Return the waypoints with the last position to be checked again.

        Needed when the law or the driven point changes while the robot turns in place.
        """
        return self._progressed(self.index, False) if self.turning else self

    def _progressed(self, index: int, turning: bool) -> Waypoints:
        """Return the same poses, which are not checked and copied again."""
        there = copy.copy(self)
        object.__setattr__(there, 'index', index)
        object.__setattr__(there, 'turning', turning)
        object.__setattr__(there, '_goal', tuple(self.poses[index].tolist()))
        return there
