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

"""The numbers that the page shows for one robot, computed by the library."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Arrival
from diffdrive_jacobian.kinematics import diff_drive
from diffdrive_jacobian.kinematics.se2 import wrap_angle

Array = NDArray[np.float64]
Pair = tuple[float, float]
CHI_SQUARE_95 = 5.991464547107979
"""95 % of a normal distribution in the plane are within this squared Mahalanobis distance."""
DIGITS = 6
"""Significant digits of the numbers that the page receives."""


def rounded(value: Any) -> Any:
    """Return a number, or nested numbers, with a few digits. What is not finite becomes None."""
    if isinstance(value, (list, tuple)):
        return [rounded(one) for one in value]
    if isinstance(value, np.ndarray):
        return rounded(value.tolist())
    if isinstance(value, (float, np.floating)):
        return float(f'{value:.{DIGITS}g}') if math.isfinite(value) else None
    return value


def region(covariance: Array) -> dict[str, Any] | None:
    """Return the ellipse that contains the position with 95 %, of a covariance, shape (3, 3).

    Returns:
        Half axes `a >= b` (m), the direction of a (rad), and 1.96 standard deviations of the heading
        (rad). None: the covariance is zero or invalid.
    """
    if not np.isfinite(covariance).all() or not covariance[:2, :2].any():
        return None
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    if values[0] < -1e-9 * values[1]:
        return None
    b, a = np.sqrt(CHI_SQUARE_95 * np.maximum(values, 0.0))
    angle = math.atan2(vectors[1, 1], vectors[0, 1])
    sigma = math.sqrt(max(0.0, float(covariance[2, 2])))
    return {'a': rounded(a), 'b': rounded(b), 'angle': rounded(angle), 'heading': rounded(1.96 * sigma)}


def errors(pose: Array, goal: Array, offset: float) -> Pair:
    """Return the distance of the driven point to a goal (m), and the bearing error (rad).

    Pose and goal are `[x, y, theta]`, offset is the x coordinate of the point in the body frame (m).
    """
    x, y, theta = pose.tolist()
    distance = float(Arrival(offset=offset).distance(x, y, theta, float(goal[0]), float(goal[1])))
    direction = math.atan2(float(goal[1]) - y, float(goal[0]) - x)
    return distance, float(wrap_angle(direction - theta))


def chain(
    theta: float,
    command: Pair,
    measured: Pair | None,
    geometry: Pair,
    radius_multipliers: Pair = (1.0, 1.0),
) -> dict[str, Any]:
    """Compute the chain from the commanded twist to the velocity in the world.

    Args:
        theta: Heading (rad).
        command: `(v, omega)` as commanded (m/s, rad/s).
        measured: Wheel speeds `(omega_R, omega_L)` as measured (rad/s). None: as commanded.
        geometry: Wheel radius and separation (m).
        radius_multipliers: Radii of the right and the left wheel, relative to that.

    Returns:
        Matrices and vectors. `measured` says whether the second half follows from measured wheel speeds.
    """
    scale = np.array(radius_multipliers)
    inverse = diff_drive.body_to_wheel_jacobian(*geometry) / scale[:, np.newaxis]
    forward = diff_drive.wheel_to_body_jacobian(*geometry) * scale
    wanted = inverse @ np.array(command)
    wheels = wanted if measured is None else np.array(measured)
    twist = forward @ wheels
    jacobian = diff_drive.unicycle_jacobian(theta)
    return {
        'command': rounded(command),
        'inverse': rounded(inverse),
        'wanted': rounded(wanted),
        'wheels': rounded(wheels),
        'measured': measured is not None,
        'forward': rounded(forward),
        'twist': rounded(twist),
        'unicycle': rounded(jacobian),
        'world': rounded(jacobian @ twist),
    }
