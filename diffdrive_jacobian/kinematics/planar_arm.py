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

"""A planar arm of n revolute joints: positions, Jacobians, singularities, clearance, torques.

State: joint angles `q = [q_1, ..., q_n]` (rad), each counted from the link before it; the first from
the x axis of the arm's base. Task: the tip's position x, y (m) and heading (rad), the sum of the angles.

Everything broadcasts over leading axes: q has shape (..., n). Wrong shapes and values that are not
finite raise ValueError.

Source: document A, 3.2.1 (two links) and 3.2.5 (more than the task needs); document D, 2 and 6;
doc/mathematics.md, "Manipulators".
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate, product
from math import inf, pi
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics.singular_values import EPS, refuse_singular
from diffdrive_jacobian.numerics.checks import Comparable, array, finite, positive, read_only
from diffdrive_jacobian.numerics.elementary import (
    atan2,
    cos,
    hypot,
    maximum,
    minimum,
    sin,
    sqrt,
    where,
    wrap,
)
from diffdrive_jacobian.numerics.formula import Entries, Number, Rows, Scalar, Vector, formula

__all__ = ['PlanarArm', 'arm_forward_kinematics', 'arm_jacobian']


@formula('(n),(n) -> (3)', lengths=positive)
def arm_forward_kinematics(lengths: Vector, q: Vector) -> Entries:
    """Return the pose of the tip, as `PlanarArm.forward_kinematics` of links of these lengths (m)."""
    x, y = arm_links(lengths, q)
    return [sum(x), sum(y), wrap(sum(q))]


@formula('(n),(n) -> (2,n)', lengths=positive)
def arm_jacobian(lengths: Vector, q: Vector) -> Rows:
    """Return the Jacobian of the position, as `PlanarArm.jacobian` of links of these lengths (m)."""
    x, y = arm_links(lengths, q)
    # Two links: [[-l1 s1 - l2 s12, -l2 s12], [l1 c1 + l2 c12, l2 c12]]. Joint i moves links i to n.
    return [
        [-sum(y[i:]) for i in range(len(q))],
        [sum(x[i:]) for i in range(len(q))],
    ]


def up_to_nearest_point(lengths: Vector, q: Vector, obstacle: Vector) -> Entries:
    """Return the lengths of the links of an arm that ends at its nearest point to an obstacle.

    The link with that point is shortened, the links beyond it have the length 0. So the forward
    kinematics and the Jacobian of this arm are those of the nearest point. Arguments are not checked.
    """
    x, y = arm_links(lengths, q)
    nearest: Entries = list(lengths)
    distance: Number = inf
    for i, length in enumerate(lengths):
        # From the joint to the obstacle, and the foot of its perpendicular, as a part of the link.
        to_x, to_y = obstacle[0] - sum(x[:i]), obstacle[1] - sum(y[:i])
        part = minimum(maximum((to_x * x[i] + to_y * y[i]) / length**2, 0.0), 1.0)
        to_link = hypot(to_x - part * x[i], to_y - part * y[i])
        up_to = [*lengths[:i], part * length, *[0.0] * (len(q) - i - 1)]
        nearest = [where(to_link < distance, *pair) for pair in zip(up_to, nearest, strict=True)]
        distance = minimum(distance, to_link)
    return nearest


def arm_links(lengths: Vector, q: Vector) -> tuple[list[Number], list[Number]]:
    """Return `l_i cos(q_1 + ... + q_i)` and `l_i sin(q_1 + ... + q_i)` of each link, unchecked."""
    angles = list(accumulate(q))  # q_1, q_1 + q_2, ...
    x = [l_i * cos(angle) for l_i, angle in zip(lengths, angles, strict=True)]
    y = [l_i * sin(angle) for l_i, angle in zip(lengths, angles, strict=True)]
    return x, y


def _force_or_wrench(name: str, value: NDArray[np.float64]) -> None:
    if finite(name, value).shape[-1] not in (2, 3):
        raise ValueError(f'{name} must have shape (..., 2) or (..., 3), got {value.shape}')


def _lengths(name: str, value: Any) -> NDArray[np.float64]:
    """Require the lengths of one arm, shape (n,), n >= 1. Returns them read-only."""
    checked = positive(name, array(name, value, 'n'))
    if checked.ndim != 1:
        raise ValueError(f'{name} must have shape (n,), got {checked.shape}')
    return read_only(checked)


@dataclass(frozen=True, eq=False)
class PlanarArm(Comparable):
    """Links in a chain, each joint turning about the z axis.

    Joint angles q have the shape (..., n) (rad), positions and obstacles are in the frame of the arm
    (m). A length that is not positive and finite, and a method for two links of an arm that has another
    number, raise ValueError.
    """

    lengths: Annotated[Any, _lengths]
    """Distances from joint to joint, the last to the tip, shape (n,) (m). Read-only."""

    @property
    def joints(self) -> int:
        """Number of joints, n."""
        return len(self.lengths)

    @property
    def _lengths(self) -> list[float]:
        return list(self.lengths.tolist())

    @property
    def _two_links(self) -> int:
        if self.joints != 2:
            raise ValueError(f'the arm must have 2 links for this, got {self.joints}')
        return 2

    @formula('(joints) -> (k,2)')
    def joint_positions(self, q: Vector) -> Rows:
        """Return the positions of the base, of every further joint and of the tip.

        The result has the shape (..., n + 1, 2) (m). The first is the base, [0, 0].
        """
        x, y = arm_links(self._lengths, q)
        return [[sum(x[:joint], 0.0), sum(y[:joint], 0.0)] for joint in range(len(q) + 1)]

    def forward_kinematics(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return the pose of the tip (A, D): `x = sum l_i cos(q_1 + ... + q_i)`, y with the sine.

        The result is `[x, y, heading]`, shape (..., 3) (m, m, rad), the heading wrapped to (-pi, pi].
        """
        return arm_forward_kinematics(self.lengths, q)

    def jacobian(self, q: ArrayLike, heading: bool = False) -> NDArray[np.float64]:
        """Map joint velocities to the velocity of the tip (A, D).

        A joint moves the tip at a right angle to the line from the joint to the tip. For two links:
        `[[-l1 s1 - l2 s12, -l2 s12], [l1 c1 + l2 c12, l2 c12]]`. The result has the shape (..., 2, n),
        or with the heading of the tip (..., 3, n), with a last row of ones.
        """
        J = arm_jacobian(self.lengths, q)
        if not heading:
            return J
        return np.concatenate([J, np.ones_like(J[..., :1, :])], axis=-2)

    @formula('(_two_links) -> ()')
    def determinant(self, q: Vector) -> Scalar:
        """Return the determinant of the Jacobian of two links: `l1 l2 sin(q_2)` (A).

        The result has the shape (...) (m^2).
        """
        l_1, l_2 = self._lengths
        return l_1 * l_2 * sin(q[1])

    def singular_configurations(self, q_1: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Return the configurations in which the position is singular: all links on one line (A, D).

        There the tip cannot move along that line. Two links are stretched, q_2 = 0, or folded, q_2 = pi.
        For angles of the first joint, shape (...) (rad), which do not matter, the result is `[q_1, q_2,
        ..., q_n]` with each of q_2 to q_n 0 or pi, shape (..., 2^(n - 1), n) (rad), the stretched arm
        first. For two links `[[q_1, 0], [q_1, pi]]`.
        """
        q_1 = array('q_1', q_1)
        others = list(product((0.0, pi), repeat=self.joints - 1))
        q = np.empty((*q_1.shape, len(others), self.joints))
        q[..., 0], q[..., 1:] = q_1[..., np.newaxis], others
        return q

    def inverse_kinematics(self, position: ArrayLike) -> NDArray[np.float64]:
        """Return both explicit solutions of two links: elbow down and elbow up (D, 6).

        `cos(q_2) = (x^2 + y^2 - l_1^2 - l_2^2) / (2 l_1 l_2)` by the law of cosines, and `q_1 = atan2(y,
        x) - atan2(l_2 sin(q_2), l_1 + l_2 cos(q_2))`. Other arms, and headings, need
        `inverse_kinematics.solve`.

        For positions of the tip, shape (..., 2) (m), the result is `[down, up]`, shape (..., 2, 2)
        (rad). The first has q_2 from 0 to pi: seen along the line to the tip, the elbow is on the right,
        below a tip straight ahead. The second has q_2 from -pi to 0. They are the same where the arm is
        stretched or folded. For a tip on the base, which any q_1 reaches, q_1 is 0. A position out of
        reach raises ValueError: its distance from the base must be from `|l_1 - l_2|` to `l_1 + l_2`.
        """
        return self._elbow_down_and_up(self._reachable(position))

    @formula('(_two_links) -> (2,2)')
    def _elbow_down_and_up(self, position: Vector) -> Rows:
        (l_1, l_2), (x, y) = self._lengths, position
        c_2 = (x * x + y * y - l_1 * l_1 - l_2 * l_2) / (2.0 * l_1 * l_2)
        c_2 = maximum(minimum(c_2, 1.0), -1.0)  # only rounding is cut off
        s_2 = sqrt(1.0 - c_2 * c_2)
        bearing, inner = atan2(y, x), atan2(l_2 * s_2, l_1 + l_2 * c_2)
        q_2 = atan2(s_2, c_2)
        return [
            [wrap(bearing - inner), q_2],
            [wrap(bearing + inner), -q_2],
        ]

    def _reachable(self, position: ArrayLike) -> NDArray[np.float64]:
        """Require positions that the tip of two links can reach."""
        position = array('position', position, self._two_links)
        distance = np.hypot(position[..., 0], position[..., 1])
        least, most = abs(self.lengths[0] - self.lengths[1]), self.lengths.sum()
        rounding = 4.0 * EPS * most
        beyond = (distance < least - rounding) | (distance > most + rounding)
        if beyond.any():
            raise ValueError(
                f'position must be from {least:g} to {most:g} m away from the base, '
                f'got {position[beyond][0].tolist()}'
            )
        return position + 0.0  # without -0.0

    @formula('(_two_links),(2) -> (2)')
    def inverse_velocity(self, q: Vector, x_dot: Vector) -> Entries:
        """Return joint velocities of two links for a velocity of the tip, by the adjugate (A, 3.2.1).

        For velocities of the tip, shape (..., 2) (m/s), the result has the shape (..., 2) (rad/s). A
        configuration that is singular to working precision raises LinAlgError.
        """
        (a, b), (c, d) = arm_jacobian.formula(self._lengths, q)
        l_1, l_2 = self._lengths
        determinant = l_1 * l_2 * sin(q[1])
        # More accurate than from the entries of J: only the rounding of q_2 itself remains.
        blur = 4.0 * EPS * maximum(1.0, abs(q[1]))
        refuse_singular(determinant, abs(determinant) <= blur * l_1 * l_2)
        v_x, v_y = x_dot
        return [(d * v_x - b * v_y) / determinant, (a * v_y - c * v_x) / determinant]

    @formula('(joints),(2) -> ()')
    def clearance(self, q: Vector, obstacle: Vector) -> Scalar:
        """Return the distance of the arm from an obstacle, a point, to the nearest point of its links.

        Obstacles have the shape (..., 2), the result (...) (m).
        """
        nearest = up_to_nearest_point(self._lengths, q, obstacle)
        x, y, _ = arm_forward_kinematics.formula(nearest, q)
        return hypot(x - obstacle[0], y - obstacle[1])

    @formula('(joints),(2) -> (joints)')
    def clearance_gradient(self, q: Vector, obstacle: Vector) -> Entries:
        """Return the gradient of `clearance`: a motion away from an obstacle (A, 3.2.5).

        It is `J^T n`, with the Jacobian J of the nearest point and the unit vector n from the obstacle
        to it, shape (..., n) (m/rad), 0 where the arm touches the obstacle. Where the nearest point
        changes to another link, it jumps. As a secondary task: `redundant(J, x_dot, k *
        arm.clearance_gradient(q, obstacle))`, k > 0.

        Source: A. A. Maciejewski, C. A. Klein, "Obstacle avoidance for kinematically redundant
        manipulators in dynamically varying environments", 1985.
        """
        nearest = up_to_nearest_point(self._lengths, q, obstacle)
        x, y, _ = arm_forward_kinematics.formula(nearest, q)
        J_x, J_y = arm_jacobian.formula(nearest, q)
        away_x, away_y = x - obstacle[0], y - obstacle[1]
        distance = hypot(away_x, away_y)
        distance = where(distance > 0.0, distance, 1.0)
        return [(J_xi * away_x + J_yi * away_y) / distance for J_xi, J_yi in zip(J_x, J_y, strict=True)]

    @formula('(joints),(m) -> (joints)', wrench=_force_or_wrench)
    def joint_torques(self, q: Vector, wrench: Vector) -> Entries:
        """Return the joint torques of a wrench at the tip: `tau = J^T W` (D, 6).

        The wrench is a force `[f_x, f_y]` (N), or with the moment `[f_x, f_y, m_z]` (N, N, N m), shape
        (..., 2) or (..., 3). The result has the shape (..., n) (N m).
        """
        J_x, J_y = arm_jacobian.formula(self._lengths, q)
        # A moment acts on every joint alike.
        f_x, f_y, m_z = [*wrench, 0.0][:3]
        return [J_xi * f_x + J_yi * f_y + m_z for J_xi, J_yi in zip(J_x, J_y, strict=True)]

    @formula('(joints),(joints),() -> (joints)')
    def integrate(self, q: Vector, q_dot: Vector, dt: Number) -> Entries:
        """Return the joint angles after a time at constant velocity: `q + q_dot dt` (D, 4.1).

        For joint velocities, shape (..., n) (rad/s), and durations, shape (...) (s), the result has the
        shape (..., n) (rad). The angles are not wrapped.
        """
        return [q_i + q_dot_i * dt for q_i, q_dot_i in zip(q, q_dot, strict=True)]
