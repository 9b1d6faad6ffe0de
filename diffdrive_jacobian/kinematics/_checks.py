"""Checks of arguments shared by the kinematics; errors name the argument and what is allowed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def components(name: str, value: ArrayLike, size: int) -> list[Any]:
    """Split vectors along their last axis of `size` entries.

    A single vector gives NumPy scalars, whose arithmetic is ten times faster than that of arrays
    without axes: this runs for every message.

    Raises:
        ValueError: The last axis has another length, or there is none.
    """
    array: NDArray[np.float64] = np.asarray(value, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != size:
        raise ValueError(f'{name} must have shape (..., {size}), got {array.shape}')
    return [array[..., index][()] for index in range(size)]


def positive(name: str, value: Any) -> None:
    """Require a length to be positive and finite.

    Raises:
        ValueError: An entry is zero, negative, infinite or NaN.
    """
    # A plain float takes the first test alone: this runs for every message.
    inside = (value > 0.0) & (value < np.inf)
    if inside is not True and not np.all(inside):
        raise ValueError(f'{name} must be positive and finite, got {value}')
