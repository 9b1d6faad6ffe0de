"""Poses to reach in order, as a value: each step takes the robot's pose and gives the next command."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control.arrival import Arrival
from diffdrive_jacobian.control.go_to_goal import turn_in_place

Law = Callable[[NDArray[np.float64], NDArray[np.float64]], tuple[Any, Any]]
"""A control law: pose (3,) and goal (3,) to `(v, omega)`; it may look at the goal's heading or not."""


@dataclass(frozen=True, slots=True, eq=False)
class Waypoints:
    """Poses to reach in order, and how far along they are."""

    poses: NDArray[np.float64]
    """`[x, y, theta]` each, shape (n, 3), n >= 1."""
    index: int = 0
    """The waypoint that is driven to."""
    turning: bool = False
    """Whether the last position was reached and only its heading is left to take."""

    def follow(
        self, pose: NDArray[np.float64], law: Law, arrival: Arrival, turning_gain: float
    ) -> tuple[Waypoints, tuple[Any, Any] | None]:
        """Take one step of the way.

        Args:
            pose: Where the robot is, shape (3,).
            law: The control law that drives to a waypoint.
            arrival: What counts as having arrived.
            turning_gain: Gain of the turn in place (1/s).

        Returns:
            The waypoints with their progress, and the command `(v, omega)` (m/s, rad/s), or None in
            its place when everything is reached.
        """
        here = self
        if here.turning and not arrival.use_heading:
            # Asked for no longer: the position was reached.
            return here, None
        while not here.turning and here._there(pose, arrival):
            if here.index + 1 < len(here.poses):
                here = replace(here, index=here.index + 1)
            elif arrival.use_heading:
                here = replace(here, turning=True)
            else:
                return here, None
        goal = here.poses[here.index]
        if not here.turning:
            return here, law(pose, goal)
        if arrival.faces(pose[2], goal[2]):
            return here, None
        return here, turn_in_place(pose[2], goal[2], turning_gain)

    def resumed(self) -> Waypoints:
        """Return the waypoints with the last position to be reached again if the robot is not there.

        For a change of the law or of the point that has to arrive, while the robot turns in place.
        """
        return replace(self, turning=False) if self.turning else self

    def _there(self, pose: NDArray[np.float64], arrival: Arrival) -> bool:
        x, y, _ = self.poses[self.index].tolist()
        distance = arrival.distance(float(pose[0]), float(pose[1]), float(pose[2]), x, y)
        return bool(distance <= arrival.xy_tolerance)
