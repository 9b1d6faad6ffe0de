"""Poses in space as six numbers, and the displacement between two: the error of document D.

A pose is a homogeneous transform `[[R, p], [0, 1]]`, shape (4, 4), with the rotation matrix R and the
position p (m). Everything broadcasts over leading axes. Other matrices raise ValueError. In the plane
the same displacement is `se2.compose(se2.inverse(pose), target)`.

Source: document D, 6; doc/mathematics.md, "Inverse kinematics".
"""

from __future__ import annotations

from typing import Any

import numpy as np

from diffdrive_jacobian.kinematics.singular_values import product, times, transposed
from diffdrive_jacobian.numerics.checks import finite
from diffdrive_jacobian.numerics.elementary import cos, hypot, sinc
from diffdrive_jacobian.numerics.formula import Array, Entries, Number, Vector, formula

__all__ = ['pose_vector', 'pose_vector_difference', 'spatial_displacement']

ROUNDING = 1e-6
"""Largest deviation of `R^T R` from the identity in the norm of Frobenius."""


def _rigid(name: str, T: Array) -> None:
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


@formula('(4,4),(4,4) -> (6)', T=_rigid, T_desired=_rigid)
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


@formula('(4,4) -> (6)', T=_rigid)
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
    of the rotation `R_target R^T`, both in the axes of the base. `-J^T` of it, with J in these axes, is
    the gradient of half its square.
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
