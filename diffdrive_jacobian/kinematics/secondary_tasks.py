"""What the joints that a task leaves free are used for: manipulability, and distance from joint limits.

The gradients are secondary joint velocities for `inverse_velocity.redundant`. They are taken over the
configuration q. A mobile manipulator's inputs are fewer than its coordinates: with its
`configuration_jacobian` G the gradient over the inputs is `G^T gradient`.

Everything broadcasts over leading axes. Wrong shapes, shapes that do not broadcast and values that are
not finite raise ValueError.

Source: document A, 3.2.3 and 3.2.5; document D, 3; doc/mathematics.md, "Manipulators".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics import _singular_values
from diffdrive_jacobian.kinematics._task_checks import finite_result
from diffdrive_jacobian.numerics.checks import array, leading

_STEP = float(np.finfo(np.float64).eps) ** (1.0 / 3.0)
"""Step of central differences, at which rounding and truncation errors are of the same size."""
_LARGE, _UNIT = 2.0**960, 2.0**-60
"""Angles from which on ranges might overflow, and the factor by which these angles are scaled."""

Array = NDArray[np.float64]


def manipulability(J: ArrayLike) -> Array:
    """Return Yoshikawa's distance of a Jacobian from singular: `w = sqrt(det(J J^T))` (A, D).

    Args:
        J: Jacobians, shape (..., m, n).

    Returns:
        w, shape (...): the product of the singular values, 0 where J is singular. Also 0 where it has
        more rows than columns, because some velocities cannot be produced then. Infinite where it
        overflows.
    """
    J = array('J', J, 'm', 'n')
    rows, columns = J.shape[-2:]
    return np.zeros(J.shape[:-2]) if rows > columns else _singular_values.manipulability(J)


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
    above, below = (manipulability(jacobian(around + sign * steps)) for sign in (1.0, -1.0))
    if above.shape != q.shape:
        raise ValueError(
            f'jacobian must return one Jacobian for each configuration, shape (*{q.shape}, m, n), got '
            f'manipulabilities of shape {above.shape}'
        )
    gradient: Array = (above - below) / (2.0 * _STEP)
    return gradient


def joint_limit_cost(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Array:
    """Return how far joints are from the middle of their ranges: `1/(2n) sum(((q - middle) / range)^2)`.

    Source: A. Liegeois, "Automatic supervisory control of the configuration and behavior of multibody
    mechanisms", 1977. A names it as a use of the null space (3.2.5).

    Args:
        q: Joint angles, shape (..., n) (rad).
        lower: Lower limits, shape (..., n), or one for all joints (rad).
        upper: Upper limits, above the lower ones, shape (..., n), or one for all joints (rad).

    Returns:
        The cost, shape (...): 0 in the middle, 1/8 with every joint at a limit.
    """
    deviation, _, _ = _deviation(q, lower, upper)
    if type(deviation) is list:
        squares = 0.0
        for entry in deviation:
            squares += entry * entry
        single = np.asarray(squares / len(deviation) / 2.0)[()]
        if not math.isfinite(single):
            finite_result('q, lower and upper', 'cost', single)
        return single
    with np.errstate(all='ignore'):
        cost: Array = (deviation * deviation).mean(axis=-1) / 2.0
    finite_result('q, lower and upper', 'cost', cost)
    return cost


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
    deviation, span, unit = _deviation(q, lower, upper)
    if type(deviation) is list:
        n = len(deviation)
        slopes = [entry / (width * n) for entry, width in zip(deviation, span, strict=True)]
        if not math.isfinite(sum(slopes)):
            finite_result('q, lower and upper', 'gradient', np.array(slopes))
        return np.array(slopes)
    with np.errstate(all='ignore'):
        gradient: Array = deviation / (span * deviation.shape[-1]) * unit
    finite_result('q, lower and upper', 'gradient', gradient)
    return gradient


def _deviation(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> tuple[Any, Any, Any]:
    """Return each joint's distance from the middle of its range in units of the range, the range, and
    the unit of the latter: 1, or smaller where the range of angles might overflow.
    """
    angles = array('q', q, 'n')
    low, high = array('lower', lower), array('upper', upper)
    for name, value in (('lower', low), ('upper', high)):
        if value.shape[-1:] not in ((), angles.shape[-1:]):
            allowed = f'() or (..., {angles.shape[-1]})'
            raise ValueError(f'{name} must have shape {allowed}, got {value.shape}')
    if angles.ndim == 1 and low.ndim < 2 and high.ndim < 2:
        # Lists of floats.
        sides = [v.tolist() if v.ndim else [float(v)] * len(angles) for v in (angles, low, high)]
        deviations, spans = [], []
        for x, a, b in zip(*sides, strict=True):
            if not (b - a > _UNIT and min(x, a) > -_LARGE and max(x, b) < _LARGE):
                break
            deviations.append((x - (a + b) / 2.0) / (b - a))
            spans.append(b - a)
        else:
            return deviations, spans, 1.0
    leading(q=angles.shape, lower=low.shape, upper=high.shape)
    if not (high > low).all():
        raise ValueError(f'upper must be above lower for every joint, got {high} and {low}')
    unit: Any = 1.0
    if not all(np.max(np.abs(value), initial=0.0) < _LARGE for value in (angles, low, high)):
        largest = np.maximum(np.abs(angles), np.maximum(np.abs(low), np.abs(high)))
        unit = np.where(largest < _LARGE, 1.0, _UNIT)
        angles, low, high = angles * unit, low * unit, high * unit
    span = high - low
    with np.errstate(all='ignore'):
        return (angles - (low + high) / 2.0) / span, span, unit
