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

"""An arm in space, from its Denavit-Hartenberg parameters: poses, 6xN Jacobians, torques.

Joint i turns about, or slides along, the z axis of the frame of the link before it. With the standard
parameters the frames of two links are apart by

    T_i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i),    T(q) = T_1 T_2 ... T_n

where q_i is added to theta_i (rad), or to d_i (m) if the joint slides. Velocities of the end effector E
are `nu = [v, omega]`, linear above angular (m/s, rad/s): of its origin, in the axes of the base or of E.

Everything broadcasts over leading axes: q has shape (..., n). Wrong shapes and values that are not
finite raise ValueError. The measures of `inverse_velocity` take the rows of a Jacobian: `J[..., :3, :]`
for the position, `J[..., 3:, :]` for the orientation.

Source: document D, 2.1 and 6; document A, 3.2.5; J. Denavit, R. S. Hartenberg, "A kinematic notation for
lower-pair mechanisms based on matrices", 1955; P. Corke, *Robotics, Vision and Control*, 2011, 7.1 and
8.1; doc/mathematics.md, "Manipulators".
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics.inverse_kinematics import IKResult, joint_limits, solve
from diffdrive_jacobian.kinematics.spatial import (
    pose_vector,
    pose_vector_difference,
    pose_vector_difference_jacobian,
    pose_vector_displacement,
    rigid,
    spatial_displacement_jacobian,
)
from diffdrive_jacobian.numerics.checks import (
    Comparable,
    array,
    finite,
    floats,
    integer,
    one_of,
    read_only,
)
from diffdrive_jacobian.numerics.elementary import cos, dot, product, sin
from diffdrive_jacobian.numerics.formula import Entries, Number, Rows, Vector, formula

__all__ = ['IIWA', 'PANDA', 'UR5', 'SpatialArm']

ERRORS = {
    'base': (pose_vector_difference, pose_vector_difference_jacobian),
    'end': (pose_vector_displacement, spatial_displacement_jacobian),
}
"""Axes in which velocities and errors are given, with the errors and their derivatives."""
IDENTITY: Rows = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def link(a: Number, alpha: Number, d: Number, theta: Number) -> tuple[Rows, Entries]:
    """Return rotation and translation of `Rz(theta) Tz(d) Tx(a) Rx(alpha)`, unchecked."""
    c, s, c_a, s_a = cos(theta), sin(theta), cos(alpha), sin(alpha)
    R = [
        [c, -s * c_a, s * s_a],
        [s, c * c_a, -c * s_a],
        [0.0, s_a, c_a],
    ]
    return R, [a * c, a * s, d]


@dataclass(frozen=True, eq=False)
class SpatialArm(Comparable):
    """Joints in a chain in space. All arrays are read-only.

    Joints q have the shape (..., n) (rad, or m where a joint slides). Parameters of different lengths or
    that are not finite, joints that do not exist, and limits that are no pair raise ValueError.
    """

    a: Any
    """Distances along the x axis of each link, shape (n,), or one for all joints (m)."""
    alpha: Any
    """Angles about that axis, from one joint's axis to the next, shape (n,) (rad)."""
    d: Any
    """Distances along the axis of each joint, shape (n,) (m)."""
    theta: Any = 0.0
    """Angles about the axis of each joint where q is 0, shape (n,) (rad)."""
    prismatic: tuple[int, ...] = ()
    """Indices of the joints that slide."""
    limits: Any = None
    """Lower and upper limits of the joints, shape (n,) each. None: they are not known."""
    slides: NDArray[np.float64] = field(init=False, repr=False)
    """1 for each joint that slides, 0 for one that turns, shape (n,)."""

    def __post_init__(self) -> None:
        """Check every value."""
        names = 'a', 'alpha', 'd', 'theta'
        values = {name: finite(name, floats(name, getattr(self, name))) for name in names}
        shapes = {value.shape for value in values.values() if value.ndim}
        if len(shapes) != 1 or any(len(shape) > 1 or shape == (0,) for shape in shapes):
            found = ', '.join(f'{name} {value.shape}' for name, value in values.items())
            raise ValueError(f'a, alpha, d and theta must have one shape (n,), with n >= 1, got {found}')
        ((n,),) = shapes
        slides = np.zeros(n)
        joints = [
            integer('prismatic', joint, 0, n - 1) for joint in np.atleast_1d(self.prismatic).tolist()
        ]
        slides[joints] = 1.0
        for name, value in {**values, 'slides': slides}.items():
            object.__setattr__(self, name, read_only(np.broadcast_to(value, n)))
        object.__setattr__(self, 'prismatic', tuple(joints))
        if self.limits is not None:
            pair = joint_limits(self.limits, n)
            object.__setattr__(self, 'limits', tuple(map(read_only, pair)))

    @property
    def joints(self) -> int:
        """Number of joints, n."""
        return len(self.a)

    def _frames(self, q: Vector) -> list[tuple[Rows, Entries]]:
        """Return rotation and position of the base and of each link's frame, unchecked."""
        R, p = IDENTITY, [0.0, 0.0, 0.0]
        frames = [(R, p)]
        parameters = np.array([self.a, self.alpha, self.d, self.theta, self.slides]).T.tolist()
        for (a, alpha, d, theta, slides), q_i in zip(parameters, q, strict=True):
            R_i, p_i = link(a, alpha, d + slides * q_i, theta + (1.0 - slides) * q_i)
            p = [p_k + dot(row, p_i) for p_k, row in zip(p, R, strict=True)]
            R = product(R, R_i)
            frames.append((R, p))
        return frames

    @formula('(joints) -> (4,4)')
    def forward_kinematics(self, q: Vector) -> Rows:
        """Return the pose of the end effector: `T(q) = T_1 ... T_n`, shape (..., 4, 4) (D)."""
        R, p = self._frames(q)[-1]
        return [[*row, p_k] for row, p_k in zip(R, p, strict=True)] + [[0.0, 0.0, 0.0, 1.0]]

    @formula('(joints) -> (k,3)')
    def joint_positions(self, q: Vector) -> Rows:
        """Return the origins of the base and of each link's frame, shape (..., n + 1, 3) (m)."""
        return [p for _, p in self._frames(q)]

    def jacobian(self, q: ArrayLike, frame: str = 'base') -> NDArray[np.float64]:
        """Map joint velocities to the velocity of the end effector: `nu = J(q) q_dot` (D, 2.1).

        With the axis z of a joint and r from it to the origin of E, its column is `[z x r, z]`, or `[z,
        0]` if it slides. `frame` says in which axes: those of the base, or of E, `[R^T v, R^T omega]`.
        The result has the shape (..., 6, n).
        """
        one_of(*ERRORS)('frame', frame)
        J = self._jacobian(q)
        if frame == 'base':
            return J
        R_transposed = np.swapaxes(self.forward_kinematics(q)[..., :3, :3], -1, -2)
        return np.concatenate([R_transposed @ J[..., :3, :], R_transposed @ J[..., 3:, :]], axis=-2)

    def _columns(self, q: Vector) -> list[Entries]:
        """Return the column of each joint, in the axes of the base, unchecked."""
        frames = self._frames(q)
        _, p_E = frames[-1]
        columns = []
        for (R, p), s_i in zip(frames, self.slides.tolist(), strict=False):
            # The axis of the joint, and from it to the end effector.
            z = z_x, z_y, z_z = [row[2] for row in R]
            r_x, r_y, r_z = (e - k for e, k in zip(p_E, p, strict=True))
            z_r = [z_y * r_z - z_z * r_y, z_z * r_x - z_x * r_z, z_x * r_y - z_y * r_x]  # z x r
            columns.append([*z, 0.0, 0.0, 0.0] if s_i else [*z_r, *z])
        return columns

    @formula('(joints) -> (6,joints)')
    def _jacobian(self, q: Vector) -> Rows:
        return [list(row) for row in zip(*self._columns(q), strict=True)]

    @formula('(joints),(6) -> (joints)')
    def joint_torques(self, q: Vector, wrench: Vector) -> Entries:
        """Return the torques, or forces, of the joints for a wrench at E: `Q = J^T W` (D, 5).

        The wrench is `[f, m]` in the axes of the base, shape (..., 6) (N, N m). The result has the shape
        (..., n) (N m, or N where a joint slides).
        """
        return [dot(column, wrench) for column in self._columns(q)]

    @formula('(joints),(joints),() -> (joints)')
    def integrate(self, q: Vector, q_dot: Vector, dt: Number) -> Entries:
        """Return the joints after a time at constant velocity: `q + q_dot dt` (D, 4.1).

        For joint velocities, shape (..., n), and durations, shape (...) (s), the result has the shape
        (..., n). Angles are not wrapped.
        """
        return [q_i + q_dot_i * dt for q_i, q_dot_i in zip(q, q_dot, strict=True)]

    def inverse_kinematics(
        self, target: ArrayLike, q0: ArrayLike, frame: str = 'base', **options: Any
    ) -> IKResult:
        """Search for joints at which the end effector is at a pose, from a start (D, 6).

        The error is what is missing: the translation, and axis times angle of the rotation, six entries
        for the `mask` (m, rad).

        Args:
            target: Poses, shape (..., 4, 4).
            q0: Starts of the search, shape (..., n).
            frame: In which axes the error is, those of the base, or of E, as `spatial_displacement`. A
                mask of [1, 1, 1, 1, 1, 0] in those of E lets a drill turn about its own z axis.
            options: As for `inverse_kinematics.solve`. By default `limits` are those of the arm, with
                50 `restarts` and 2000 `max_iterations`.

        Raises:
            ValueError: An argument has a wrong shape or value.
        """
        one_of(*ERRORS)('frame', frame)
        target, q0 = array('target', target, 4, 4), array('q0', q0, self.joints)
        rigid('target', target)
        difference, difference_jacobian = ERRORS[frame]
        return solve(
            lambda q: pose_vector(self.forward_kinematics(q)),
            lambda q: self.jacobian(q, frame),
            pose_vector(target),
            q0,
            **{
                'difference': difference,
                'difference_jacobian': difference_jacobian,
                'limits': self.limits,
                'restarts': 50,
                'max_iterations': 2000,
                **options,
            },
        )


# --- Published robots

UR5 = SpatialArm(
    a=[0.0, -0.425, -0.39225, 0.0, 0.0, 0.0],
    alpha=[pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0],
    d=[0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823],
    limits=(-2.0 * pi, 2.0 * pi),
)
"""Universal Robots UR5 up to its flange.

Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics"."""
PANDA = SpatialArm(
    a=[0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088, 0.0],
    alpha=[-pi / 2, pi / 2, pi / 2, -pi / 2, pi / 2, pi / 2, 0.0],
    d=[0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.107],
    limits=(
        [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973],
        [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973],
    ),
)
"""Franka Emika Panda up to its flange.

Source: "Franka Control Interface documentation", robot and interface specifications, where a and alpha
belong to the link before, as in Craig's parameters."""
IIWA = SpatialArm(
    a=0.0,
    alpha=[-pi / 2, pi / 2, pi / 2, -pi / 2, -pi / 2, pi / 2, 0.0],
    d=[0.36, 0.0, 0.42, 0.0, 0.4, 0.0, 0.126],
    limits=tuple(np.radians([[-limit, limit] for limit in (170, 120, 170, 120, 170, 120, 175)]).T),
)
"""KUKA LBR iiwa 14 R820 up to its flange.

Source: KUKA, "LBR iiwa 7 R800, LBR iiwa 14 R820, Specification"; the signs of alpha as in C. Faria et
al., "Position-based kinematics for 7-DoF serial manipulators with global configuration control, joint
limit and singularity avoidance", 2018."""
