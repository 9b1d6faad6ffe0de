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

"""Motion of the body between two times from the angles of the wheels, and its Jacobian.

Source: doc/moments.md, "Calibration". Poses are `[x, y, theta]` (m, m, rad). The multipliers are
ordered left wheel radius, right wheel radius, wheel separation, as the parameters of `wheel_bridge`
and of diff_drive_controller. Angles of the wheels are ordered right, left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.kinematics.se2 import compose, inverse
from diffdrive_jacobian.numerics.elementary import sinc

Array = NDArray[np.float64]

LATERAL = 1e-4
"""Variance of lateral motion relative to that of forward motion; the model itself has none, so that
the covariance of a short increment would be singular."""

REST = 1e-6
"""Variance of each step in x and y for the wheel travel variance 1 m, even at rest (m)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Geometry:
    """Nominal dimensions of the robot and their multipliers."""

    wheel_radius: float
    """Nominal radius (m)."""
    wheel_separation: float
    """Nominal separation (m)."""
    multipliers: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Of the left wheel radius, the right wheel radius and the wheel separation."""

    @property
    def radii(self) -> tuple[float, float]:
        """Radius of the right and the left wheel (m)."""
        left, right, _ = self.multipliers
        return self.wheel_radius * right, self.wheel_radius * left

    @property
    def separation(self) -> float:
        """Wheel separation (m)."""
        return self.wheel_separation * self.multipliers[2]


@dataclass(frozen=True, kw_only=True, slots=True)
class Increments:
    """Motion between n consecutive times, in the frame of the body."""

    poses: Array
    """Pose at each time in the frame of the first, shape (n, 3); theta is not wrapped."""
    steps: Array
    """Pose at each time in the frame of the time before, shape (n - 1, 3)."""
    jacobian: Array
    """Derivative of `steps` with respect to the logarithms of the multipliers, as a twist in the frame
    at the end of each step, shape (n - 1, 3, 3)."""
    covariance: Array
    """Covariance of `steps` in the frame at their ends, for the wheel travel variance 1 m, shape
    (n - 1, 3, 3)."""
    rates: Array
    """Body twist `[v, 0, omega]` at each time, shape (n, 3)."""
    travel: Array
    """Sum of the distances that both wheels travel in each step, shape (n - 1,) (m)."""


def increments(time: Array, angles: Array, at: Array, geometry: Geometry) -> Increments:
    """Integrate the motion between given times, as exact arcs between the samples of the wheels.

    Args:
        time: Times of the samples of the wheels, increasing, shape (m,) (s).
        angles: Angles of the right and the left wheel there, shape (m, 2) (rad).
        at: Increasing times within those of the wheels, shape (n,), n at least 2 (s).
        geometry: Radii and separation of the wheels.
    """
    inner = slice(*np.searchsorted(time, [at[0], at[-1]], side='right').tolist())
    knots = np.concatenate([time[inner], at])
    order = np.argsort(knots, kind='stable')
    knots = knots[order]
    marks = np.flatnonzero(order >= len(time[inner]))
    """Where the given times are among the knots."""
    radius = np.array(geometry.radii)
    L = geometry.separation
    rims = np.column_stack([np.interp(knots, time, angles[:, side]) for side in (0, 1)]) * radius
    right, left = np.diff(rims, axis=0).T
    s, a = (right + left) / 2.0, (right - left) / L
    theta = np.concatenate([[0.0], np.cumsum(a)])
    middle = theta[:-1] + a / 2.0
    shrink = sinc(a / 2.0)
    chords = (s * shrink)[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(chords, axis=0)])
    poses = np.column_stack([places, theta])[marks]
    ends = np.repeat(marks[1:], np.diff(marks))
    cosine, sine = np.cos(theta[ends]), np.sin(theta[ends])
    # A turn acts about the centroid of the arc, which lies off the middle of its chord.
    bulge = s * _sinc_slope(a / 2.0) / 2.0
    centroid = (places[:-1] + places[1:]) / 2.0
    dx = places[ends, 0] - centroid[:, 0] + bulge * np.sin(middle)
    dy = places[ends, 1] - centroid[:, 1] - bulge * np.cos(middle)
    lever_x, lever_y = cosine * dx + sine * dy, cosine * dy - sine * dx
    heading = middle - theta[ends]
    c, n = np.cos(heading), np.sin(heading)
    # Of each sub-step: the twists at the end of the step for a unit of s, of a, and to the side.
    fx, fy, tx, ty = c * shrink, n * shrink, -lever_y, lever_x
    by_left = [fx * left / 2.0 - tx * left / L, fy * left / 2.0 - ty * left / L, -left / L]
    by_right = [fx * right / 2.0 + tx * right / L, fy * right / 2.0 + ty * right / L, right / L]
    by_separation = [-tx * a, -ty * a, -a]
    vr, vl = np.abs(right), np.abs(left)
    vv, vw, ww = (vr + vl) / 4.0, (vr - vl) / (2.0 * L), (vr + vl) / L**2
    side = ww * (s * shrink) ** 2 / 12.0 + LATERAL * vv
    variances = [
        fx * fx * vv + 2.0 * fx * tx * vw + tx * tx * ww + n * n * side,
        fx * fy * vv + (fx * ty + fy * tx) * vw + tx * ty * ww - n * c * side,
        fx * vw + tx * ww,
        fy * fy * vv + 2.0 * fy * ty * vw + ty * ty * ww + c * c * side,
        fy * vw + ty * ww,
        ww,
    ]
    rows = np.stack([*by_left, *by_right, *by_separation, *variances, vr + vl])
    sums = np.add.reduceat(rows, marks[:-1], axis=1)
    symmetric = sums[[9, 10, 11, 10, 12, 13, 11, 13, 14]].reshape(3, 3, -1)
    least = np.diag([1.0, 1.0, 4.0 / L**2]) * REST
    return Increments(
        poses=poses,
        steps=relative(poses[:-1], poses[1:]),
        jacobian=np.moveaxis(sums[:9].reshape(3, 3, -1), (0, 1, 2), (2, 1, 0)),
        covariance=np.moveaxis(symmetric, 2, 0) + least,
        rates=_rates(time, angles * radius, at, L),
        travel=sums[15],
    )


def _sinc_slope(h: Array) -> Array:
    """Return the derivative of sinc, `(cos h - sinc h) / h`."""
    small = np.abs(h) < 1e-2
    safe = np.where(small, 1.0, h)
    return np.where(small, -h / 3.0 + h**3 / 30.0, (np.cos(h) - sinc(h)) / safe)


def _rates(time: Array, rims: Array, at: Array, L: float) -> Array:
    """Return the mean body twist `[v, 0, omega]` about given times, shape (n, 3).

    The mean over two sample periods overlooks the kinks of the angles at the samples.
    """
    half = float(np.median(np.diff(time)))
    ends = np.clip(np.stack([at - half, at + half]), time[0], time[-1])
    here = np.stack([np.interp(ends, time, rims[:, side]) for side in (0, 1)])
    right, left = (here[:, 1] - here[:, 0]) / np.maximum(ends[1] - ends[0], 1e-9)
    return np.column_stack([(right + left) / 2.0, np.zeros_like(right), (right - left) / L])


# Poses whose theta is not wrapped: it counts the turns of the drive.


def relative(first: Array, second: Array) -> Array:
    """Return the second pose in the frame of the first, shape (..., 3); theta is not wrapped."""
    dx, dy, turn = np.moveaxis(second - first, -1, 0)
    x, y, _ = compose.formula([0.0, 0.0, -first[..., 2]], [dx, dy, 0.0])
    return np.stack([x, y, turn], axis=-1)


def composed(first: Array, second: Array) -> Array:
    """Return a pose that is given in the frame of the first, shape (..., 3); theta is not wrapped."""
    x, y, _ = compose.formula(np.moveaxis(first, -1, 0), np.moveaxis(second, -1, 0))
    return np.stack([x, y, first[..., 2] + second[..., 2]], axis=-1)


def inverted(pose: Array) -> Array:
    """Return the inverse of poses, shape (..., 3); theta is not wrapped."""
    x, y, _ = inverse.formula(np.moveaxis(pose, -1, 0))
    return np.stack([x, y, -pose[..., 2]], axis=-1)
