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

"""Odometry covariance of first order: propagated with the Jacobians of the motion.

Model: the variance of the distance travelled by each wheel grows by `k |ds|` (m^2; k in m), for
each independently. The covariance of the pose is the integral along the exact arc:

    P(T) = Phi P(0) Phi^T + integral_0^T g(s) W g(s)^T ds,  g(s) = Phi(T, s) S(theta_s)

It is right while the standard deviation of the heading is small, see `exact_moments`.

Source: doc/moments.md, "Odometry covariance"; the noise model is that of Siegwart, Nourbakhsh,
Scaramuzza, *Introduction to Autonomous Mobile Robots*, 5.2.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics.se2 import integrate
from diffdrive_jacobian.numerics.checks import array, not_negative, positive, semidefinite
from diffdrive_jacobian.numerics.elementary import cos, product, sin, sinc, sinc_defect
from diffdrive_jacobian.numerics.formula import Number, Rows, Vector, formula


@formula('(2),(),(),() -> (2,2)', L=positive, wheel_travel_variance=not_negative, interval=positive)
def twist_covariance(twist: Vector, L: Number, wheel_travel_variance: Number, interval: Number) -> Rows:
    """Compute the covariance of a twist measured from wheel travel over an interval, `W / interval`.

    Args:
        twist: `[v, omega]`, shape (..., 2) (m/s, rad/s).
        L: Wheel separation, positive, shape (...) (m).
        wheel_travel_variance: k, variance per distance travelled of each wheel, zero or positive, shape
            (...) (m).
        interval: Time over which the travel is measured, positive, shape (...) (s).

    Returns:
        Covariance of `[v, omega]`, shape (..., 2, 2).

    Raises:
        ValueError: An argument has a wrong shape or sign, is not finite, or the result overflows.
    """
    v, omega = twist
    vv, vw, ww = spectral_densities(v, omega, L, wheel_travel_variance)
    return [[vv / interval, vw / interval], [vw / interval, ww / interval]]


def spectral_densities(v: Number, omega: Number, L: Number, k: Number) -> tuple[Number, Number, Number]:
    """Return the entries vv, vw, ww of W, the spectral density of the noise of `[v, omega]`."""
    right, left = k * abs(v + omega * L / 2.0), k * abs(v - omega * L / 2.0)
    return (right + left) / 4.0, (right - left) / (2.0 * L), (right + left) / L / L


@formula(
    '(3,3),(3),(2),(),(),() -> (3,3)',
    covariance=semidefinite,
    dt=not_negative,
    L=positive,
    wheel_travel_variance=not_negative,
)
def propagate_covariance(
    covariance: Vector, pose: Vector, twist: Vector, dt: Number, L: Number, wheel_travel_variance: Number
) -> Rows:
    """Propagate the covariance of a pose along an arc.

    Args:
        covariance: Covariance of `[x, y, theta]` at the start, symmetric and positive semidefinite up
            to rounding, shape (..., 3, 3).
        pose: Pose at the start, shape (..., 3).
        twist: The constant twist, `[v, omega]`, shape (..., 2) (m/s, rad/s).
        dt: Duration, zero or positive, shape (...) (s).
        L: Wheel separation, positive, shape (...) (m).
        wheel_travel_variance: k, variance per distance travelled of each wheel, zero or positive, shape
            (...) (m).

    Returns:
        Covariance of the pose at the end, shape (..., 3, 3), symmetric.

    Raises:
        ValueError: An argument has a wrong shape or sign, is not finite, or the result overflows; the
            covariance is not symmetric and positive semidefinite.
    """
    (_, _, theta), (v, omega) = pose, twist
    dx, dy, _ = integrate.formula([0.0, 0.0, theta], [v, omega], dt)
    Phi = [[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]]
    # The noise is computed in the frame of the body at the end.
    end = theta + omega * dt
    R = [[cos(end), -sin(end), 0.0], [sin(end), cos(end), 0.0], [0.0, 0.0, 1.0]]
    Q = _noise_at_end(v, omega, dt, L, wheel_travel_variance)
    before, added = _congruent(Phi, covariance), _congruent(R, Q)  # Phi P Phi^T and R Q R^T
    return [[p + q for p, q in zip(*rows, strict=True)] for rows in zip(before, added, strict=True)]


def _congruent(A: Rows, P: Rows) -> Rows:
    """Return `A P A^T`, symmetric to the last bit."""
    M = product(product(A, P), list(zip(*A, strict=True)))
    return [[(M[i][j] + M[j][i]) / 2.0 for j in range(3)] for i in range(3)]


def _noise_at_end(v: Number, omega: Number, dt: Number, L: Number, k: Number) -> Rows:
    """Integrate `g W g^T` over an arc, in the frame of the body at its end.

    With the remaining turn phi = omega (T - s), the columns of g are `[cos phi, -sin phi, 0]` and
    `[v (1 - cos phi) / omega, v sin(phi) / omega, 1]`. The integrals over s are written so that no
    digits cancel as omega goes to zero. Terms that would cancel are in `sinc_defect`.
    """
    vv, vw, ww = (density * dt for density in spectral_densities(v, omega, L, k))
    turn, path = omega * dt, v * dt
    whole, half = sinc(turn), sinc(turn / 2.0)
    once, twice = sinc_defect(turn), sinc_defect(2.0 * turn)
    xx = (
        vv * (1.0 + whole * cos(turn)) / 2.0
        + vw * path * turn * 2.0 * (2.0 * twice - once)
        + ww * path**2 * 2.0 * (once - twice)
    )
    xy = (
        -vv * turn * whole**2 / 2.0
        + vw * path * half**2 * cos(turn) / 2.0
        + ww * path**2 * turn * half**4 / 8.0
    )
    xt = vw * whole + ww * path * turn * once
    yy = 2.0 * twice * (vv * turn**2 - 2.0 * vw * path * turn + ww * path**2)
    yt = (ww * path - vw * turn) * half**2 / 2.0
    return [[xx, xy, xt], [xy, yy, yt], [xt, yt, ww]]


def covariance_of_pose(name: str, covariance: ArrayLike) -> NDArray[np.float64]:
    """Return the covariance of one pose, shape (3, 3), symmetric and positive semidefinite."""
    made = array(name, covariance, 3, 3)
    if made.ndim != 2:
        raise ValueError(f'{name} must have shape (3, 3), got {made.shape}')
    semidefinite(name, made)
    return made
