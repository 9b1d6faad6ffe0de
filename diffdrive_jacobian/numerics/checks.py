"""Checks of arguments. They raise ValueError with the argument, its value and the values allowed.

Those that need no NumPy are in `fields`.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable
from functools import partial
from numbers import Real
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.numerics import fields
from diffdrive_jacobian.numerics.fields import (
    between,
    finite,
    not_negative,
    not_negative_or_infinite,
    not_positive_or_infinite,
    offset,
    positive,
    positive_or_infinite,
    short,
)

__all__ = [
    'between',
    'finite',
    'not_negative',
    'not_negative_or_infinite',
    'not_positive_or_infinite',
    'offset',
    'positive',
    'positive_or_infinite',
    'semidefinite',
]

MAX_NANOSECONDS = 2**63 - 1
"""Largest time of ROS clocks (ns)."""
FLOAT64 = np.dtype(np.float64)
ROUNDING = 1e-8
"""Tolerance on symmetry and semidefiniteness of a covariance, relative to its largest entry."""


def semidefinite(name: str, value: NDArray[np.float64]) -> None:
    """Require covariance matrices, shape (..., n, n): symmetric and positive semidefinite."""
    finite(name, value)
    transposed = np.swapaxes(value, -1, -2)
    largest = np.abs(value).max(axis=(-2, -1), initial=0.0)
    with np.errstate(over='ignore'):
        skew = np.abs(value - transposed).max(axis=(-2, -1), initial=0.0)
    scaled = value / np.where(largest > 0.0, largest, 1.0)[..., np.newaxis, np.newaxis]
    least = np.linalg.eigvalsh(scaled).min(axis=-1, initial=0.0)
    inside = (skew <= ROUNDING * largest) & (least >= -ROUNDING)
    if not inside.all():
        index = tuple(np.argwhere(~inside)[0])
        raise ValueError(
            f'{name} must be symmetric and positive semidefinite, got {value[index].tolist()}'
        )


def anything(name: str, value: Any) -> None:
    """Require nothing: the value was checked before, and may be infinite."""


def floats(name: str, value: Any) -> NDArray[np.float64]:
    """Convert a value to a float array: real numbers in rows of one length."""
    if type(value) is np.ndarray and value.dtype is FLOAT64:
        return value
    try:
        array = np.asarray(value)
        if array.dtype is FLOAT64:
            return array
        # Objects may be numbers, such as fractions.
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
    """Convert a single number to a float, and check it."""
    if type(value) is not float:
        if isinstance(value, bool | np.bool_ | str | None):
            raise ValueError(f'{name} must be a number, got {short(value, repr)}')
        result = floats(name, value)
        if result.ndim:
            raise ValueError(f'{name} must be a single number, got shape {result.shape}')
        value = float(result)
    check(name, value)
    return float(value)


Finite = Annotated[float, partial(number, check=finite)]
Positive = Annotated[float, partial(number, check=positive)]
PositiveOrInfinite = Annotated[float, partial(number, check=positive_or_infinite)]
NotNegative = Annotated[float, partial(number, check=not_negative)]
NotNegativeOrInfinite = Annotated[float, partial(number, check=not_negative_or_infinite)]
Probability = Annotated[float, partial(number, check=between(0.0, 1.0))]


def array(name: str, value: Any, *trailing: int | str) -> NDArray[np.float64]:
    """Convert a value to a finite float array with given last axes. A letter is any length but zero."""
    result = shaped(name, value, *trailing)
    finite(name, result)
    return result


def shaped(name: str, value: Any, *trailing: int | str) -> NDArray[np.float64]:
    """Convert a value to a float array with given last axes. A letter is any length but zero."""
    result = floats(name, value)
    if not _ends_with(result.shape, trailing):
        axes = ', '.join(['...', *map(str, trailing)])
        raise ValueError(f'{name} must have shape ({axes}), got {result.shape}')
    return result


def numbers(name: str, value: Any, size: int) -> list[float]:
    """Convert a single vector, shape (size,), to finite floats."""
    result = array(name, value, size)
    if result.ndim != 1:
        raise ValueError(f'{name} must have shape ({size},), got {result.shape}')
    return list(result.tolist())


def _ends_with(shape: tuple[int, ...], trailing: tuple[int | str, ...]) -> bool:
    """Return whether the last axes of a shape are those wanted."""
    last = shape[max(len(shape) - len(trailing), 0) :]
    return len(last) == len(trailing) and all(
        got == wanted or (isinstance(wanted, str) and got > 0)
        for got, wanted in zip(last, trailing, strict=True)
    )


def nanoseconds(name: str, value: Any) -> int:
    """Return a time or a duration in nanoseconds as an int: an integer that fits into 64 bits."""
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
    """Return a Boolean, also of NumPy."""
    return fields.boolean(name, bool(value) if isinstance(value, np.bool_) else value)


def function(name: str, value: Any, allowed: str = 'a function') -> Any:
    """Require a callable object. An error says what is `allowed`."""
    if not callable(value):
        raise ValueError(f'{name} must be {allowed}, got {short(value)}')
    return value


def read_only(value: Any) -> NDArray[np.float64]:
    """Return a read-only copy of an array, for immutable objects."""
    copy = np.array(value, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def constant(name: str, value: Any, check: Callable[[str, Any], None]) -> Any:
    """Convert and check a field of an immutable object. Returns a float, or a read-only array."""
    array = floats(name, value)
    result = read_only(array) if array.ndim else float(array)
    check(name, result)
    return result


class Comparable(fields.Checked):
    """Base class of frozen dataclasses whose fields are scalars or arrays, compared by their entries."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        """Compare every field, arrays by shape and entries."""
        return self._values() == other._values() if type(other) is type(self) else NotImplemented

    def __hash__(self) -> int:
        """Return a hash that equal values share."""
        return hash(self._values())

    def _values(self) -> tuple[Any, ...]:
        values = (getattr(self, field.name) for field in dataclasses.fields(self))  # type: ignore[arg-type]
        return tuple(
            (value.shape, *value.ravel().tolist()) if isinstance(value, np.ndarray) else value
            for value in values
        )


def leading(**shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Broadcast the leading axes of arguments, given the shape of each without the axes of one robot."""
    if not any(shapes.values()):
        return ()
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        # A single value broadcasts with any shape.
        several = {name: shape for name, shape in shapes.items() if shape}
        shown = ', '.join(f'{name} {shape}' for name, shape in several.items())
        raise ValueError(
            f'{" and ".join(several)} must have leading axes that broadcast, got {shown}'
        ) from None
