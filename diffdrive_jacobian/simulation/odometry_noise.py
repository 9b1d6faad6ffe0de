"""How sure odometry is of itself: the covariance of pose and twist, through the motion's Jacobians.

Model: the travel of each wheel has a variance that grows with its way, `k |ds|` (m^2; k in m),
independently of the other wheel. The covariance is the integral along the exact arc, not a sum over
ticks, so it does not depend on how often it is asked for:

    P(T) = Phi P(0) Phi^T + integral_0^T g(s) W g(s)^T ds,  g(s) = Phi(T, s) S(theta_s)

Source: MATH.md, "Motion of a virtual robot"; the noise model is that of Siegwart, Nourbakhsh,
Scaramuzza, *Introduction to Autonomous Mobile Robots*, 5.2.4.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._elementary import components, cos, operand, sin, stack, where
from diffdrive_jacobian.kinematics.se2 import sinc

# Taylor coefficients of _sinc_defect in the square of its argument, (-1)^n / (2n + 3)!
_DEFECT = [(-1.0) ** n / math.factorial(2 * n + 3) for n in range(9)]


def twist_covariance(
    twist: ArrayLike, L: float, wheel_travel_variance: float, interval: float
) -> NDArray[np.float64]:
    """Give the covariance of a twist measured by the wheels' travel over an interval: `W / interval`.

    Args:
        twist: `[v, omega]`, shape (..., 2) (m/s, rad/s).
        L: Wheel separation (m).
        wheel_travel_variance: k, variance per way of each wheel (m).
        interval: Time over which the travel is measured (s).

    Returns:
        Covariance of `[v, omega]`, shape (..., 2, 2).
    """
    v, omega = components('twist', twist, 2)
    right, left = _wheel_variances(v, omega, L, wheel_travel_variance)
    cross = (right - left) / (2.0 * L * interval)
    return _matrix((right + left) / (4.0 * interval), cross, cross, (right + left) / (L**2 * interval))


def propagate_covariance(
    covariance: NDArray[np.float64],
    pose: ArrayLike,
    twist: ArrayLike,
    dt: Any,
    L: float,
    wheel_travel_variance: float,
) -> NDArray[np.float64]:
    """Carry the covariance of a pose along an arc.

    Args:
        covariance: Covariance of `[x, y, theta]` at the start, shape (..., 3, 3).
        pose: Pose at the start, shape (..., 3).
        twist: The twist held, `[v, omega]`, shape (..., 2) (m/s, rad/s).
        dt: Time for which it is held, not negative, shape (...) (s).
        L: Wheel separation (m).
        wheel_travel_variance: k, variance per way of each wheel (m).

    Returns:
        Covariance of the pose at the end, shape (..., 3, 3), symmetric.
    """
    _, _, theta = components('pose', pose, 3)
    v, omega = components('twist', twist, 2)
    dt = operand('dt', dt)
    turn, way = omega * dt, v * dt
    c, s = cos(theta + turn), sin(theta + turn)
    # The displacement, seen from the end of the arc, then in the world.
    along, across = way * sinc(turn), -way * sinc(turn / 2.0) * sin(turn / 2.0)
    dx, dy = c * along - s * across, s * along + c * across
    # Phi P Phi^T, written out for Phi = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]].
    shape = np.shape(covariance)[:-2]
    pxx, pxy, pxt, _, pyy, pyt, _, _, ptt = components(
        'covariance', np.reshape(covariance, (*shape, 9)), 9
    )
    # The noise, turned from the end's frame into the world.
    xx, xy, xt, yy, yt, tt = _noise_at_end(v, omega, dt, L, wheel_travel_variance)
    end_xx = pxx - 2.0 * dy * pxt + dy * dy * ptt + c * c * xx - 2.0 * c * s * xy + s * s * yy
    end_xy = pxy - dy * pyt + dx * pxt - dx * dy * ptt + c * s * (xx - yy) + (c * c - s * s) * xy
    end_xt = pxt - dy * ptt + c * xt - s * yt
    end_yy = pyy + 2.0 * dx * pyt + dx * dx * ptt + s * s * xx + 2.0 * c * s * xy + c * c * yy
    end_yt = pyt + dx * ptt + s * xt + c * yt
    end_tt = ptt + tt
    return _matrix(
        end_xx, end_xy, end_xt, end_xy, end_yy, end_yt, end_xt, end_yt, end_tt
    )  # fmt: skip


def _wheel_variances(v: Any, omega: Any, L: float, wheel_travel_variance: float) -> tuple[Any, Any]:
    """Give how fast the variance of the right and of the left wheel's travel grows (m^2/s)."""
    half = omega * L / 2.0
    return wheel_travel_variance * abs(v + half), wheel_travel_variance * abs(v - half)


def _noise_at_end(v: Any, omega: Any, dt: Any, L: float, wheel_travel_variance: float) -> Any:
    """Integrate `g W g^T` over an arc, in the body frame at its end; entries xx, xy, xt, yy, yt, tt.

    With phi = omega (T - s) the turn that is left, the columns of g are `[cos phi, -sin phi, 0]` and
    `[v (1 - cos phi) / omega, v sin(phi) / omega, 1]`. The integrals over s are written so that no
    digits cancel as omega goes to zero; all that would is in `_sinc_defect`.
    """
    right, left = _wheel_variances(v, omega, L, wheel_travel_variance)
    # W = [[vv, vw], [vw, ww]], times the duration.
    vv, vw, ww = (
        (right + left) / 4.0 * dt,
        (right - left) / (2.0 * L) * dt,
        (right + left) / L**2 * dt,
    )
    turn, way = omega * dt, v * dt
    whole, half = sinc(turn), sinc(turn / 2.0)
    once, twice = _sinc_defect(turn), _sinc_defect(2.0 * turn)
    cosine = cos(turn)
    return (
        vv * (1.0 + whole * cosine) / 2.0
        + vw * way * turn * 2.0 * (2.0 * twice - once)
        + ww * way**2 * 2.0 * (once - twice),
        -vv * turn * whole**2 / 2.0
        + vw * way * half**2 * cosine / 2.0
        + ww * way**2 * turn * half**4 / 8.0,
        vw * whole + ww * way * turn * once,
        2.0 * twice * (vv * turn**2 - 2.0 * vw * way * turn + ww * way**2),
        -vw * turn / 2.0 * half**2 + ww * way * half**2 / 2.0,
        ww,
    )


def _sinc_defect(angle: Any) -> Any:
    """Compute (1 - sin(x)/x) / x^2, which is 1/6 at zero, to full precision."""
    square: Any = angle * angle
    series: Any = 0.0
    for coefficient in reversed(_DEFECT):
        series = series * square + coefficient
    far = where(square < 1.0, 1.0, angle)
    return where(square < 1.0, series, (1.0 - sin(far) / far) / far**2)


def _matrix(*entries: Any) -> NDArray[np.float64]:
    """Build square matrices from entries that broadcast, row by row."""
    size = math.isqrt(len(entries))
    matrix = stack(*entries)
    return matrix.reshape(*matrix.shape[:-1], size, size)
