"""Velocity kinematics of the differential drive: its Jacobians, their chain and their constraints.

State: pose `q = [x, y, theta]` (m, m, rad). Inputs: wheel speeds `w = [omega_R, omega_L]` (rad/s,
positive drives forward) or the body twist `u = [v, omega]` (m/s, rad/s). Wheel radius `r` and wheel
separation `L` in m. **The order of wheels is right, left.**

    w --J_w--> u --S(theta)--> q_dot

Everything broadcasts over leading axes. A radius or separation that is not positive and finite, an
angle or speed that is not finite, shapes that do not broadcast, and results that overflow raise
ValueError, in single and in batched calls.

Source: document A, equations (4)-(8); documents B and E; doc/mathematics.md, "Differential drive".
"""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._dimensions import (
    angle_and_radius,
    dimensions,
    heading_and_dimensions,
)
from diffdrive_jacobian.numerics.checks import offset, positive
from diffdrive_jacobian.numerics.elementary import (
    agree,
    alike,
    components,
    cos,
    evaluated,
    matrix,
    operand,
    sin,
    stack,
)


def unicycle_jacobian(theta: ArrayLike) -> NDArray[np.float64]:
    """Map the body twist to the velocity in the world: `q_dot = S(theta) u` (A(4)-(7)).

    Args:
        theta: Headings, shape (...) (rad).

    Returns:
        S, shape (..., 3, 2). Its rank is 2 and its singular values are 1, 1 for every heading.
    """
    theta = operand('theta', theta)
    return matrix(3, 2, cos(theta), 0.0, sin(theta), 0.0, 0.0, 1.0)


def wheel_to_body_jacobian(r: ArrayLike, L: ArrayLike) -> NDArray[np.float64]:
    """Map wheel speeds to the body twist: `u = J_w w`, `J_w = [[r/2, r/2], [r/L, -r/L]]` (A(8), E).

    Args:
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).

    Returns:
        J_w, shape (..., 2, 2), over `[omega_R, omega_L]`.

    Raises:
        ValueError: r or L is not positive and finite.
    """
    r, L, single = dimensions(r, L)
    (ratio,) = evaluated(single, 'r and L', lambda r, L: (r / L,), r, L)
    radius: Any = r
    half = radius / 2.0
    return matrix(2, 2, half, half, ratio, -ratio)


def body_to_wheel_jacobian(r: ArrayLike, L: ArrayLike) -> NDArray[np.float64]:
    """Map the body twist to wheel speeds: `w = J_w^-1 u`, `[[1/r, L/(2r)], [1/r, -L/(2r)]]` (A, E).

    Args:
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).

    Returns:
        The inverse of `wheel_to_body_jacobian`, shape (..., 2, 2).

    Raises:
        ValueError: r or L is not positive and finite.
    """
    r, L, single = dimensions(r, L)
    along, across = evaluated(single, 'r and L', lambda r, L: (1.0 / r, L / (2.0 * r)), r, L)
    return matrix(2, 2, along, across, along, -across)


def wheel_to_world_jacobian(theta: ArrayLike, r: ArrayLike, L: ArrayLike) -> NDArray[np.float64]:
    """Map wheel speeds to the velocity in the world: the whole chain `q_dot = S(theta) J_w w` (A, B, E).

    Args:
        theta: Headings, shape (...) (rad).
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).

    Returns:
        The product, shape (..., 3, 2), rank 2.

    Raises:
        ValueError: r or L is not positive and finite.
    """
    theta, r, L, single = heading_and_dimensions(theta, r, L)
    x, y, turn = evaluated(single, 'r and L', _wheel_to_world, theta, r, L)
    return matrix(3, 2, x, x, y, y, turn, -turn)


def _wheel_to_world(theta: Any, r: Any, L: Any) -> tuple[Any, Any, Any]:
    half = r / 2.0
    return cos(theta) * half, sin(theta) * half, r / L


def single_wheel_jacobian(theta: ArrayLike, r: ArrayLike) -> NDArray[np.float64]:
    """Map the speed of one driven wheel and the yaw rate to the velocity in the world (B, "Unicycle").

    Args:
        theta: Headings, shape (...) (rad).
        r: Wheel radius, shape (...) (m).

    Returns:
        `[[r cos, 0], [r sin, 0], [0, 1]]`, shape (..., 3, 2), over `[omega_wheel, theta_dot]` (rad/s).

    Raises:
        ValueError: r is not positive and finite.
    """
    theta, r = angle_and_radius('theta', theta, r)
    return matrix(3, 2, r * cos(theta), 0.0, r * sin(theta), 0.0, 0.0, 1.0)


def wheel_to_position_jacobian(theta: ArrayLike, r: ArrayLike, L: ArrayLike) -> NDArray[np.float64]:
    """Map wheel speeds to the velocity of the axle centre alone: `[x_dot, y_dot] = S[:2] J_w w` (B).

    **It has rank 1 for every heading, radius and separation**: the axle centre moves along the
    heading only, for all wheel speeds. It has no inverse that could control the position. A point off
    the axle can be controlled, see `offset_point_jacobian`.

    Args:
        theta: Headings, shape (...) (rad).
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).

    Returns:
        The Jacobian, shape (..., 2, 2), over `[omega_R, omega_L]`. Its determinant is exactly 0.

    Raises:
        ValueError: r or L is not positive and finite.
    """
    theta, r, L, single = heading_and_dimensions(theta, r, L)
    x, y, _ = evaluated(single, 'r and L', _wheel_to_world, theta, r, L)
    return matrix(2, 2, x, x, y, y)


def offset_point(pose: ArrayLike, d: ArrayLike) -> NDArray[np.float64]:
    """Return the point at x = d in the body frame: `[x + d cos, y + d sin]` in the world (B).

    Args:
        pose: `[x, y, theta]`, shape (..., 3).
        d: Coordinate x of the point in the body frame, negative behind the axle, shape (...) (m).

    Returns:
        The points in the world, shape (..., 2) (m).

    Raises:
        ValueError: Something is not finite, or shapes do not broadcast.
    """
    x, y, theta = components('pose', pose, 3)
    d = operand('d', d)
    single = type(x) is type(d) is float or agree(pose=x, d=d)
    if single:
        point = _point(x, y, theta, d)
        if isfinite(point[0] + point[1]):
            return np.array(point)
    return stack(*evaluated(single, 'pose and d', _point, x, y, theta, d))


def _point(x: Any, y: Any, theta: Any, d: Any) -> tuple[Any, Any]:
    return x + d * cos(theta), y + d * sin(theta)


def offset_point_jacobian(
    theta: ArrayLike, r: ArrayLike, L: ArrayLike, d: ArrayLike
) -> NDArray[np.float64]:
    """Map wheel speeds to the velocity of the offset point (B).

    `J_d = R(theta) [[r/2, r/2], [d r/L, -d r/L]]`. Its determinant is `-d r^2 / L`, so it is
    invertible for every heading if d is not 0.

    Args:
        theta: Headings, shape (...) (rad).
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).
        d: Coordinate x of the point in the body frame, not 0, shape (...) (m).

    Returns:
        The Jacobian, shape (..., 2, 2), over `[omega_R, omega_L]`.

    Raises:
        ValueError: r or L is not positive and finite, d is 0 or not finite.
    """
    theta, r, L, single = heading_and_dimensions(theta, r, L)
    d = operand('d', d, offset)
    single = (single and type(d) is float) or agree(theta=theta, r=r, L=L, d=d)
    return matrix(2, 2, *evaluated(single, 'r, L and d', _offset_jacobian, theta, r, L, d))


def _offset_jacobian(theta: Any, r: Any, L: Any, d: Any) -> tuple[Any, Any, Any, Any]:
    c, s = cos(theta), sin(theta)
    along, across = r / 2.0, d * r / L
    return (
        c * along - s * across,
        c * along + s * across,
        s * along + c * across,
        s * along - c * across,
    )


def body_to_wheel(v: Any, omega: Any, r: Any, L: Any) -> tuple[Any, Any]:
    """Return the wheel speeds of a body twist, `J_w^-1 u` in scalar form (A, inverse of (8)).

    Args:
        v: Forward speed, shape (...) (m/s).
        omega: Yaw rate, shape (...) (rad/s).
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).

    Returns:
        `(omega_R, omega_L)`, each of shape (...) (rad/s).

    Raises:
        ValueError: r or L is not positive and finite, v or omega is not finite, shapes do not
            broadcast, or a wheel speed overflows.
    """
    if (
        type(v) is type(omega) is type(r) is type(L) is float
        and r > 0.0 < L
        and isfinite(v + omega + r + L)
    ):
        omega_R, omega_L = _wheel_speeds(v, omega, r, L)
        if isfinite(omega_R + omega_L):
            return omega_R, omega_L
    v, omega = operand('v', v), operand('omega', omega)
    r, L = operand('r', r, positive), operand('L', L, positive)
    single = agree(v=v, omega=omega, r=r, L=L)
    omega_R, omega_L = evaluated(single, 'v, omega, r and L', _wheel_speeds, v, omega, r, L)
    return omega_R, omega_L


def _wheel_speeds(v: Any, omega: Any, r: Any, L: Any) -> tuple[Any, Any]:
    half = omega * L / 2.0
    return (v + half) / r, (v - half) / r


def wheel_to_body(omega_R: Any, omega_L: Any, r: Any, L: Any) -> tuple[Any, Any]:
    """Return the body twist of wheel speeds, `J_w w` in scalar form (A(8)).

    Args:
        omega_R: Speed of the right wheel, shape (...) (rad/s).
        omega_L: Speed of the left wheel, shape (...) (rad/s).
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s).

    Raises:
        ValueError: r or L is not positive and finite, a wheel speed is not finite, shapes do not
            broadcast, or v or omega overflows.
    """
    if (
        type(omega_R) is type(omega_L) is type(r) is type(L) is float
        and r > 0.0 < L
        and isfinite(omega_R + omega_L + r + L)
    ):
        v, omega = _body_twist(omega_R, omega_L, r, L)
        if isfinite(v + omega):
            return v, omega
    omega_R, omega_L = operand('omega_R', omega_R), operand('omega_L', omega_L)
    r, L = operand('r', r, positive), operand('L', L, positive)
    single = agree(omega_R=omega_R, omega_L=omega_L, r=r, L=L)
    v, omega = evaluated(single, 'omega_R, omega_L, r and L', _body_twist, omega_R, omega_L, r, L)
    return v, omega


def _body_twist(omega_R: Any, omega_L: Any, r: Any, L: Any) -> tuple[Any, Any]:
    return r * (omega_R + omega_L) / 2.0, r * (omega_R - omega_L) / L


def no_lateral_slip_constraint(theta: ArrayLike) -> NDArray[np.float64]:
    """Return the row `A(q) = [sin, -cos, 0]` with `A(q) q_dot = 0`, no lateral slip (A, E).

    Args:
        theta: Headings, shape (...) (rad).

    Returns:
        The constraint, shape (..., 1, 3). Its null space is the range of S(theta).
    """
    theta = operand('theta', theta)
    return matrix(1, 3, sin(theta), -cos(theta), 0.0)


def rolling_constraints(
    theta: ArrayLike, r: ArrayLike, L: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the constraints of two rolling wheels, a pair with `A_q q_dot = A_w w` (E).

    Rows: no lateral slip, pure rolling of the right wheel, pure rolling of the left one. `A_q` is
    invertible, and `A_q^-1 A_w` is the chain `S(theta) J_w`.

    Args:
        theta: Headings, shape (...) (rad).
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).

    Returns:
        `(A_q, A_w)`, shapes (..., 3, 3) and (..., 3, 2).

    Raises:
        ValueError: r or L is not positive and finite.
    """
    theta, r, L, single = heading_and_dimensions(theta, r, L)
    if not single:
        theta, r, L = alike(theta, r, L)
    c, s = cos(theta), sin(theta)
    separation: Any = L
    half = separation / 2.0
    over_pose = matrix(3, 3, s, -c, 0.0, c, s, half, c, s, -half)
    over_wheels = matrix(3, 2, 0.0, 0.0, r, 0.0, 0.0, r)
    return over_pose, over_wheels
