"""Velocity kinematics of the differential drive: its Jacobians, their chain and their constraints.

State: pose `q = [x, y, theta]` (m, m, rad). Inputs: wheel speeds `w = [omega_R, omega_L]` (rad/s,
positive drives forward) or the body twist `u = [v, omega]` (m/s, rad/s). Wheel radius `r` and wheel
separation `L` in m. **Wheels stand right, left everywhere.**

    w --J_w--> u --S(theta)--> q_dot

Everything broadcasts over leading axes. A radius or separation that is not positive and finite
raises ValueError.

Source: document A, equations (4)-(8); documents B and E; MATH.md, "Differential drive".
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._checks import positive
from diffdrive_jacobian.kinematics._elementary import operand


def unicycle_jacobian(theta: ArrayLike) -> NDArray[np.float64]:
    """Map the body twist to the velocity in the world: `q_dot = S(theta) u` (A(4)-(7)).

    Args:
        theta: Headings, shape (...) (rad).

    Returns:
        S, shape (..., 3, 2). Its rank is 2 and its singular values are 1, 1 for every heading.
    """
    theta = np.asarray(theta, dtype=np.float64)
    jacobian = np.zeros((*theta.shape, 3, 2))
    jacobian[..., 0, 0] = np.cos(theta)
    jacobian[..., 1, 0] = np.sin(theta)
    jacobian[..., 2, 1] = 1.0
    return jacobian


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
    r, L = _geometry(r, L)
    jacobian = np.empty((*np.broadcast(r, L).shape, 2, 2))
    jacobian[..., 0, 0] = jacobian[..., 0, 1] = r / 2.0
    jacobian[..., 1, 0] = r / L
    jacobian[..., 1, 1] = -r / L
    return jacobian


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
    r, L = _geometry(r, L)
    jacobian = np.empty((*np.broadcast(r, L).shape, 2, 2))
    jacobian[..., 0, 0] = jacobian[..., 1, 0] = 1.0 / r
    jacobian[..., 0, 1] = L / (2.0 * r)
    jacobian[..., 1, 1] = -L / (2.0 * r)
    return jacobian


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
    chain: NDArray[np.float64] = unicycle_jacobian(theta) @ wheel_to_body_jacobian(r, L)
    return chain


def body_to_wheel(v: Any, omega: Any, r: Any, L: Any) -> tuple[Any, Any]:
    """Give the wheel speeds of a body twist: `J_w^-1 u`, written out (A, inverse of (8)).

    Args:
        v: Forward speed, shape (...) (m/s).
        omega: Yaw rate, shape (...) (rad/s).
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).

    Returns:
        `(omega_R, omega_L)`, each of shape (...) (rad/s).

    Raises:
        ValueError: r or L is not positive and finite.
    """
    v, omega, r, L = _operands(v, omega, r, L)
    half = omega * L / 2.0
    return (v + half) / r, (v - half) / r


def wheel_to_body(omega_R: Any, omega_L: Any, r: Any, L: Any) -> tuple[Any, Any]:
    """Give the body twist of the wheel speeds: `J_w w`, written out (A(8)).

    Args:
        omega_R: Speed of the right wheel, shape (...) (rad/s).
        omega_L: Speed of the left wheel, shape (...) (rad/s).
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s).

    Raises:
        ValueError: r or L is not positive and finite.
    """
    omega_R, omega_L, r, L = _operands(omega_R, omega_L, r, L)
    return r * (omega_R + omega_L) / 2.0, r * (omega_R - omega_L) / L


def no_lateral_slip_constraint(theta: ArrayLike) -> NDArray[np.float64]:
    """Give the row `A(q) = [sin, -cos, 0]` with `A(q) q_dot = 0`: no motion sideways (A, E).

    Args:
        theta: Headings, shape (...) (rad).

    Returns:
        The constraint, shape (..., 1, 3). Its null space is the range of S(theta).
    """
    theta = np.asarray(theta, dtype=np.float64)
    constraint = np.zeros((*theta.shape, 1, 3))
    constraint[..., 0, 0] = np.sin(theta)
    constraint[..., 0, 1] = -np.cos(theta)
    return constraint


def rolling_constraints(
    theta: ArrayLike, r: ArrayLike, L: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Give the constraints of two rolling wheels as a pair with `A_q q_dot = A_w w` (E).

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
    theta = np.asarray(theta, dtype=np.float64)
    r, L = _geometry(r, L)
    shape = np.broadcast(theta, r, L).shape
    over_pose, over_wheels = np.zeros((*shape, 3, 3)), np.zeros((*shape, 3, 2))
    over_pose[..., :1, :] = no_lateral_slip_constraint(theta)
    over_pose[..., 1:, 0] = np.cos(theta)[..., np.newaxis]
    over_pose[..., 1:, 1] = np.sin(theta)[..., np.newaxis]
    over_pose[..., 1, 2] = L / 2.0
    over_pose[..., 2, 2] = -L / 2.0
    over_wheels[..., 1, 0] = over_wheels[..., 2, 1] = r
    return over_pose, over_wheels


def _geometry(r: ArrayLike, L: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    r, L = np.asarray(r, dtype=np.float64), np.asarray(L, dtype=np.float64)
    positive('r', r)
    positive('L', L)
    return r, L


def _operands(first: Any, second: Any, r: Any, L: Any) -> tuple[Any, Any, Any, Any]:
    first, second, r, L = operand(first), operand(second), operand(r), operand(L)
    positive('r', r)
    positive('L', L)
    return first, second, r, L
