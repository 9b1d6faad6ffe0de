"""Poses to reach in order, as a value: each step takes the robot's pose and gives the next command.

Source: document A's law needs a tolerance (MATH.md, "Control laws"): at distance zero the heading
to the goal is undefined.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control.go_to_goal import turn_in_place
from diffdrive_jacobian.kinematics.se2 import wrap_angle

Law = Callable[[NDArray[np.float64], NDArray[np.float64]], tuple[Any, Any]]
"""A control law: pose (3,) and goal position (2,) to `(v, omega)`."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Arrival:
    """What counts as having arrived."""

    xy_tolerance: float
    """Largest distance to a waypoint that counts as there (m)."""
    yaw_tolerance: float
    """Largest heading error at the last waypoint, if its heading counts (rad)."""
    use_heading: bool
    """Whether the heading of the last waypoint counts."""


@dataclass(frozen=True, slots=True, eq=False)
class Waypoints:
    """Poses to reach in order, and how far along they are."""

    poses: NDArray[np.float64]
    """`[x, y, theta]` each, shape (n, 3), n >= 1."""
    index: int = 0
    """The waypoint that is driven to."""
    turning: bool = False
    """Whether the last position was reached and only its heading is left to take."""

    def distance(self, pose: NDArray[np.float64]) -> float:
        """Give the distance from a pose (3,) to the waypoint that is driven to (m)."""
        x, y, _ = self.poses[self.index]
        return math.hypot(x - pose[0], y - pose[1])

    def follow(
        self, pose: NDArray[np.float64], law: Law, arrival: Arrival, turning_gain: float
    ) -> tuple[Waypoints, tuple[Any, Any] | None]:
        """Take one step of the way.

        Args:
            pose: Where the robot is, shape (3,).
            law: The control law that drives to a position.
            arrival: What counts as having arrived.
            turning_gain: Gain of the turn in place (1/s).

        Returns:
            The waypoints with their progress, and the command `(v, omega)` (m/s, rad/s), or None in
            its place when everything is reached.
        """
        here = self
        while not here.turning and here.distance(pose) <= arrival.xy_tolerance:
            if here.index + 1 < len(here.poses):
                here = replace(here, index=here.index + 1)
            elif arrival.use_heading:
                here = replace(here, turning=True)
            else:
                return here, None
        goal = here.poses[here.index]
        if not here.turning:
            return here, law(pose, goal[:2])
        if abs(wrap_angle(goal[2] - pose[2])) <= arrival.yaw_tolerance:
            return here, None
        return here, turn_in_place(pose[2], goal[2], turning_gain)
