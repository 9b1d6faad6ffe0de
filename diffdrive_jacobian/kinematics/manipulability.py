"""Manipulability: how far a Jacobian is from singular, and the motion that increases it.

With `J = U diag(s) V^T`, joint velocities of norm 1 give task velocities on an ellipsoid with the
semi-axes `s_i u_i`. Yoshikawa's measure, the product of the s_i, is its volume but for a constant
factor. A flat ellipsoid may have a large volume. The smallest singular value and the condition number
describe its shape. Joint torques of norm 1 balance forces on the ellipsoid with the semi-axes
`u_i / s_i`: in directions in which an arm is slow it is strong. In these functions singular values up
to `CUTOFF max(m, n)` times the largest one count as zero. All measures depend on the units of J: scale
its rows and columns before metres are compared with radians, or joints that have different limits.

The gradient is a secondary task for `inverse_velocity.redundant`. It is taken over the configuration q.
A mobile manipulator's inputs are fewer than its coordinates: with its `configuration_jacobian` G the
gradient over the inputs is `G^T gradient`.

Everything broadcasts over leading axes. Wrong shapes and values that are not finite raise ValueError.

Source: T. Yoshikawa, "Manipulability of robotic mechanisms", 1985, of which documents A (3.2.5) and D
(3) speak without a formula; doc/mathematics.md, "Manipulators".
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics.singular_values import CUTOFF
from diffdrive_jacobian.numerics.checks import array
from diffdrive_jacobian.numerics.formula import Array, formula

_STEP = float(np.finfo(np.float64).eps) ** (1.0 / 3.0)
"""Step of central differences, at which rounding and truncation errors are of the same size."""


@formula('(m,n) -> ()')
def manipulability(J: Any) -> Array:
    """Return Yoshikawa's distance of a Jacobian from singular: `w = sqrt(det(J J^T))`.

    Args:
        J: Jacobians, shape (..., m, n).

    Returns:
        w, shape (...): the product of the singular values, 0 where J is singular. Also 0 where it has
        more rows than columns, because some velocities cannot be produced then.

    Raises:
        ValueError: w overflows.
    """
    if len(J) == 2:
        # Cauchy and Binet: det(J J^T) is the sum of the squared minors.
        minors = [a * d - b * c for (a, c), (b, d) in combinations(zip(*J, strict=True), 2)]
        return np.asarray(np.sqrt(sum(minor * minor for minor in minors)))
    # And the product of the squared singular values.
    s = np.linalg.svd(np.moveaxis(J, (0, 1), (-2, -1)), compute_uv=False)
    return np.asarray(s.prod(axis=-1) * (len(J) <= len(J[0])))


def manipulability_gradient(jacobian: Callable[[Array], ArrayLike], q: ArrayLike) -> Array:
    """Return the gradient of the manipulability, `dw / dq`: a motion away from singularities.

    It is computed by central differences, which are accurate to about ten digits. At a singular
    configuration, where w is not differentiable, they return the mean of both sides. As a secondary
    task: `redundant(J, x_dot, k * manipulability_gradient(arm.jacobian, q))`, k > 0 (A, 3.2.5).

    Args:
        jacobian: Returns the Jacobians, shape (..., m, inputs), of configurations of shape (..., n).
        q: Configurations, shape (..., n) (rad; the base of a mobile manipulator also m).

    Returns:
        The gradients, shape (..., n).
    """
    q = array('q', q, 'n')
    steps = _STEP * np.eye(q.shape[-1])
    around = q[..., np.newaxis, :]
    above, below = manipulability(jacobian(around + steps)), manipulability(jacobian(around - steps))
    if above.shape != q.shape:
        raise ValueError(
            f'jacobian must return one Jacobian for each configuration, shape (*{q.shape}, m, n), got '
            f'manipulabilities of shape {above.shape}'
        )
    return np.asarray((above - below) / (2.0 * _STEP))


class Ellipsoid(NamedTuple):
    """An ellipsoid about zero.

    Attributes:
        directions: Directions of its axes, unit vectors in the columns of U, shape (..., m, m).
        semi_axes: Lengths of its semi-axes, shape (..., m). 0 or infinite in a singular direction.
    """

    directions: Array
    semi_axes: Array


def velocity_ellipsoid(J: ArrayLike) -> Ellipsoid:
    """Return the task velocities `J q_dot` of joint velocities with `|q_dot| <= 1`.

    For joints of different speeds give `J diag(q_dot_max)`.

    Args:
        J: Jacobians, shape (..., m, n).

    Returns:
        Axes `s_i u_i`, the longest first. A semi-axis of 0 is a direction in which the task cannot move.
    """
    U, s = _axes(J)
    return Ellipsoid(U, s)


def force_ellipsoid(J: ArrayLike) -> Ellipsoid:
    """Return the forces W that joint torques `tau = J^T W` with `|tau| <= 1` balance.

    Args:
        J: Jacobians, shape (..., m, n).

    Returns:
        Axes `u_i / s_i`, those of the velocity ellipsoid in the same order, the shortest first. A
        semi-axis is infinite where the structure carries the force without any torque.
    """
    U, s = _axes(J)
    with np.errstate(divide='ignore', over='ignore'):
        return Ellipsoid(U, 1.0 / s)


def smallest_singular_value(J: ArrayLike) -> Array:
    """Return the shortest semi-axis of the velocity ellipsoid, the speed in the slowest direction.

    Args:
        J: Jacobians, shape (..., m, n).

    Returns:
        s_m, shape (...), 0 where J is singular or has more rows than columns.
    """
    _, s = _axes(J)
    return np.asarray(s[..., -1])


def condition_number(J: ArrayLike) -> Array:
    """Return the quotient of the longest and the shortest semi-axis of the velocity ellipsoid.

    Args:
        J: Jacobians, shape (..., m, n).

    Returns:
        `s_1 / s_m`, shape (...), from 1 for a sphere (isotropic) to infinity where J is singular.
    """
    _, s = _axes(J)
    largest, smallest = s[..., 0], s[..., -1]
    with np.errstate(all='ignore'):
        return np.where(smallest > 0.0, largest / smallest, np.inf)


def _axes(J: ArrayLike) -> tuple[Array, Array]:
    """Return U, shape (..., m, m), and the singular values, largest first, shape (..., m)."""
    J = array('J', J, 'm', 'n')
    m, n = J.shape[-2:]
    U, found, _ = np.linalg.svd(J)
    s = np.zeros((*J.shape[:-2], m))
    s[..., : min(m, n)] = np.where(found > CUTOFF * max(m, n) * found[..., :1], found, 0.0)
    return U, s
