"""A planar arm of n revolute joints: positions, Jacobians, singularities, torques.

State: joint angles `q = [q_1, ..., q_n]` (rad), each counted from the link before it; the first from
the x axis of the arm's base. Task: the tip's position x, y (m) and heading (rad), the sum of the angles.

Everything broadcasts over leading axes: q has shape (..., n). Wrong shapes and values that are not
finite raise ValueError.

Source: document A, 3.2.1 (two links) and 3.2.5 (more than the task needs); document D, 2 and 5;
doc/mathematics.md, "Manipulators".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._adjugate import adjugate, refuse_singular
from diffdrive_jacobian.kinematics._checks import array, leading, positive
from diffdrive_jacobian.kinematics._elementary import wrapped


@dataclass(frozen=True, eq=False)
class PlanarArm:
    """Links in a chain, each joint turning about the z axis.

    Raises:
        ValueError: There is no link, or a length is not positive and finite.
    """

    lengths: NDArray[np.float64]
    """Distances from joint to joint, the last to the tip, shape (n,) (m). Read-only."""

    def __init__(self, lengths: ArrayLike) -> None:
        """Take the lengths of the links, shape (n,), n >= 1 (m)."""
        checked = array('lengths', lengths, 'n').copy()
        if checked.ndim != 1:
            raise ValueError(f'lengths must have shape (n,), got {checked.shape}')
        positive('lengths', checked)
        checked.flags.writeable = False
        object.__setattr__(self, 'lengths', checked)

    @property
    def joints(self) -> int:
        """Number of joints, n."""
        return len(self.lengths)

    def joint_positions(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return the positions of the base, of every further joint and of the tip.

        Args:
            q: Joint angles, shape (..., n) (rad).

        Returns:
            Positions in the frame of the arm, shape (..., n + 1, 2) (m). The first is the base, [0, 0].
        """
        angles = np.cumsum(self._angles(q), axis=-1)
        positions = np.zeros((*angles.shape[:-1], self.joints + 1, 2))
        np.cumsum(self.lengths * np.cos(angles), axis=-1, out=positions[..., 1:, 0])
        np.cumsum(self.lengths * np.sin(angles), axis=-1, out=positions[..., 1:, 1])
        return positions

    def forward_kinematics(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return the pose of the tip (A, D): `x = sum l_i cos(q_1 + ... + q_i)`, y with the sine.

        Args:
            q: Joint angles, shape (..., n) (rad).

        Returns:
            `[x, y, heading]`, shape (..., 3) (m, m, rad), the heading wrapped to (-pi, pi].
        """
        angles = np.cumsum(self._angles(q), axis=-1)
        pose = np.empty((*angles.shape[:-1], 3))
        pose[..., 0] = np.cos(angles) @ self.lengths
        pose[..., 1] = np.sin(angles) @ self.lengths
        pose[..., 2] = wrapped(angles[..., -1])
        return pose

    def jacobian(self, q: ArrayLike, heading: bool = False) -> NDArray[np.float64]:
        """Map joint velocities to the velocity of the tip (A, D).

        A joint moves the tip at a right angle to the line from the joint to the tip. For two links:
        `[[-l1 s1 - l2 s12, -l2 s12], [l1 c1 + l2 c12, l2 c12]]`.

        Args:
            q: Joint angles, shape (..., n) (rad).
            heading: Whether the heading of the tip is a part of the task.

        Returns:
            The Jacobian, shape (..., 2, n), or (..., 3, n) with a last row of ones for the heading.
        """
        angles = np.cumsum(self._angles(q), axis=-1)
        jacobian = np.ones((*angles.shape[:-1], 3 if heading else 2, self.joints))
        # From the tip back to the base: a joint turns the part beyond it. Joint by joint, for
        # loops over the short last axis take longer.
        along: Any = 0.0
        across: Any = 0.0
        for joint in reversed(range(self.joints)):
            length, angle = self.lengths[joint], angles[..., joint]
            along, across = along + length * np.cos(angle), across - length * np.sin(angle)
            jacobian[..., 0, joint], jacobian[..., 1, joint] = across, along
        return jacobian

    def determinant(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return the determinant of the Jacobian of two links: `l1 l2 sin(q_2)` (A).

        Args:
            q: Joint angles, shape (..., 2) (rad).

        Returns:
            The determinant, shape (...) (m^2).

        Raises:
            ValueError: The arm has not two links.
        """
        self._need_two('determinant')
        determinant: NDArray[np.float64] = self.lengths.prod() * np.sin(self._angles(q)[..., 1])
        return determinant

    def singular_configurations(self, q_1: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Return the singular configurations of two links: stretched, q_2 = 0, and folded, q_2 = pi (A).

        Args:
            q_1: Angle of the first joint, which does not matter, shape (...) (rad).

        Returns:
            `[[q_1, 0], [q_1, pi]]`, shape (..., 2, 2) (rad).

        Raises:
            ValueError: The arm has not two links.
        """
        self._need_two('singular_configurations')
        first = array('q_1', q_1)
        configurations = np.zeros((*first.shape, 2, 2))
        configurations[..., 0] = first[..., np.newaxis]
        configurations[..., 1, 1] = np.pi
        return configurations

    def inverse_velocity(self, q: ArrayLike, x_dot: ArrayLike) -> NDArray[np.float64]:
        """Return joint velocities of two links for a velocity of the tip, by the adjugate (A, 3.2.1).

        Args:
            q: Joint angles, shape (..., 2) (rad).
            x_dot: Velocity of the tip, shape (..., 2) (m/s).

        Returns:
            Joint velocities, shape (..., 2) (rad/s).

        Raises:
            LinAlgError: A configuration is singular to working precision.
            ValueError: The arm has not two links.
        """
        self._need_two('inverse_velocity')
        q, x_dot = self._angles(q), array('x_dot', x_dot, 2)
        leading(q=q.shape[:-1], x_dot=x_dot.shape[:-1])
        determinant = self.determinant(q)
        # More accurate than from the entries of J: only the rounding of q_2 itself remains.
        blur = 4.0 * np.finfo(np.float64).eps * np.maximum(1.0, np.abs(q[..., 1]))
        refuse_singular(determinant, np.abs(determinant) <= blur * self.lengths.prod())
        turned: NDArray[np.float64] = (adjugate(self.jacobian(q)) @ x_dot[..., np.newaxis])[..., 0]
        return turned / determinant[..., np.newaxis]

    def joint_torques(self, q: ArrayLike, wrench: ArrayLike) -> NDArray[np.float64]:
        """Return the joint torques of a wrench at the tip: `tau = J^T W` (D, 5).

        Args:
            q: Joint angles, shape (..., n) (rad).
            wrench: Force `[f_x, f_y]` (N), or with the moment `[f_x, f_y, m_z]` (N, N, N m), shape
                (..., 2) or (..., 3).

        Returns:
            Torques, shape (..., n) (N m).
        """
        q, wrench = self._angles(q), array('wrench', wrench, 'm')
        if wrench.shape[-1] not in (2, 3):
            raise ValueError(f'wrench must have shape (..., 2) or (..., 3), got {wrench.shape}')
        leading(q=q.shape[:-1], wrench=wrench.shape[:-1])
        jacobian = self.jacobian(q, heading=wrench.shape[-1] == 3)
        torques: NDArray[np.float64] = (wrench[..., np.newaxis, :] @ jacobian)[..., 0, :]
        return torques

    def integrate(self, q: ArrayLike, q_dot: ArrayLike, dt: ArrayLike) -> NDArray[np.float64]:
        """Return the joint angles after a time at constant velocity: `q + q_dot dt` (D, 4.1).

        Args:
            q: Joint angles at the start, shape (..., n) (rad).
            q_dot: Joint velocities, shape (..., n) (rad/s).
            dt: Duration, shape (...) (s).

        Returns:
            Joint angles at the end, shape (..., n) (rad). They are not wrapped.
        """
        q, q_dot, dt = self._angles(q), array('q_dot', q_dot, self.joints), array('dt', dt)
        leading(q=q.shape[:-1], q_dot=q_dot.shape[:-1], dt=dt.shape)
        moved: NDArray[np.float64] = q + q_dot * dt[..., np.newaxis]
        return moved

    def _angles(self, q: ArrayLike) -> NDArray[np.float64]:
        return array('q', q, self.joints)

    def _need_two(self, what: str) -> None:
        if self.joints != 2:
            raise ValueError(f'{what} is for an arm of 2 links, this one has {self.joints}')
