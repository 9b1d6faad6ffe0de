"""Checks of Jacobians, task velocities, damping and weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.numerics.checks import array, leading, not_negative, positive
from diffdrive_jacobian.numerics.elementary import operand

Array = NDArray[np.float64]


def checked_task(
    J: ArrayLike, x_dot: ArrayLike, name_J: str = 'J', name_x_dot: str = 'x_dot'
) -> tuple[Array, Array]:
    """Return Jacobians, shape (..., m, n), and task velocities, shape (..., m).

    Raises:
        ValueError: A shape is wrong, they do not broadcast, or an entry is not a finite number.
    """
    J = array(name_J, J, 'm', 'n')
    x_dot = array(name_x_dot, x_dot, J.shape[-2])
    if J.ndim == 2 and x_dot.ndim == 1:
        return J, x_dot
    leading(**{name_J: J.shape[:-2], name_x_dot: x_dot.shape[:-1]})
    return J, x_dot


def checked_damping(damping: ArrayLike) -> Array:
    """Return lambda, shape (...).

    Raises:
        ValueError: An entry is negative or not a finite number.
    """
    return np.asarray(operand('damping', damping, not_negative))


def weighted(J: Array, weights: ArrayLike, name_J: str = 'J') -> tuple[Array, Array]:
    """Return `J W^-1/2` and the roots of the weights, shape (..., n).

    Raises:
        ValueError: A weight is not positive and finite, the shape is wrong, or the product overflows.
    """
    values = array('weights', weights, J.shape[-1])
    positive('weights', values)
    leading(J=J.shape[:-2], weights=values.shape[:-1])
    roots = np.sqrt(values)
    with np.errstate(over='ignore'):
        product = np.asarray(J / roots[..., np.newaxis, :])
    # LAPACK may not terminate with infinite entries.
    finite_result(f'{name_J} and weights', 'product', product)
    return product, roots


def finite_result(names: str, result: str, values: Array) -> None:
    """Require a result of finite arguments to be finite.

    Raises:
        ValueError: An entry has overflowed. The message names the arguments and the result.
    """
    if not np.isfinite(values).all():
        raise ValueError(f'{names} must give a finite {result}, but it overflows')
