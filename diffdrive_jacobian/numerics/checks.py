# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Checks: what a value must be, of an argument, of a field of a dataclass, or of an entry of a file.

A check is a function `check(name, value)`. It returns the value, converted if need be, or raises a
ValueError that says what is wrong, what was got and what is allowed.

    @dataclass(frozen=True)
    class Delay(Checked):
        topic: Name
        seconds: Positive
        limits: VelocityLimits
        copies: Annotated[int, partial(integer, low=1)] = 1

NumPy takes long to import, and is imported with the first array.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import operator
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, partial
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar, Union, get_args, get_origin

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array: TypeAlias = NDArray[Any]

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

T = TypeVar('T')
Check: TypeAlias = Callable[[str, Any], Any]
MAX_NANOSECONDS = 2**63 - 1
"""Largest time of ROS clocks (ns)."""
ROUNDING = 1e-8
"""Tolerance on symmetry and semidefiniteness of a covariance, relative to its largest entry."""


def short(value: Any, express: Callable[[Any], str] = str) -> str:
    """Return a value as text of at most 60 characters."""
    try:
        got = express(value)
    except Exception:  # of an integer with thousands of digits, or of an object of others
        got = f'an object of class {type(value).__name__}'
    return got if len(got) <= 60 else f'{got[:57]}...'


# --- Types


def of_type(wanted: type[T], words: str) -> Callable[[str, Any], T]:
    """Return a check that requires an object of a class, which messages call `words`."""

    def check(name: str, value: Any) -> T:
        if not isinstance(value, wanted):
            raise ValueError(f'{name} must be {words}, got {short(value, repr)}')
        return value

    return check


text = of_type(str, 'a string')
mapping = of_type(dict, 'a map')
sequence = of_type(list, 'a list')


def instance(name: str, value: Any, wanted: type) -> Any:
    """Require an object of a class."""
    return of_type(wanted, f'of class {wanted.__name__}')(name, value)


def boolean(name: str, value: Any) -> bool:
    """Require a Boolean, also of NumPy."""
    if not isinstance(value, bool) and not (getattr(value, 'dtype', '') == 'bool' and value.ndim == 0):
        raise ValueError(f'{name} must be True or False, got {short(value, repr)}')
    return bool(value)


def function(name: str, value: Any, allowed: str = 'a function') -> Any:
    """Require a callable object. An error says what is `allowed`."""
    if not callable(value):
        raise ValueError(f'{name} must be {allowed}, got {short(value)}')
    return value


def optional(check: Check) -> Check:
    """Return a check that also allows None."""
    return lambda name, value: None if value is None else check(name, value)


# --- Strings and choices


def nonempty(name: str, value: Any) -> str:
    """Require a string that is not empty."""
    if not isinstance(value, str) or not value:
        raise ValueError(f'{name} must be a string that is not empty, got {short(value, repr)}')
    return value


def names(name: str, value: Any) -> tuple[str, ...]:
    """Require strings that are not empty, but not a single string. Returns a tuple."""
    if not isinstance(value, str) and isinstance(value, Iterable):
        found = tuple(value)
        if all(isinstance(one, str) and one for one in found):
            return found
    raise ValueError(f'{name} must be a list or tuple of names, got {short(value, repr)}')


def choices(allowed: Iterable[Any]) -> str:
    """Return what `one_of` allows, in words."""
    return f'one of {", ".join(map(repr, allowed)) or "(none)"}'


def one_of(*allowed: Any) -> Check:
    """Return a check that requires one of some values."""

    def check(name: str, value: Any) -> Any:
        if value not in allowed:
            raise ValueError(f'{name} must be {choices(allowed)}, got {short(value, repr)}')
        return value

    return check


# --- Integers


def integer(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """Require an integer from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not low <= int(value) <= high:
        allowed = f'of at least {low}' if high == math.inf else f'from {low} to {high}'
        raise ValueError(f'{name} must be an integer {allowed}, got {short(value, repr)}')
    return int(value)


def nanoseconds(name: str, value: Any) -> int:
    """Require a time or a duration, an integer that fits into 64 bits (ns)."""
    try:
        time = operator.index(value)
    except TypeError:
        time = None
    if time is None or type(value).__name__ in ('bool', 'bool_'):
        raise ValueError(f'{name} must be an integer number of nanoseconds (ns), got {short(value)}')
    if not -MAX_NANOSECONDS <= time <= MAX_NANOSECONDS:
        raise ValueError(f'{name} must fit into 64 bits (ns), got {short(value)}')
    return time


# --- Numbers, and arrays of them by their entries


def numbers_that(inside: Callable[[Any], Any], allowed: str) -> Check:
    """Return a check of a float, or of each entry of an array, by a comparison."""

    def check(name: str, value: Any) -> Any:
        good = inside(value)
        if good is not True and not (good.all() if hasattr(good, 'all') else good):
            if getattr(good, 'ndim', 0):
                index = tuple(int(axis[0]) for axis in (~good).nonzero())
                value = f'{value[index]} at index {index if len(index) > 1 else index[0]}'
            raise ValueError(f'{name} must be {allowed}, got {value}')
        return value

    check.__doc__ = f'Require a number, or each entry of an array, to be {allowed}.'
    return check


def anything(name: str, value: Any) -> Any:
    """Require nothing of numbers: they were checked before, and may be infinite."""
    return value


def _is_finite(value: Any) -> Any:
    if type(value) is float:
        return math.isfinite(value)
    import numpy as np

    return np.isfinite(value)


finite = numbers_that(_is_finite, 'finite')
positive = numbers_that(lambda value: (value > 0.0) & (value < math.inf), 'positive and finite')
positive_or_infinite = numbers_that(lambda value: value > 0.0, 'positive')
not_negative = numbers_that(
    lambda value: (value >= 0.0) & (value < math.inf), 'zero or positive and finite'
)
not_negative_or_infinite = numbers_that(lambda value: value >= 0.0, 'zero or positive')
not_positive_or_infinite = numbers_that(lambda value: value <= 0.0, 'zero or negative')
negative_or_infinite = numbers_that(lambda value: value < 0.0, 'negative or -inf')
offset = numbers_that(
    lambda value: (value != 0.0) & (abs(value) < math.inf),
    'finite and not 0, because the Jacobian of the axle centre has rank 1',
)


def number(name: str, value: Any, check: Check = finite) -> float:
    """Require a single number. It is checked as a float."""
    result = value if type(value) is float else _float(name, value)
    check(name, result)
    return result


def _float(name: str, value: Any) -> float:
    """Return a single number of any kind as a float."""
    if hasattr(value, '__array__') and not isinstance(value, float):
        value = value.__array__()
        if value.shape:
            raise ValueError(f'{name} must be a single number, got shape {value.shape}')
        # Durations of NumPy count as integers.
        value = value[()] if value.dtype.kind in 'iufO' else value
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f'{name} must be a number, got {short(value, repr)}')
    try:
        return float(value)
    except OverflowError:
        raise ValueError(f'{name} must be finite, got {short(value)}') from None


@dataclass(frozen=True, slots=True)
class Range:
    """Finite numbers between limits: a check of a single number, and the numbers themselves."""

    low: float
    """Smallest number."""
    high: float = math.inf
    """Largest number; infinity: all finite ones."""
    above: float | None = None
    """Lower limit that is itself not allowed, besides `low`."""
    unit: str = ''
    """Unit, for messages."""

    def __call__(self, name: str, value: Any) -> float:
        """Require a single number of the range."""
        result = _float(name, value)
        if result not in self:
            raise ValueError(f'{name} must be {self}, got {short(value)}')
        return result

    def __contains__(self, value: float) -> bool:
        """Return whether a number is in the range; NaN is not."""
        return (
            self.low <= value <= self.high
            and value < math.inf
            and (self.above is None or value > self.above)
        )

    def __str__(self) -> str:
        """Return the range in words."""
        above = None if self.above is None or self.above < self.low else self.above
        ends = self.low if above is None else above, self.high
        first, last = (str(end) if isinstance(end, int) else f'{end:g}' for end in ends)
        if self.high == math.inf:
            words = f'finite and {"at least" if above is None else "above"} {first}'
        else:
            words = f'in {"[" if above is None else "("}{first}, {last}]'
        return f'{words} {self.unit}'.strip()


def between(low: float, high: float = math.inf, *, above: float | None = None, unit: str = '') -> Range:
    """Return a check that requires a single finite number in a range.

    Args:
        low: Smallest number allowed.
        high: Largest number allowed; infinity: all finite ones.
        above: Lower bound that is itself not allowed, besides `low`.
        unit: Unit, for messages.
    """
    return Range(low, high, above, unit)


# --- Arrays


def floats(name: str, value: Any) -> Array:
    """Convert a value to an array of floats: real numbers in rows of one length."""
    import numpy as np

    try:
        array = np.asarray(value)
        # Objects may be numbers, such as fractions.
        if array.dtype.kind not in 'biuf' and not (
            array.dtype.kind == 'O' and all(isinstance(entry, Real) for entry in array.flat)
        ):
            raise TypeError('neither text, complex numbers nor None are')
        return array.astype(np.float64, copy=False)
    except (OverflowError, TypeError, ValueError) as error:
        raise ValueError(
            f'{name} must be an array of real numbers, got {short(value)} ({error})'
        ) from error


def shaped(name: str, value: Any, *trailing: int | str) -> Array:
    """Convert a value to an array of floats with given last axes. A letter is any length but zero."""
    result = floats(name, value)
    last = result.shape[max(result.ndim - len(trailing), 0) :]
    if len(last) < len(trailing) or not all(
        got == wanted or (isinstance(wanted, str) and got > 0)
        for got, wanted in zip(last, trailing, strict=True)
    ):
        axes = ', '.join(['...', *map(str, trailing)])
        raise ValueError(f'{name} must have shape ({axes}), got {result.shape}')
    return result


def array(name: str, value: Any, *trailing: int | str) -> Array:
    """Convert a value as `shaped` does, and require it to be finite."""
    result: Array = finite(name, shaped(name, value, *trailing))
    return result


def numbers(name: str, value: Any, size: int) -> tuple[float, ...]:
    """Require a single vector of finite numbers, shape (size,). Returns floats."""
    floats_alone = type(value) is tuple and len(value) == size and set(map(type, value)) == {float}
    if floats_alone and math.isfinite(sum(value)):
        # A finite sum has finite terms.
        return value  # type: ignore[no-any-return]
    result = array(name, value, size)
    if result.ndim != 1:
        raise ValueError(f'{name} must have shape ({size},), got {result.shape}')
    return tuple(result.tolist())


# Without a call of their own: a robot checks each command.
pair: Callable[[str, Any], tuple[float, float]] = partial(numbers, size=2)  # type: ignore[assignment]
triple: Callable[[str, Any], tuple[float, float, float]] = partial(numbers, size=3)  # type: ignore[assignment]


def semidefinite(name: str, value: Array) -> Array:
    """Require covariance matrices, shape (..., n, n): symmetric and positive semidefinite."""
    import numpy as np

    finite(name, value)
    largest = np.abs(value).max(axis=(-2, -1), initial=0.0)
    with np.errstate(over='ignore'):
        skew = np.abs(value - np.swapaxes(value, -1, -2)).max(axis=(-2, -1), initial=0.0)
    scaled = value / np.where(largest > 0.0, largest, 1.0)[..., np.newaxis, np.newaxis]
    least = np.linalg.eigvalsh(scaled).min(axis=-1, initial=0.0)
    good = (skew <= ROUNDING * largest) & (least >= -ROUNDING)
    if not good.all():
        got = value[tuple(np.argwhere(~good)[0])].tolist()
        raise ValueError(f'{name} must be symmetric and positive semidefinite, got {got}')
    return value


def leading(**shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Broadcast the leading axes of arguments, given the shape of each without the axes of one robot."""
    if not any(shapes.values()):
        return ()
    import numpy as np

    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        # A single value broadcasts with any shape.
        several = {name: shape for name, shape in shapes.items() if shape}
        shown = ', '.join(f'{name} {shape}' for name, shape in several.items())
        raise ValueError(
            f'{" and ".join(several)} must have leading axes that broadcast, got {shown}'
        ) from None


def read_only(value: Any) -> Array:
    """Return a read-only copy of an array, for immutable objects."""
    import numpy as np

    copy = np.array(value, dtype=np.float64)
    copy.setflags(write=False)
    return copy


# --- Fields of dataclasses

Name = Annotated[str, nonempty]
Names = Annotated[tuple[str, ...], names]
Count = Annotated[int, partial(integer, low=1)]
Finite = Annotated[float, number]
Positive = Annotated[float, partial(number, check=positive)]
PositiveOrInfinite = Annotated[float, partial(number, check=positive_or_infinite)]
NegativeOrInfinite = Annotated[float, partial(number, check=negative_or_infinite)]
NotNegative = Annotated[float, partial(number, check=not_negative)]
NotNegativeOrInfinite = Annotated[float, partial(number, check=not_negative_or_infinite)]
Probability = Annotated[float, between(0.0, 1.0)]


class Checked:
    """Base class of frozen dataclasses whose annotations declare checks.

    A field of the type `Annotated[..., check]` has that check. One of type bool, str or of a dataclass
    must be of it, and `| None` also allows None. Other fields have none. Types are names of the module
    of the class, not only for type checkers: they are evaluated when the first object is made.

    In a dataclass with slots a `__post_init__` calls `Checked.__post_init__(self)`, because `super()`
    does not work there.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check and convert the fields, those of base classes first."""
        kind: Any = type(self)
        for name, check in _declared(kind).items():
            object.__setattr__(self, name, check(name, getattr(self, name)))


@cache
def _declared(kind: type) -> dict[str, Check]:
    """Return the checks of the fields of a class, which are evaluated when it is used first."""
    declared: dict[str, Check] = {}
    given = {field.name for field in dataclasses.fields(kind) if field.init}
    for base in reversed(kind.__mro__):
        for name, annotation in inspect.get_annotations(base).items():
            declared.pop(name, None)
            if isinstance(annotation, str):
                try:
                    annotation = eval(annotation, vars(sys.modules[base.__module__]))
                except NameError as error:
                    raise TypeError(
                        f'{base.__name__}.{name} must have a type of its module: {error}'
                    ) from None
            if name in given and (check := _check_of(annotation)):
                declared[name] = check
    return declared


def _check_of(annotation: Any) -> Check | None:
    """Return what a type requires."""
    if metadata := getattr(annotation, '__metadata__', ()):
        check: Check = metadata[0]
        return check
    if get_origin(annotation) in (Union, UnionType):
        types = [one for one in get_args(annotation) if one is not NoneType]
        of_it = _check_of(types[0]) if len(types) == 1 else None
        return optional(of_it) if of_it else None
    if annotation is bool or annotation is str:
        return boolean if annotation is bool else text
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        return partial(instance, wanted=annotation)
    return None


class Comparable(Checked):
    """Base class of frozen dataclasses whose fields are scalars or arrays, compared by their entries."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        """Compare every field, arrays by shape and entries."""
        return self._values() == other._values() if type(other) is type(self) else NotImplemented

    def __hash__(self) -> int:
        """Return a hash that equal values share."""
        return hash(self._values())

    def _values(self) -> tuple[Any, ...]:
        return tuple(_entries(getattr(self, field.name)) for field in dataclasses.fields(self))  # type: ignore[arg-type]


def _entries(value: Any) -> Any:
    """Return an array, also in a tuple, as its shape and its entries."""
    if isinstance(value, tuple):
        return tuple(map(_entries, value))
    return (value.shape, *value.ravel().tolist()) if hasattr(value, 'shape') else value


def constant(name: str, value: Any, check: Check) -> Any:
    """Convert and check a field of an immutable object. Returns a float, or a read-only array."""
    array = floats(name, value)
    return check(name, read_only(array) if array.ndim else float(array))
