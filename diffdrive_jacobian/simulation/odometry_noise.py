"""Odometry covariance of first order: propagated with the Jacobians of the motion.

The covariance of the pose is right while the standard deviation of the heading is small, and too small
afterwards. It is here for comparison. The robot publishes the exact one of `exact_moments`.

Model: the variance of the distance travelled by each wheel grows by `k |ds|` (m^2; k in m),
independently of the other wheel. The covariance is the integral along the exact arc, not a sum over
steps, so it does not depend on the rate at which it is computed:

    P(T) = Phi P(0) Phi^T + integral_0^T g(s) W g(s)^T ds,  g(s) = Phi(T, s) S(theta_s)

Source: doc/mathematics.md, "Odometry covariance"; the noise model is that of Siegwart, Nourbakhsh,
Scaramuzza, *Introduction to Autonomous Mobile Robots*, 5.2.4.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.numerics.checks import floats, not_negative, positive
from diffdrive_jacobian.numerics.elementary import (
    agree,
    components,
    cos,
    evaluated,
    operand,
    sin,
    sinc,
    sinc_defect,
    stack,
)

ROUNDING = 1e-8
"""Tolerance on symmetry and semidefiniteness of a covariance, relative to its largest entry."""


def twist_covariance(
    twist: ArrayLike, L: Any, wheel_travel_variance: Any, interval: Any
) -> NDArray[np.float64]:
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
    v, omega = components('twist', twist, 2)
    L, k = (
        operand('L', L, positive),
        operand('wheel_travel_variance', wheel_travel_variance, not_negative),
    )
    interval = operand('interval', interval, positive)
    single = agree(twist=v, L=L, wheel_travel_variance=k, interval=interval)
    names = 'twist, L, wheel_travel_variance and interval'
    return _matrix(*evaluated(single, names, _twist_covariance, v, omega, L, k, interval))


def _twist_covariance(v: Any, omega: Any, L: Any, k: Any, interval: Any) -> tuple[Any, ...]:
    right, left = _wheel_variances(v, omega, L, k)
    cross = (right - left) / (2.0 * L * interval)
    return (right + left) / (4.0 * interval), cross, cross, (right + left) / (L * L * interval)


def twist_covariance_entries(
    twist: tuple[float, float], L: float, wheel_travel_variance: float, interval: float
) -> tuple[float, float, float, float]:
    """Compute what `twist_covariance` returns for one robot whose values were checked before, by rows.

    Raises:
        ValueError: The result overflows.
    """
    v, omega = twist
    half = omega * L / 2.0
    right, left = wheel_travel_variance * abs(v + half), wheel_travel_variance * abs(v - half)
    try:
        both, cross = right + left, (right - left) / (2.0 * L * interval)
        vv, ww = both / (4.0 * interval), both / (L * L * interval)
    except ZeroDivisionError:
        vv = math.inf
    if not (math.isfinite(vv) and math.isfinite(cross) and math.isfinite(ww)):
        raise ValueError('twist and interval must give a finite result, but it overflows')
    return vv, cross, cross, ww


def propagate_covariance(
    covariance: ArrayLike,
    pose: ArrayLike,
    twist: ArrayLike,
    dt: Any,
    L: Any,
    wheel_travel_variance: Any,
) -> NDArray[np.float64]:
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
    entries = covariance_entries('covariance', covariance)
    _, _, theta = components('pose', pose, 3)
    v, omega = components('twist', twist, 2)
    dt = operand('dt', dt, not_negative)
    L, k = (
        operand('L', L, positive),
        operand('wheel_travel_variance', wheel_travel_variance, not_negative),
    )
    single = agree(covariance=entries[0], pose=theta, twist=v, dt=dt, L=L, wheel_travel_variance=k)
    names = 'covariance, pose, twist, dt, L and wheel_travel_variance'
    return _matrix(*evaluated(single, names, _propagated, *entries, theta, v, omega, dt, L, k))


def covariance_entries(name: str, covariance: ArrayLike) -> tuple[Any, ...]:
    """Return the entries xx, xy, xt, yy, yt, tt of covariances of a pose, shape (..., 3, 3).

    Raises:
        ValueError: The shape is another one, an entry is not finite, or the matrix is not symmetric and
            positive semidefinite up to rounding.
    """
    made = floats(name, covariance)
    if made.shape[-2:] != (3, 3):
        raise ValueError(f'{name} must have shape (..., 3, 3), got {made.shape}')
    rows = components(name, made.reshape(*made.shape[:-2], 9), 9)
    if made.ndim == 2:
        valid: Any = min(_margins(max(map(abs, rows)), *rows)) >= -ROUNDING
    else:
        largest = np.abs(made).max(axis=(-2, -1), initial=0.0)
        valid = np.min(np.stack(_margins(largest, *rows)), axis=0) >= -ROUNDING
    if valid is not True and not np.all(valid):
        index = tuple(np.argwhere(~np.asarray(valid))[0])
        raise ValueError(
            f'{name} must be symmetric and positive semidefinite, got {made[index].tolist()}'
        )
    xx, xy, xt, _, yy, yt, _, _, tt = rows
    return xx, xy, xt, yy, yt, tt


def _margins(
    largest: Any,
    xx: Any,
    xy: Any,
    xt: Any,
    yx: Any,
    yy: Any,
    yt: Any,
    tx: Any,
    ty: Any,
    tt: Any,
) -> tuple[Any, ...]:
    """Compute quantities that must not be negative: all principal minors, and minus the asymmetry.

    They are relative to the largest entry, so that products do not overflow.
    """
    scale = largest + (largest == 0.0)
    a, b, c, d, e, f = xx / scale, xy / scale, xt / scale, yy / scale, yt / scale, tt / scale
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return (
        *(a, d, f, a * d - b * b, a * f - c * c, d * f - e * e, determinant),
        *(-abs(yx / scale - b), -abs(tx / scale - c), -abs(ty / scale - e)),
    )


def _propagated(
    pxx: Any,
    pxy: Any,
    pxt: Any,
    pyy: Any,
    pyt: Any,
    ptt: Any,
    theta: Any,
    v: Any,
    omega: Any,
    dt: Any,
    L: Any,
    wheel_travel_variance: Any,
) -> tuple[Any, ...]:
    turn, path = omega * dt, v * dt
    c, s = cos(theta + turn), sin(theta + turn)
    # The displacement, in the body frame at the end of the arc, then in the world frame.
    along, across = path * sinc(turn), -path * sinc(turn / 2.0) * sin(turn / 2.0)
    dx, dy = c * along - s * across, s * along + c * across
    # The noise, rotated from the body frame at the end into the world frame.
    xx, xy, xt, yy, yt, tt = _noise_at_end(v, omega, dt, L, wheel_travel_variance)
    # Phi P Phi^T, written out for Phi = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]].
    end_xx = pxx - 2.0 * dy * pxt + dy * dy * ptt + c * c * xx - 2.0 * c * s * xy + s * s * yy
    end_xy = pxy - dy * pyt + dx * pxt - dx * dy * ptt + c * s * (xx - yy) + (c * c - s * s) * xy
    end_xt = pxt - dy * ptt + c * xt - s * yt
    end_yy = pyy + 2.0 * dx * pyt + dx * dx * ptt + s * s * xx + 2.0 * c * s * xy + c * c * yy
    end_yt = pyt + dx * ptt + s * xt + c * yt
    end_tt = ptt + tt
    return end_xx, end_xy, end_xt, end_xy, end_yy, end_yt, end_xt, end_yt, end_tt


def _wheel_variances(v: Any, omega: Any, L: Any, wheel_travel_variance: Any) -> tuple[Any, Any]:
    """Compute the growth rates of the variances of right and left wheel travel (m^2/s)."""
    half = omega * L / 2.0
    return wheel_travel_variance * abs(v + half), wheel_travel_variance * abs(v - half)


def _noise_at_end(v: Any, omega: Any, dt: Any, L: Any, wheel_travel_variance: Any) -> Any:
    """Integrate `g W g^T` over an arc, in the body frame at its end; entries xx, xy, xt, yy, yt, tt.

    With the remaining turn phi = omega (T - s), the columns of g are `[cos phi, -sin phi, 0]` and
    `[v (1 - cos phi) / omega, v sin(phi) / omega, 1]`. The integrals over s are written so that no
    digits cancel as omega goes to zero. Terms that would cancel are in `sinc_defect`.
    """
    right, left = _wheel_variances(v, omega, L, wheel_travel_variance)
    # W = [[vv, vw], [vw, ww]], times the duration.
    vv, vw, ww = (
        (right + left) / 4.0 * dt,
        (right - left) / (2.0 * L) * dt,
        (right + left) / (L * L) * dt,
    )
    turn, path = omega * dt, v * dt
    whole, half = sinc(turn), sinc(turn / 2.0)
    once, twice = sinc_defect(turn), sinc_defect(2.0 * turn)
    cosine = cos(turn)
    return (
        vv * (1.0 + whole * cosine) / 2.0
        + vw * path * turn * 2.0 * (2.0 * twice - once)
        + ww * (path * path) * 2.0 * (once - twice),
        -vv * turn * whole**2 / 2.0
        + vw * path * half**2 * cosine / 2.0
        + ww * (path * path) * turn * half**4 / 8.0,
        vw * whole + ww * path * turn * once,
        2.0 * twice * (vv * (turn * turn) - 2.0 * vw * path * turn + ww * (path * path)),
        -vw * turn / 2.0 * half**2 + ww * path * half**2 / 2.0,
        ww,
    )


def _matrix(*entries: Any) -> NDArray[np.float64]:
    """Build square matrices from entries that broadcast, row by row."""
    size = math.isqrt(len(entries))
    matrix = stack(*entries)
    return matrix.reshape(*matrix.shape[:-1], size, size)
