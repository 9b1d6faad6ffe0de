"""Rigid motions of the plane, SE(2).

Model: a pose `[x, y, theta]` (m, m, rad) is the placement of a frame B in a frame W, x forward,
y left, theta counter-clockwise and wrapped to (-pi, pi]. A twist `[vx, vy, omega]` (m/s, m/s,
rad/s) is a velocity in B.

Everything broadcasts over leading axes: a pose has shape (..., 3). Wrong shapes, values that are not
finite, and results that overflow raise ValueError, in single and in batched calls.

Source: doc/mathematics.md, "Motion"; document B for the homogeneous transform.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.numerics import elementary
from diffdrive_jacobian.numerics.checks import array
from diffdrive_jacobian.numerics.elementary import (
    agree,
    components,
    cos,
    evaluated,
    operand,
    sin,
    stack,
    wrapped,
)


def wrap_angle(angle: ArrayLike) -> Any:
    """Wrap angles to (-pi, pi].

    The result is exact with respect to the double nearest to 2 pi. An angle in the interval is returned
    unchanged.

    Args:
        angle: Angles, any shape (rad).

    Returns:
        The wrapped angles, same shape (rad).

    Raises:
        ValueError: An angle is infinite or NaN.
    """
    return wrapped(operand('angle', angle))


def sinc(angle: ArrayLike) -> Any:
    """Compute sin(angle) / angle, which is 1 at zero (not NumPy's sin(pi x) / (pi x)).

    Args:
        angle: Angles, any shape (rad).

    Returns:
        The quotients, same shape.

    Raises:
        ValueError: An angle is infinite or NaN.
    """
    return elementary.sinc(operand('angle', angle))


def exp(twist: ArrayLike) -> NDArray[np.float64]:
    """Return the pose after motion from the identity with a constant twist for unit time.

    Args:
        twist: `[vx, vy, omega]`, shape (..., 3): velocity in B times time (m, m, rad).

    Returns:
        The pose reached, shape (..., 3), theta wrapped.
    """
    vx, vy, turn = components('twist', twist, 3)
    return stack(*evaluated(type(turn) is float, 'twist', _exp, vx, vy, turn))


def _exp(vx: Any, vy: Any, turn: Any) -> tuple[Any, ...]:
    chord = elementary.sinc(turn / 2.0)
    along, across = chord * cos(turn / 2.0), chord * sin(turn / 2.0)
    return along * vx - across * vy, across * vx + along * vy, wrapped(turn)


def log(pose: ArrayLike) -> NDArray[np.float64]:
    """Return the twist that reaches a pose from the identity in unit time, the inverse of `exp`.

    Args:
        pose: `[x, y, theta]`, shape (..., 3).

    Returns:
        The twist `[vx, vy, omega]`, shape (..., 3), with the turn of least magnitude.
    """
    x, y, theta = components('pose', pose, 3)
    return stack(*evaluated(type(theta) is float, 'pose', _log, x, y, theta))


def _log(x: Any, y: Any, theta: Any) -> tuple[Any, ...]:
    turn = wrapped(theta)
    along = cos(turn / 2.0) / elementary.sinc(turn / 2.0)
    return along * x + turn / 2.0 * y, along * y - turn / 2.0 * x, turn


def compose(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Return the composition of two poses: `second`, given in the frame B of `first`, in the frame W.

    Args:
        first: Pose of B in W, shape (..., 3).
        second: Pose of C in B, shape (..., 3).

    Returns:
        Pose of C in W, shape (..., 3), theta wrapped.
    """
    x, y, theta = components('first', first, 3)
    dx, dy, turn = components('second', second, 3)
    single = agree(first=x, second=dx)
    return stack(*evaluated(single, 'first and second', _compose, x, y, theta, dx, dy, turn))


def _compose(x: Any, y: Any, theta: Any, dx: Any, dy: Any, turn: Any) -> tuple[Any, ...]:
    c, s = cos(theta), sin(theta)
    return x + c * dx - s * dy, y + s * dx + c * dy, wrapped(theta + turn)


def inverse(pose: ArrayLike) -> NDArray[np.float64]:
    """Return the pose of W in B for the pose of B in W, shape (..., 3), theta wrapped."""
    x, y, theta = components('pose', pose, 3)
    return stack(*evaluated(type(theta) is float, 'pose', _inverse, x, y, theta))


def _inverse(x: Any, y: Any, theta: Any) -> tuple[Any, ...]:
    c, s = cos(theta), sin(theta)
    return -c * x - s * y, s * x - c * y, wrapped(-theta)


def adjoint(pose: ArrayLike) -> NDArray[np.float64]:
    """Return the adjoint of a pose: it maps a twist in B to the same motion as a twist in W.

    `compose(pose, exp(twist)) = compose(exp(adjoint(pose) @ twist), pose)`.

    Args:
        pose: Pose of B in W, shape (..., 3).

    Returns:
        Matrices over `[vx, vy, omega]`, shape (..., 3, 3).
    """
    x, y, theta = components('pose', pose, 3)
    c, s = cos(theta), sin(theta)
    matrix = np.zeros((*np.shape(x), 3, 3))
    matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2] = c, -s, y
    matrix[..., 1, 0], matrix[..., 1, 1], matrix[..., 1, 2] = s, c, -x
    matrix[..., 2, 2] = 1.0
    return matrix


def left_jacobian(twist: ArrayLike) -> NDArray[np.float64]:
    """Return the left Jacobian of `exp`: `exp(t + d) = compose(exp(J d), exp(t))` to first order in d.

    Source: Barfoot and Furgale, "Associating uncertainty with three-dimensional poses for use in
    estimation problems", 2014, for SE(3); here for SE(2).

    Args:
        twist: `[vx, vy, omega]`, shape (..., 3): velocity in B times time (m, m, rad).

    Returns:
        Jacobians J, shape (..., 3, 3).
    """
    vx, vy, turn = components('twist', twist, 3)
    single = type(turn) is float
    along, across, bent, bowed = evaluated(single, 'twist', _exp_coefficients, turn)
    matrix = np.zeros((*np.shape(turn), 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = along
    matrix[..., 0, 1], matrix[..., 1, 0] = -across, across
    # The bowed part grows with the turn, the bent one does not vanish with it.
    matrix[..., 0, 2], matrix[..., 1, 2] = evaluated(
        single,
        'twist',
        lambda: (bowed * vx + bent * vy, bowed * vy - bent * vx),
    )
    matrix[..., 2, 2] = 1.0
    return matrix


def right_jacobian(twist: ArrayLike) -> NDArray[np.float64]:
    """Return the right Jacobian of `exp`: `exp(t + d) = compose(exp(t), exp(J d))` to first order in d.

    Arguments and results as for `left_jacobian`, which is this one at the negative twist.
    """
    return left_jacobian(-array('twist', twist, 3))


def _exp_coefficients(turn: Any) -> tuple[Any, ...]:
    """Compute sin(a)/a, (1 - cos(a))/a, (1 - cos(a))/a^2 and (a - sin(a))/a^2 of a turn a."""
    chord = elementary.sinc(turn / 2.0)
    across = chord * sin(turn / 2.0)
    return chord * cos(turn / 2.0), across, chord * chord / 2.0, turn * elementary.sinc_defect(turn)


def homogeneous(pose: ArrayLike) -> NDArray[np.float64]:
    """Return the homogeneous transform `H_B^W` of a pose (document B).

    Args:
        pose: `[x, y, theta]`, shape (..., 3).

    Returns:
        Transforms, shape (..., 3, 3): they map `[x, y, 1]` in B to W.
    """
    x, y, theta = components('pose', pose, 3)
    c, s = cos(theta), sin(theta)
    transform = np.zeros((*np.shape(x), 3, 3))
    transform[..., 0, 0], transform[..., 0, 1], transform[..., 0, 2] = c, -s, x
    transform[..., 1, 0], transform[..., 1, 1], transform[..., 1, 2] = s, c, y
    transform[..., 2, 2] = 1.0
    return transform


def integrate(pose: ArrayLike, twist: ArrayLike, dt: ArrayLike) -> NDArray[np.float64]:
    """Return the pose after a constant twist of a unicycle, the exact arc `q * Exp(u dt)`.

    Source: doc/mathematics.md, "Motion".

    The chord `v dt sin(a/2)/(a/2)` along the heading `theta + a/2`, `a = omega dt`, loses no digits
    for small turns.

    Args:
        pose: `[x, y, theta]` at the start, shape (..., 3).
        twist: `[v, omega]` (m/s, rad/s), shape (..., 2).
        dt: Duration of the twist (s), shape (...). Negative: backward in time.

    Returns:
        The pose at the end, shape (..., 3), theta wrapped.
    """
    x, y, theta = components('pose', pose, 3)
    v, omega = components('twist', twist, 2)
    dt = operand('dt', dt)
    single = agree(pose=x, twist=v, dt=dt)
    return stack(*evaluated(single, 'pose, twist and dt', _arc, x, y, theta, v, omega, dt))


def _arc(x: Any, y: Any, theta: Any, v: Any, omega: Any, dt: Any) -> tuple[Any, ...]:
    turn = omega * dt
    chord = v * dt * elementary.sinc(turn / 2.0)
    heading = theta + turn / 2.0
    return x + chord * cos(heading), y + chord * sin(heading), wrapped(theta + turn)
