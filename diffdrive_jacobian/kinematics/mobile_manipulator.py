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

"""A planar arm on a differential drive: one Jacobian from the wheels and the joints to the tip.

State: `q = [x, y, theta, q_1, ..., q_n]`, the pose of the base (m, m, rad) and the joint angles (rad).
Input: `[omega_R, omega_L, q_1_dot, ..., q_n_dot]` (rad/s). Task: position (m) and heading (rad) of the
tip in the world.

Everything broadcasts over leading axes: q has shape (..., 3 + n). Wrong shapes and values that are not
finite raise ValueError. There are more inputs than task velocities: `inverse_velocity` chooses among
them, with weights between wheels and joints, and with secondary tasks.

Source: document A, 3.2.4, "Mobile Manipulators"; doc/mathematics.md, "Manipulators".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.diff_drive import wheel_to_body, wheel_to_world_jacobian
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm, arm_forward_kinematics, arm_jacobian
from diffdrive_jacobian.numerics.checks import Checked, Positive, array, numbers, positive, read_only
from diffdrive_jacobian.numerics.elementary import cos, product, sin
from diffdrive_jacobian.numerics.formula import Entries, Number, Rows, Vector, formula

__all__ = ['MobileManipulator', 'mobile_manipulator_jacobian']


@formula('(n),(),(n),(2),(),() -> (3,k)', lengths=positive, r=positive, L=positive)
def mobile_manipulator_jacobian(
    lengths: Vector, theta: Number, q: Vector, mount: Vector, r: Number, L: Number
) -> Rows:
    """Return the Jacobian of `MobileManipulator` with the heading, over wheels and joints.

    For lengths of the links, shape (n,) (m), headings theta of the base, shape (...) (rad), joint angles
    q, shape (..., n) (rad), the position of the arm's base in the frame of the axle centre, shape (2,)
    (m), and wheel radius r and separation L (m), it has the shape (..., 3, 2 + n).
    """
    R = [
        [cos(theta), -sin(theta)],
        [sin(theta), cos(theta)],
    ]
    p_arm = arm_forward_kinematics.formula(lengths, q)
    p = [[mount[0] + p_arm[0]], [mount[1] + p_arm[1]]]
    # The derivative of R by theta.
    R_prime = [
        [-sin(theta), -cos(theta)],
        [cos(theta), -sin(theta)],
    ]
    (x_theta,), (y_theta,) = product(R_prime, p)
    of_base = [
        [1.0, 0.0, x_theta],
        [0.0, 1.0, y_theta],
        [0.0, 0.0, 1.0],
    ]
    of_wheels = product(of_base, wheel_to_world_jacobian.formula(theta, r, L))
    of_joints = [*product(R, arm_jacobian.formula(lengths, q)), [1.0] * len(q)]
    return [[*wheels, *joints] for wheels, joints in zip(of_wheels, of_joints, strict=True)]


def _mount(name: str, value: Any) -> NDArray[np.float64]:
    """Require a position, shape (2,). Returns it read-only."""
    return read_only(numbers(name, value, 2))


@dataclass(frozen=True, eq=False)
class MobileManipulator(Checked):
    """A differential-drive base with a planar arm.

    r or L that is not positive and finite, and another mount than `[m_x, m_y]`, raise ValueError.
    """

    r: Positive
    """Wheel radius (m)."""
    L: Positive
    """Wheel separation (m)."""
    arm: PlanarArm
    """Its x axis points forward."""
    mount: Annotated[Any, _mount] = (0.0, 0.0)
    """Position of the arm's base in the frame of the axle centre, `[m_x, m_y]` (m)."""

    @property
    def coordinates(self) -> int:
        """Number of coordinates of the configuration, 3 + n."""
        return 3 + self.arm.joints

    @property
    def inputs(self) -> int:
        """Number of inputs, 2 + n."""
        return 2 + self.arm.joints

    @formula('(coordinates) -> (3)')
    def forward_kinematics(self, q: Vector) -> Entries:
        """Return the pose of the tip in the world.

        For q, shape (..., 3 + n), it is `[x, y, heading]`, shape (..., 3) (m, m, rad).
        """
        x, y, heading = arm_forward_kinematics.formula(self.arm.lengths.tolist(), q[3:])
        tip = [self.mount[0] + x, self.mount[1] + y, heading]
        pose: Entries = se2.compose.formula(q[:3], tip)
        return pose

    def jacobian(self, q: ArrayLike, heading: bool = False) -> NDArray[np.float64]:
        """Map the velocities of wheels and joints to that of the tip.

        `[[I_2 | R'(theta) (m + p_arm)] S(theta) J_w | R(theta) J_arm]`: the wheels move the tip as a
        part of the base, and the joints move it as the arm does, turned into the world. For q, shape
        (..., 3 + n), it has the shape (..., 2, 2 + n), or with the heading of the tip (..., 3, 2 + n),
        over `[omega_R, omega_L, q_1_dot, ...]`.
        """
        q = array('q', q, self.coordinates)
        J = mobile_manipulator_jacobian(
            self.arm.lengths, q[..., 2], q[..., 3:], self.mount, self.r, self.L
        )
        return J if heading else J[..., :2, :]

    def configuration_jacobian(self, q: ArrayLike) -> NDArray[np.float64]:
        """Map the inputs to the velocity of the configuration: `q_dot = G(q) [omega_R, omega_L, ...]`.

        G, shape (..., 3 + n, 2 + n), is `S(theta) J_w` for the pose of the base and the identity for the
        joints. The gradient of a function of q becomes one over the inputs by `G^T gradient`: with it,
        secondary tasks such as `manipulability_gradient(robot.jacobian, q)` fit `redundant` (A, 3.2.5).
        """
        theta = array('q', q, self.coordinates)[..., 2]
        G = np.zeros((*theta.shape, self.coordinates, self.inputs))
        G[..., :3, :2] = wheel_to_world_jacobian(theta, self.r, self.L)
        G[..., 3:, 2:] = np.eye(self.arm.joints)
        return G

    @formula('(coordinates),(inputs),() -> (coordinates)')
    def integrate(self, q: Vector, q_dot: Vector, dt: Number) -> Entries:
        """Return the configuration after a time at constant input. The base follows an exact arc.

        For q, shape (..., 3 + n), inputs q_dot, shape (..., 2 + n) (rad/s), and durations, shape (...)
        (s), it has the shape (..., 3 + n), theta wrapped.
        """
        twist = wheel_to_body.formula(q_dot[0], q_dot[1], self.r, self.L)
        joints = [q_i + q_dot_i * dt for q_i, q_dot_i in zip(q[3:], q_dot[2:], strict=True)]
        return [*se2.integrate.formula(q[:3], twist, dt), *joints]
