"""Limits of joints: of their velocities, and how far their angles are from the middle of their ranges.

The gradient is a secondary task for `inverse_velocity.redundant`. Everything broadcasts over leading
axes. Wrong shapes, shapes that do not broadcast and values that are not finite raise ValueError, and so
does a result that overflows.

Source: document A, 3.2.5, which names joint limits as a use of the null space. A. Liegeois, "Automatic
supervisory control of the configuration and behavior of multibody mechanisms", 1977.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.numerics.checks import (
    array,
    finite,
    floats,
    leading,
    positive_or_infinite,
    shaped,
)
from diffdrive_jacobian.numerics.formula import Array


@np.errstate(all='ignore')
def joint_limit_cost(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Array:
    """Return how far joints are from the middle of their ranges: `1/(2n) sum(((q - middle) / range)^2)`.

    Args:
        q: Joint angles, shape (..., n) (rad).
        lower: Lower limits, shape (..., n), or one for all joints (rad).
        upper: Upper limits, above the lower ones, shape (..., n), or one for all joints (rad).

    Returns:
        The cost, shape (...): 0 in the middle, 1/8 with every joint at a limit.
    """
    q, middle, width = _ranges(q, lower, upper)
    cost = np.asarray(np.mean(((q - middle) / width) ** 2, axis=-1) / 2.0)
    finite('joint_limit_cost of q, lower and upper', cost)
    return cost


@np.errstate(all='ignore')
def joint_limit_gradient(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Array:
    """Return the gradient of `joint_limit_cost`, which points towards the limits.

    As a secondary task: `redundant(J, x_dot, -k * joint_limit_gradient(q, lower, upper))`, k > 0.

    Args:
        q: Joint angles, shape (..., n) (rad).
        lower: Lower limits, shape (..., n), or one for all joints (rad).
        upper: Upper limits, above the lower ones, shape (..., n), or one for all joints (rad).

    Returns:
        The gradients, shape (..., n) (1/rad).
    """
    q, middle, width = _ranges(q, lower, upper)
    gradient = np.asarray((q - middle) / width / (q.shape[-1] * width))
    finite('joint_limit_gradient of q, lower and upper', gradient)
    return gradient


@np.errstate(all='ignore')
def limit_velocity(q_dot: ArrayLike, max_velocity: ArrayLike) -> Array:
    """Scale joint velocities by the largest factor up to 1 with which no joint exceeds its limit.

    All are scaled alike. So every task keeps its direction, a task of velocity 0 is kept, and the result
    is continuous. The price: tasks of all priorities slow down, also those that do not need the joint
    at its limit.

    Args:
        q_dot: Joint velocities, shape (..., n).
        max_velocity: Largest speeds, positive or infinite, shape (..., n), or one for all joints.

    Returns:
        Joint velocities, shape (..., n), no entry larger than its limit, not even by rounding.
    """
    q_dot = array('q_dot', q_dot, 'n')
    most = _for_all_joints('max_velocity', max_velocity, q_dot.shape[-1])
    positive_or_infinite('max_velocity', most)
    leading(q_dot=q_dot.shape[:-1], max_velocity=most.shape[:-1])
    excess = np.max(np.abs(q_dot) / most, axis=-1, keepdims=True)
    finite('q_dot / max_velocity', excess)
    return np.asarray(np.clip(q_dot / np.maximum(excess, 1.0), -most, most))


def _ranges(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array, Array]:
    """Check joint angles and limits. Return the angles, and the middle and the width of their ranges."""
    q = array('q', q, 'n')
    lower, upper = (
        _for_all_joints(name, value, q.shape[-1]) for name, value in (('lower', lower), ('upper', upper))
    )
    finite('lower', lower)
    finite('upper', upper)
    leading(q=q.shape[:-1], lower=lower.shape[:-1], upper=upper.shape[:-1])
    if not (upper > lower).all():
        raise ValueError(f'upper must be above lower for every joint, got {upper} and {lower}')
    width = upper - lower
    finite('upper - lower', width)
    return q, lower + width / 2.0, width


def _for_all_joints(name: str, value: ArrayLike, n: int) -> Array:
    """Return an array of shape (..., n). A single number is for all joints."""
    given = floats(name, value)
    return shaped(name, np.full(n, given) if given.ndim == 0 else given, n)
