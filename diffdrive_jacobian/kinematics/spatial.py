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

"""Poses in space as six numbers, and the displacement between two: the error of document D.

A pose is a homogeneous transform `[[R, p], [0, 1]]`, shape (4, 4), with the rotation matrix R and the
position p (m). Everything broadcasts over leading axes. Other matrices raise ValueError. In the plane
the same displacement is `se2.compose(se2.inverse(pose), target)`.

Source: document D, 6; the Jacobians of SO(3): J. Sola, J. Deray, D. Atchuthan, *A Micro Lie Theory for
State Estimation in Robotics*, 2018, (145) and (146); doc/mathematics.md, "Inverse kinematics".
"""

from __future__ import annotations

from typing import Any

import numpy as np

from diffdrive_jacobian.kinematics.singular_values import product, times, transposed
from diffdrive_jacobian.numerics.checks import finite
from diffdrive_jacobian.numerics.elementary import cos, hypot, sinc
from diffdrive_jacobian.numerics.formula import Array, Entries, Number, Rows, Vector, formula

__all__ = [
    'pose_vector',
    'pose_vector_difference',
    'pose_vector_difference_jacobian',
    'pose_vector_displacement',
    'spatial_displacement',
    'spatial_displacement_jacobian',
]

ROUNDING = 1e-6
"""Largest deviation of `R^T R` from the identity in the norm of Frobenius."""


def rigid(name: str, T: Array) -> None:
    """Require homogeneous transforms, shape (..., 4, 4)."""
    finite(name, T)
    R = T[..., :3, :3]
    with np.errstate(all='ignore'):
        skew = np.linalg.norm(np.swapaxes(R, -1, -2) @ R - np.eye(3), axis=(-2, -1))
        proper = np.linalg.det(R) > 0.0
    inside = (skew < ROUNDING) & proper & np.all(T[..., 3, :] == (0, 0, 0, 1), axis=-1)
    if not inside.all():
        raise ValueError(
            f'{name} must be [[R, p], [0, 0, 0, 1]] with a rotation matrix R, '
            f'got {T[~inside][0].tolist()}'
        )


@formula('(4,4),(4,4) -> (6)', T=rigid, T_desired=rigid)
def spatial_displacement(T: Any, T_desired: Any) -> Array:
    """Return the displacement from a pose to another one: `Delta = (t, v theta)` (D, 6).

    For poses T of the end effector E and desired ones, T_desired, shape (..., 4, 4), the result is
    `[t_x, t_y, t_z, v_x theta, v_y theta, v_z theta]` in the frame E, shape (..., 6) (m, rad): the
    translation, and the axis v of the rotation times its angle theta, 0 to pi. At pi the sign of v is
    one of both.
    """
    R_transposed = transposed(T[:3, :3])
    t = times(R_transposed, T_desired[:3, 3] - T[:3, 3])  # R^T (p_desired - p)
    return np.concatenate([t, _rotation_vector(product(R_transposed, T_desired[:3, :3]))])


@formula('(4,4) -> (6)', T=rigid)
def pose_vector(T: Any) -> Array:
    """Return the position of a pose, and its rotation as axis times angle.

    For poses, shape (..., 4, 4), it is `[x, y, z, v_x theta, v_y theta, v_z theta]`, shape (..., 6) (m,
    rad), with theta from 0 to pi.
    """
    return np.concatenate([T[:3, 3], _rotation_vector(T[:3, :3])])


@formula('(6),(6) -> (6)')
def pose_vector_difference(target: Vector, pose: Vector) -> Entries:
    """Return the error of poses in space, for `solve(..., difference=pose_vector_difference)`.

    Of pose vectors, shape (..., 6) (m, rad), it is the translation `p_target - p`, and axis times angle
    of the rotation `R_target R^T`, both in the axes of the base.
    """
    w, x, y, z = _quaternion(*target[3:])
    w_is, *v = _quaternion(*pose[3:])
    x_is, y_is, z_is = (-component for component in v)  # of the inverse
    rotation = [
        w * w_is - x * x_is - y * y_is - z * z_is,
        w * x_is + x * w_is + y * z_is - z * y_is,
        w * y_is + y * w_is + z * x_is - x * z_is,
        w * z_is + z * w_is + x * y_is - y * x_is,
    ]
    missing = [there - here for there, here in zip(target[:3], pose[:3], strict=True)]
    return [*missing, *_logarithm(np.array(np.broadcast_arrays(*rotation)))]


@formula('(6),(6,n) -> (6,n)')
def pose_vector_difference_jacobian(e: Any, J: Any) -> Rows:
    """Return minus the derivative by the joints of the error that `pose_vector_difference` gives.

    For errors e, shape (..., 6), and Jacobians in the axes of the base, linear above angular, shape
    (..., 6, n), it has the shape (..., 6, n).
    """
    return [*J[:3], *_left_jacobian_inverse(-e[3:], J[3:])]


@formula('(6),(6) -> (6)')
def pose_vector_displacement(target: Vector, pose: Vector) -> Entries:
    """Return what `spatial_displacement` returns, of pose vectors, shape (..., 6) (m, rad)."""
    e = pose_vector_difference.formula(target, pose)
    back = _quaternion(*(-component for component in pose[3:]))
    return [*_rotated(back, e[:3]), *_rotated(back, e[3:])]


@formula('(6),(6,n) -> (6,n)')
def spatial_displacement_jacobian(Delta: Any, J: Any) -> Rows:
    """Return minus the derivative by the joints of the displacement that `spatial_displacement` gives.

    For displacements, shape (..., 6), and Jacobians in the axes of E, linear above angular, shape (...,
    6, n), it has the shape (..., 6, n).
    """
    # The axes turn, too.
    return [*(J[:3] - _cross(Delta[:3], J[3:])), *_left_jacobian_inverse(Delta[3:], J[3:])]


def _left_jacobian_inverse(v: Array, omega: Array) -> Array:
    """Return `J_l^-1 omega`, with the left Jacobian of SO(3) at v theta, shapes (3, ...), (3, n, ...).

    `J_l^-1 = I - [v]/2 + (1 - theta/2 cot(theta/2)) [v]^2 / theta^2`, where [v] is the cross product
    with v theta. The right Jacobian of v theta is the left one of -v theta.
    """
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    half = 0.5 * np.sqrt(square)
    factor = (1.0 - cos(half) / sinc(half)) / (square + (square == 0.0))
    turned = _cross(v, omega)
    return np.asarray(omega - 0.5 * turned + factor * _cross(v, turned))


def _cross(v: Vector, w: Vector) -> Array:
    """Return the cross product of a vector with a vector or columns, shapes (3, ...), (3, n, ...)."""
    (x, y, z), (a, b, c) = v, w
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a])


def _rotated(q: Entries, vector: Entries) -> Array:
    """Return a vector, rotated by a unit quaternion."""
    w, *u = q
    across = 2.0 * _cross(u, vector)
    return np.asarray(vector + w * across + _cross(u, across))


def _quaternion(x: Number, y: Number, z: Number) -> Entries:
    """Return the unit quaternion of a rotation, `[cos(theta/2), v sin(theta/2)]`, from v theta."""
    theta = hypot(hypot(x, y), z)
    half = 0.5 * sinc(0.5 * theta)
    return [cos(0.5 * theta), half * x, half * y, half * z]


def _rotation_vector(R: Array) -> Array:
    """Return axis times angle of rotation matrices, shapes (3, ...) and (3, 3, ...), unchecked."""
    (a, b, c), (d, e, f), (g, h, i) = R
    # The unit quaternion q = [cos(theta/2), v sin(theta/2)] times each of its entries times 4.
    rows = np.array(
        [
            [1.0 + a + e + i, h - f, c - g, d - b],
            [h - f, 1.0 + a - e - i, b + d, c + g],
            [c - g, b + d, 1.0 - a + e - i, f + h],
            [d - b, c + g, f + h, 1.0 - a - e + i],
        ]
    )
    # The row of the largest entry loses no digits.
    longest = np.linalg.norm(rows, axis=1).argmax(axis=0)
    return _logarithm(np.take_along_axis(rows, longest[np.newaxis, np.newaxis], axis=0)[0])


def _logarithm(q: Array) -> Array:
    """Return axis times angle, 0 to pi, of quaternions of any length, shapes (3, ...) and (4, ...)."""
    q = q * np.where(q[0] < 0.0, -1.0, 1.0)
    sine = np.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    theta = 2.0 * np.arctan2(sine, q[0])
    return np.asarray(q[1:] * (theta / np.where(sine > 0.0, sine, 1.0)))
