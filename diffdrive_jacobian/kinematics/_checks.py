"""Checks of arguments; every error names the argument, what was got and what is allowed."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_NANOSECONDS = 2**63 - 1
"""Largest time in nanoseconds, which is that of ROS clocks."""
_FLOAT64 = np.dtype(np.float64)


def positive(name: str, value: Any) -> None:
    """Require a length to be positive and finite.

    Raises:
        ValueError: An entry is zero, negative, infinite or NaN.
    """
    # A plain float takes the first test alone: this runs for every message.
    inside = (value > 0.0) & (value < np.inf)
    if inside is not True and not np.all(inside):
        raise ValueError(f'{name} must be positive and finite, got {_first(value, inside)}')


def not_negative(name: str, value: Any) -> None:
    """Require a number to be zero or positive, and finite.

    Raises:
        ValueError: An entry is negative, infinite or NaN.
    """
    inside = (value >= 0.0) & (value < np.inf)
    if inside is not True and not np.all(inside):
        raise ValueError(f'{name} must be zero or positive and finite, got {_first(value, inside)}')


def offset(name: str, value: Any) -> None:
    """Require a control point beside the axle.

    Raises:
        ValueError: An entry is zero, infinite or NaN.
    """
    inside = (value != 0.0) & (abs(value) < np.inf)
    if inside is not True and not np.all(inside):
        raise ValueError(
            f'{name} must be finite and not 0, for the Jacobian of the axle centre itself has rank 1; '
            f'got {_first(value, inside)}'
        )


def finite(name: str, value: Any) -> None:
    """Require numbers.

    Raises:
        ValueError: An entry is infinite or NaN.
    """
    if type(value) is float:
        if not math.isfinite(value):
            raise ValueError(f'{name} must be finite, got {value}')
        return
    inside = np.isfinite(value)
    if not inside.all():
        raise ValueError(f'{name} must be finite, got {_first(value, inside)}')


def floats(name: str, value: Any) -> NDArray[np.float64]:
    """Make a float array of a value.

    Raises:
        ValueError: It holds something else than real numbers, or rows of several lengths.
    """
    if type(value) is np.ndarray and value.dtype is _FLOAT64:
        return value
    try:
        array = np.asarray(value)
        # Objects may be numbers, too, such as fractions.
        known = array.dtype.kind in 'biuf'
        if not known and not (
            array.dtype.kind == 'O' and all(isinstance(entry, Real) for entry in array.flat)
        ):
            raise TypeError('neither text, complex numbers nor None are')
        return array.astype(np.float64, copy=False)
    except (OverflowError, TypeError, ValueError) as error:
        raise ValueError(
            f'{name} must be an array of real numbers, got {short(value)} ({error})'
        ) from error


def number(name: str, value: Any, check: Callable[[str, Any], None]) -> float:
    """Make a float of a single number that passes a check.

    Raises:
        ValueError: It does not, or it is something else.
    """
    made = floats(name, value)
    if made.ndim:
        raise ValueError(f'{name} must be a single number, got shape {made.shape}')
    check(name, float(made))
    return float(made)


def array(name: str, value: Any, *trailing: int | str) -> NDArray[np.float64]:
    """Make a finite float array with these last axes; a letter stands for any length but zero.

    Raises:
        ValueError: The shape is another one, or an entry is infinite, NaN or no number.
    """
    made = floats(name, value)
    shape = made.shape[made.ndim - len(trailing) :] if made.ndim >= len(trailing) else None
    if shape is None or any(
        got == 0 if isinstance(wanted, str) else got != wanted
        for got, wanted in zip(shape, trailing, strict=True)
    ):
        axes = ', '.join(['...', *map(str, trailing)])
        raise ValueError(f'{name} must have shape ({axes}), got {made.shape}')
    finite(name, made)
    return made


def nanoseconds(name: str, value: Any) -> int:
    """Return a time or a duration in nanoseconds as an int.

    Raises:
        ValueError: It is no integer, as seconds are not, or does not fit into 64 bits.
    """
    if type(value) is not int:
        try:
            if isinstance(value, bool | np.bool_):
                raise TypeError
            value = operator.index(value)
        except TypeError:
            raise ValueError(
                f'{name} must be an integer number of nanoseconds (ns), got {short(value)}'
            ) from None
    if not -MAX_NANOSECONDS <= value <= MAX_NANOSECONDS:
        raise ValueError(f'{name} must fit into 64 bits (ns), got {short(value)}')
    return int(value)


def boolean(name: str, value: Any) -> bool:
    """Return a Boolean.

    Raises:
        ValueError: It is something else.
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f'{name} must be True or False, got {short(value)}')
    return bool(value)


def instance(name: str, value: Any, wanted: type) -> None:
    """Require an object of a class.

    Raises:
        ValueError: It is of another one.
    """
    if not isinstance(value, wanted):
        raise ValueError(f'{name} must be of class {wanted.__name__}, got {short(value)}')


def function(name: str, value: Any) -> None:
    """Require something that can be called.

    Raises:
        ValueError: It cannot be called.
    """
    if not callable(value):
        raise ValueError(f'{name} must be a function, got {short(value)}')


def read_only(value: Any) -> NDArray[np.float64]:
    """Return a copy of an array that cannot be changed, for objects that are values."""
    copy = np.array(value, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def equal(first: Any, second: Any) -> bool:
    """Return whether numbers or arrays have equal shapes and entries; NaN equals NaN."""
    return bool(np.array_equal(first, second, equal_nan=True))


def hashable(value: Any) -> Any:
    """Return what equal numbers and arrays have in common, for a hash."""
    return value if isinstance(value, float) else (value.shape, *value.ravel().tolist())


def leading(**shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Broadcast the leading axes of arguments.

    Args:
        shapes: For each argument the axes that are left when those of one robot are taken away.

    Returns:
        The axes of the whole batch.

    Raises:
        ValueError: They do not broadcast.
    """
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        # A single value goes with everything.
        several = {name: shape for name, shape in shapes.items() if shape}
        told = ', '.join(f'{name} {shape}' for name, shape in several.items())
        raise ValueError(
            f'{" and ".join(several)} must have leading axes that broadcast, got {told}'
        ) from None


def short(value: Any) -> str:
    """Return how a value is written, in at most 60 characters."""
    try:
        got = str(value)
    except ValueError:  # of an integer with thousands of digits
        got = f'an object of class {type(value).__name__}'
    return got if len(got) <= 60 else f'{got[:57]}...'


def _first(value: Any, inside: Any) -> str:
    """Tell the first entry that is not inside, and where it stands."""
    if np.ndim(value) == 0:
        return f'{value}'
    index = tuple(int(i) for i in np.argwhere(~np.asarray(inside))[0])
    return f'{np.asarray(value)[index]} at index {index if len(index) > 1 else index[0]}'
