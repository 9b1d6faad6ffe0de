"""Detection of a robot that has a goal and does not move."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

PATIENCE = 5.0
"""Time without motion after which a robot stands still (s)."""
MIN_DISTANCE = 0.005
"""Smallest displacement that is motion (m): more than the noise of odometry at rest."""
MIN_ROTATION = 0.01
"""Smallest rotation that is motion (rad)."""


class Standstill:
    """Detects, from the poses of a robot, that it has not moved for `PATIENCE`."""

    def __init__(self) -> None:
        """Start without a pose."""
        self._reference: NDArray[np.float64] | None = None
        self._since = 0.0
        self._detected = False

    def reset(self) -> None:
        """Forget the poses: the robot is not expected to move."""
        self._reference = None

    def update(self, pose: NDArray[np.float64], now: float) -> bool:
        """Return whether the robot stands still, once for each standstill.

        Args:
            pose: `[x, y, theta]`, shape (3,) (m, m, rad).
            now: Monotonic time (s).
        """
        if self._reference is None or _moved(pose - self._reference):
            self._reference, self._since, self._detected = pose, now, False
            return False
        if self._detected or now - self._since < PATIENCE:
            return False
        self._detected = True
        return True


def _moved(difference: NDArray[np.float64]) -> bool:
    x, y, theta = (float(value) for value in difference)
    return math.hypot(x, y) > MIN_DISTANCE or abs(math.remainder(theta, math.tau)) > MIN_ROTATION
