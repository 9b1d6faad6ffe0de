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
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.diff_drive import (
    wheel_to_body,
    wheel_to_body_jacobian,
    wheel_to_world_jacobian,
)
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.numerics.checks import array, number, positive
from diffdrive_jacobian.numerics.elementary import (
    agree,
    components,
    cos,
    matrix,
    operand,
    sin,
    vector,
)


@dataclass(frozen=True, eq=False)
class MobileManipulator:
    """A differential-drive base with a planar arm.

    Raises:
        ValueError: r or L is not positive and finite, or the mount is not `[m_x, m_y]`.
    """

    r: float
    """Wheel radius (m)."""
    L: float
    """Wheel separation (m)."""
    arm: PlanarArm
    """Its x axis points forward."""
    mount: Any = (0.0, 0.0)
    """Position of the arm's base in the frame of the axle centre, `[m_x, m_y]` (m)."""

    def __post_init__(self) -> None:
        """Check every dimension."""
        for name in ('r', 'L'):
            object.__setattr__(self, name, number(name, getattr(self, name), positive))
        if not isinstance(self.arm, PlanarArm):
            raise ValueError(f'arm must be a PlanarArm, got {self.arm!r:.60}')
        mount = array('mount', self.mount, 2).copy()
        if mount.ndim != 1:
            raise ValueError(f'mount must have shape (2,), got {mount.shape}')
        mount.flags.writeable = False
        object.__setattr__(self, 'mount', mount)

    def forward_kinematics(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return the pose of the tip in the world.

        Args:
            q: Configurations, shape (..., 3 + n).

        Returns:
            `[x, y, heading]`, shape (..., 3) (m, m, rad).
        """
        base, joints = self._split(q)
        return se2.compose(vector(*base), vector(*self._tip(joints)))

    def jacobian(self, q: ArrayLike, heading: bool = False) -> NDArray[np.float64]:
        """Map the velocities of wheels and joints to that of the tip.

        `[[I_2 | R'(theta) (m + p_arm)] S(theta) J_w | R(theta) J_arm]`: the wheels move the tip as a
        part of the base, and the joints move it as the arm does, turned into the world.

        Args:
            q: Configurations, shape (..., 3 + n).
            heading: Whether the heading of the tip is a part of the task.

        Returns:
            The Jacobian, shape (..., 2, 2 + n), or (..., 3, 2 + n) with the heading, over
            `[omega_R, omega_L, q_1_dot, ...]`.
        """
        (_, _, theta), joints = self._split(q)
        c, s = cos(theta), sin(theta)
        directions = list(accumulate(joints))
        levers = self.arm._levers(directions)
        (x, y), (m_x, m_y) = levers[0], self.mount.tolist()
        x, y = x + m_x, y + m_y
        (half, _), (ratio, _) = wheel_to_body_jacobian(self.r, self.L).tolist()
        # In the frame of the base: v goes along x, and omega moves the tip across its lever arm.
        columns = [(half - y * ratio, x * ratio), (half + y * ratio, -x * ratio)]
        columns += [(-across, along) for along, across in levers]
        entries = [c * along - s * across for along, across in columns]
        entries += [s * along + c * across for along, across in columns]
        if heading:
            entries += [ratio, -ratio] + [1.0] * self.arm.joints
        return matrix(3 if heading else 2, len(columns), *entries)

    def configuration_jacobian(self, q: ArrayLike) -> NDArray[np.float64]:
        """Map the inputs to the velocity of the configuration: `q_dot = G(q) [omega_R, omega_L, ...]`.

        G is `S(theta) J_w` for the pose of the base and the identity for the joints. The gradient of a
        function of q becomes one over the inputs by `G^T gradient`: with it, secondary tasks such as
        `manipulability_gradient(robot.jacobian, q)` fit `redundant` (A, 3.2.5).

        Args:
            q: Configurations, shape (..., 3 + n).

        Returns:
            G, shape (..., 3 + n, 2 + n).
        """
        (_, _, theta), _ = self._split(q)
        jacobian = np.zeros((*np.shape(theta), 3 + self.arm.joints, 2 + self.arm.joints))
        jacobian[..., :3, :2] = wheel_to_world_jacobian(theta, self.r, self.L)
        jacobian[..., 3:, 2:] = np.eye(self.arm.joints)
        return jacobian

    def integrate(self, q: ArrayLike, q_dot: ArrayLike, dt: ArrayLike) -> NDArray[np.float64]:
        """Return the configuration after a time at constant input. The base follows an exact arc.

        Args:
            q: Configurations at the start, shape (..., 3 + n).
            q_dot: `[omega_R, omega_L, q_1_dot, ...]`, shape (..., 2 + n) (rad/s).
            dt: Duration, shape (...) (s).

        Returns:
            Configurations at the end, shape (..., 3 + n), theta wrapped.
        """
        base, joints = self._split(q)
        right, left, *speeds = components('q_dot', q_dot, 2 + self.arm.joints)
        dt = operand('dt', dt)
        if not type(base[0]) is type(right) is type(dt) is float:
            agree(q=base[0], q_dot=right, dt=dt)
        v, omega = wheel_to_body(right, left, self.r, self.L)
        # Tuples of floats need no arrays.
        pose = tuple(base) if type(base[0]) is float else vector(*base)
        twist = (v, omega) if type(v) is float else vector(v, omega)
        driven = se2.integrate(pose, twist, dt)
        moved = [joint + speed * dt for joint, speed in zip(joints, speeds, strict=True)]
        if driven.ndim == 1:
            return np.array([*driven.tolist(), *moved])
        return vector(*components('q', driven, 3), *moved)

    def _split(self, q: ArrayLike) -> tuple[list[Any], list[Any]]:
        """Return the pose of the base and the joint angles, each entry a float or of shape (...)."""
        entries = components('q', q, 3 + self.arm.joints)
        return entries[:3], entries[3:]

    def _tip(self, joints: list[Any]) -> tuple[Any, Any, Any]:
        """Return the pose of the tip in the frame of the base."""
        x, y, heading = self.arm._tip(list(accumulate(joints)))
        m_x, m_y = self.mount.tolist()
        return x + m_x, y + m_y, heading
