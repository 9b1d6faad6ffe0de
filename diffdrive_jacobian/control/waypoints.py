"""Waypoints: poses to reach in order. Each step takes the robot's pose and returns the next command."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control.arrival import Arrival, distance_to_goal, heading_error
from diffdrive_jacobian.control.go_to_goal import turn_in_place
from diffdrive_jacobian.numerics.checks import (
    array,
    boolean,
    finite,
    function,
    number,
    numbers,
    read_only,
)
from diffdrive_jacobian.numerics.fields import instance, integer

Pose: TypeAlias = NDArray[np.float64] | tuple[float, float, float]
STANDSTILL = (0.0, 0.0)
Law: TypeAlias = Callable[[Any, Any], tuple[Any, Any]]
"""A control law with its gains: pose as given to `follow`, and goal, an array of shape (3,), to
`(v, omega)`."""


@dataclass(frozen=True, slots=True, eq=False)
class Waypoints:
    """Poses to reach in order, and the progress along them. Immutable.

    Raises:
        ValueError: The poses have another shape than (n, 3) with n >= 1 or are not finite, there is no
            pose of that index, or `turning` is not a Boolean.
    """

    poses: NDArray[np.float64]
    """`[x, y, theta]` each, shape (n, 3), n >= 1."""
    index: int = 0
    """Index of the waypoint that is driven to."""
    turning: bool = False
    """Whether the last position was reached and only the heading remains."""
    _goal: tuple[float, float, float] = field(init=False, repr=False)
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
        law: Law,
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

        Raises:
            ValueError: An argument is of another class or shape, or not finite.
        """
        x, y, theta = numbers('pose', pose, 3)
        function('law', law)
        instance('arrival', arrival, Arrival)
        number('turning_gain', turning_gain, finite)
        here = self
        if here.turning and not arrival.use_heading:
            # The heading no longer counts, and the position was reached.
            return here, None
        while not here.turning:
            goal = here._goal
            if not arrival.reached(x, y, theta, goal[0], goal[1]):
                return here, law(pose, here.poses[here.index])
            if here.index + 1 < len(here.poses):
                here = here._progressed(here.index + 1, turning=False)
            elif not arrival.stopped(*twist):
                return here, STANDSTILL
            elif arrival.use_heading:
                here = here._progressed(here.index, turning=True)
            else:
                return here, None
        heading = here._goal[2]
        if arrival.faces(theta, heading):
            return here, None if arrival.stopped(*twist) else STANDSTILL
        return here, turn_in_place(theta, heading, turning_gain)

    def remaining(self, pose: Pose, arrival: Arrival) -> tuple[float, float]:
        """Return the distance and the turn that are left.

        Args:
            pose: Pose of the robot, shape (3,).
            arrival: Arrival criterion.

        Returns:
            The distance to the last position by way of the waypoints (m), infinite while the robot turns
            in place; and what is left of that turn (rad), infinite before it.
        """
        x, y, theta = pose
        if self.turning:
            return math.inf, abs(heading_error.formula(theta, self._goal[2]))
        legs = np.hypot(*np.diff(self.poses[self.index :, :2], axis=0).T)
        first = distance_to_goal.formula(x, y, theta, *self._goal[:2], arrival.offset)
        return float(first + legs.sum()), math.inf

    def resumed(self) -> Waypoints:
        """Return the waypoints with the last position to be checked again.

        Needed when the law or the driven point changes while the robot turns in place.
        """
        return self._progressed(self.index, turning=False) if self.turning else self

    def _progressed(self, index: int, *, turning: bool) -> Waypoints:
        # Without checks and copies, which would cost time in proportion to the number of poses.
        progressed = object.__new__(Waypoints)
        goal = tuple(self.poses[index].tolist())
        values = {'poses': self.poses, 'index': index, 'turning': turning, '_goal': goal}
        for name, value in values.items():
            object.__setattr__(progressed, name, value)
        return progressed
