"""A planar arm of n revolute joints: positions, Jacobians, singularities, torques.

State: joint angles `q = [q_1, ..., q_n]` (rad), each counted from the link before it; the first from
the x axis of the arm's base. Task: the tip's position x, y (m) and heading (rad), the sum of the angles.

Everything broadcasts over leading axes: q has shape (..., n). Wrong shapes and values that are not
finite raise ValueError.

Source: document A, 3.2.1 (two links) and 3.2.5 (more than the task needs); document D, 2 and 5;
doc/mathematics.md, "Manipulators".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._adjugate import EPS, refuse_singular
from diffdrive_jacobian.numerics.checks import array, positive
from diffdrive_jacobian.numerics.elementary import (
    agree,
    components,
    cos,
    matrix,
    maximum,
    operand,
    sin,
    vector,
    wrapped,
)


@dataclass(frozen=True, eq=False)
class PlanarArm:
    """Links in a chain, each joint turning about the z axis.

    Raises:
        ValueError: There is no link, or a length is not positive and finite.
    """

    lengths: NDArray[np.float64]
    """Distances from joint to joint, the last to the tip, shape (n,) (m). Read-only."""
    _links: list[float] = field(init=False, repr=False)

    def __init__(self, lengths: ArrayLike) -> None:
        """Take the lengths of the links, shape (n,), n >= 1 (m)."""
        checked = array('lengths', lengths, 'n').copy()
        if checked.ndim != 1:
            raise ValueError(f'lengths must have shape (n,), got {checked.shape}')
        positive('lengths', checked)
        checked.flags.writeable = False
        object.__setattr__(self, 'lengths', checked)
        object.__setattr__(self, '_links', checked.tolist())

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
        x: Any = 0.0
        y: Any = 0.0
        entries = [x, y]
        for length, angle in zip(self._links, self._directions(q), strict=True):
            x, y = x + length * cos(angle), y + length * sin(angle)
            entries += [x, y]
        return matrix(self.joints + 1, 2, *entries)

    def forward_kinematics(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return the pose of the tip (A, D): `x = sum l_i cos(q_1 + ... + q_i)`, y with the sine.

        Args:
            q: Joint angles, shape (..., n) (rad).

        Returns:
            `[x, y, heading]`, shape (..., 3) (m, m, rad), the heading wrapped to (-pi, pi].
        """
        if type(q) is np.ndarray and q.ndim == 2 and len(q) == 1:
            # In floats: several times as fast as a batch of one.
            return self.forward_kinematics(q[0])[np.newaxis]
        return vector(*self._tip(self._directions(q)))

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
        if type(q) is np.ndarray and q.ndim == 2 and len(q) == 1:
            return self.jacobian(q[0], heading)[np.newaxis]
        levers = self._levers(self._directions(q))
        entries = [-y for _, y in levers] + [x for x, _ in levers]
        if heading:
            entries += [1.0] * len(levers)
        return matrix(3 if heading else 2, len(levers), *entries)

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
        _, q_2 = components('q', q, 2)
        determinant: NDArray[np.float64] = self._determinant(q_2) * np.float64(1.0)
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
        first = operand('q_1', q_1)
        return matrix(2, 2, first, 0.0, first, math.pi)

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
        q_1, q_2 = components('q', q, 2)
        along_x, along_y = components('x_dot', x_dot, 2)
        agree(q=q_2, x_dot=along_x)
        determinant = self._determinant(q_2)
        # More accurate than from the entries of J: only the rounding of q_2 itself remains.
        blur = 4.0 * EPS * maximum(1.0, abs(q_2))
        refuse_singular(determinant, abs(determinant) <= blur * math.prod(self._links))
        (x, y), (x_2, y_2) = self._levers([q_1, q_1 + q_2])
        return vector(
            (x_2 * along_x + y_2 * along_y) / determinant,
            (-x * along_x - y * along_y) / determinant,
        )

    def joint_torques(self, q: ArrayLike, wrench: ArrayLike) -> NDArray[np.float64]:
        """Return the joint torques of a wrench at the tip: `tau = J^T W` (D, 5).

        Args:
            q: Joint angles, shape (..., n) (rad).
            wrench: Force `[f_x, f_y]` (N), or with the moment `[f_x, f_y, m_z]` (N, N, N m), shape
                (..., 2) or (..., 3).

        Returns:
            Torques, shape (..., n) (N m).
        """
        wrench = array('wrench', wrench, 'm')
        if wrench.shape[-1] not in (2, 3):
            raise ValueError(f'wrench must have shape (..., 2) or (..., 3), got {wrench.shape}')
        directions = self._directions(q)
        f_x, f_y, *moment = components('wrench', wrench, wrench.shape[-1])
        agree(q=directions[0], wrench=f_x)
        torques = [f_y * x - f_x * y for x, y in self._levers(directions)]
        if moment:
            torques = [torque + moment[0] for torque in torques]
        return vector(*torques)

    def integrate(self, q: ArrayLike, q_dot: ArrayLike, dt: ArrayLike) -> NDArray[np.float64]:
        """Return the joint angles after a time at constant velocity: `q + q_dot dt` (D, 4.1).

        Args:
            q: Joint angles at the start, shape (..., n) (rad).
            q_dot: Joint velocities, shape (..., n) (rad/s).
            dt: Duration, shape (...) (s).

        Returns:
            Joint angles at the end, shape (..., n) (rad). They are not wrapped.
        """
        angles, speeds = components('q', q, self.joints), components('q_dot', q_dot, self.joints)
        dt = operand('dt', dt)
        if not type(angles[0]) is type(speeds[0]) is type(dt) is float:
            agree(q=angles[0], q_dot=speeds[0], dt=dt)
        return vector(*[angle + speed * dt for angle, speed in zip(angles, speeds, strict=True)])

    def _directions(self, q: ArrayLike) -> list[Any]:
        """Return the angles of the links to the x axis of the base, floats or of shape (...)."""
        return list(accumulate(components('q', q, self.joints)))

    def _tip(self, directions: list[Any]) -> tuple[Any, Any, Any]:
        """Return position and heading of the tip, floats or of shape (...)."""
        (x, y), *_ = self._levers(directions)
        return x, y, wrapped(directions[-1])

    def _levers(self, directions: list[Any]) -> list[tuple[Any, Any]]:
        """Return the position of the tip relative to each joint, floats or of shape (...)."""
        # Joint by joint, because loops of NumPy over the short last axis take longer.
        levers = []
        of_floats = type(directions[0]) is float
        cosine, sine = (math.cos, math.sin) if of_floats else (np.cos, np.sin)
        x: Any = 0.0
        y: Any = 0.0
        for length, angle in zip(reversed(self._links), reversed(directions), strict=True):
            x, y = x + length * cosine(angle), y + length * sine(angle)
            levers.append((x, y))
        levers.reverse()
        return levers

    def _determinant(self, q_2: Any) -> Any:
        first, second = self._links
        return first * second * sin(q_2)

    def _need_two(self, what: str) -> None:
        if self.joints != 2:
            raise ValueError(f'{what} is for an arm of 2 links, this one has {self.joints}')
