"""Manipulability: how far a Jacobian is from singular, and the motion that increases it.

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
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

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
