"""Dataclasses whose fields declare their checks, and the checks that need no NumPy.

    @dataclass(frozen=True)
    class Delay(Checked):
        topic: Name
        seconds: Positive
        copies: Annotated[int, partial(integer, low=1)] = 1

A check is a function `check(name, value)`. It returns the value, converted if need be, or raises a
ValueError that says what is wrong, what was got and what is allowed. Those of numbers whose docstring
says so check arrays, too, and return nothing. The checks of `checks` convert with NumPy.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache, partial
from numbers import Integral, Real
from typing import Annotated, Any, TypeAlias, TypeVar

T = TypeVar('T')
Check: TypeAlias = Callable[[str, Any], Any]
FEW = 64
"""Size up to which an array is checked as floats, because that is faster."""


class Checked:
    """Base class of frozen dataclasses whose annotations declare checks.

    Annotations are evaluated when the first value is made. One with a name that exists for type checkers
    only declares no check. In a dataclass with slots a `__post_init__` calls
    `Checked.__post_init__(self)`, because `super()` does not work there.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check and convert the fields, those of base classes first."""
        kind: Any = type(self)
        for name, check in _checks(kind):
            object.__setattr__(self, name, check(name, getattr(self, name)))


@cache
def _checks(kind: type) -> list[tuple[str, Check]]:
    """Return the fields of a class that have a check, and the checks."""
    declared: dict[str, Any] = {}
    for base in reversed(kind.__mro__):
        for name, annotation in inspect.get_annotations(base).items():
            declared[name] = annotation
            if isinstance(annotation, str):
                with suppress(NameError):
                    declared[name] = eval(annotation, vars(sys.modules[base.__module__]))
    return [(name, check) for name, of in declared.items() for check in getattr(of, '__metadata__', ())]


def optional(check: Check) -> Check:
    """Return a check that also allows None."""
    return lambda name, value: None if value is None else check(name, value)


# --- Types


def of_type(wanted: type[T], words: str) -> Callable[[str, Any], T]:
    """Return a check that requires an object of a class, which messages call `words`."""

    def check(name: str, value: Any) -> T:
        if not isinstance(value, wanted):
            raise ValueError(f'{name} must be {words}, got {short(value, repr)}')
        return value

    return check


boolean = of_type(bool, 'True or False')
text = of_type(str, 'a string')
mapping = of_type(dict, 'a map')
sequence = of_type(list, 'a list')


def instance(name: str, value: Any, wanted: type) -> Any:
    """Require an object of a class."""
    return of_type(wanted, f'of class {wanted.__name__}')(name, value)


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


# --- Numbers


def integer(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """Require an integer from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not low <= int(value) <= high:
        allowed = f'of at least {low}' if high == math.inf else f'from {low} to {high}'
        raise ValueError(f'{name} must be an integer {allowed}, got {short(value, repr)}')
    return int(value)


def between(
    low: float, high: float = math.inf, *, above: float | None = None, unit: str = ''
) -> Callable[[str, Any], float]:
    """Return a check that requires a single finite number in a range, which returns it as a float.

    Args:
        low: Smallest number allowed.
        high: Largest number allowed; infinity: all finite ones.
        above: Lower bound that is itself not allowed, besides `low`.
        unit: Unit, for messages.
    """

    def check(name: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, Real):
            raise ValueError(f'{name} must be a number, got {short(value, repr)}')
        try:
            number = float(value)
        except OverflowError:
            # An integer that is larger than every float.
            number = math.inf
        if not inside(number, low, high, above):
            allowed = f'{interval(low, high, above)} {unit}'.strip()
            raise ValueError(f'{name} must be {allowed}, got {short(value)}')
        return number

    return check


def inside(value: Any, low: float, high: float, above: float | None = None) -> bool:
    """Return whether a number is in the range of `between`."""
    return low <= value <= high and value < math.inf and (above is None or value > above)


def interval(low: float, high: float, above: float | None = None) -> str:
    """Return the range of `between` in words."""
    if high == math.inf:
        return f'finite and at least {low:g}' if above is None else f'finite and above {above:g}'
    start = f'[{_bound(low)}' if above is None else f'({_bound(above)}'
    return f'in {start}, {_bound(high)}]'


def _bound(value: float) -> str:
    return str(value) if isinstance(value, int) else f'{value:g}'


def positive(name: str, value: Any) -> None:
    """Require a number or an array to be positive and finite."""
    # A float needs the first test only. This runs for every message.
    inside = (value > 0.0) & (value < math.inf)
    if inside is not True and not _all(inside):
        raise ValueError(f'{name} must be positive and finite, got {_first(value, inside)}')


def positive_or_infinite(name: str, value: Any) -> None:
    """Require a number or an array to be positive. Infinity means no limit."""
    inside = value > 0.0
    if inside is not True and not _all(inside):
        raise ValueError(f'{name} must be positive, got {value}')


def not_negative(name: str, value: Any) -> None:
    """Require a number or an array to be zero or positive, and finite."""
    inside = (value >= 0.0) & (value < math.inf)
    if inside is not True and not _all(inside):
        raise ValueError(f'{name} must be zero or positive and finite, got {_first(value, inside)}')


def not_negative_or_infinite(name: str, value: Any) -> None:
    """Require a number or an array to be zero or positive. Infinity means no limit."""
    inside = value >= 0.0
    if inside is not True and not _all(inside):
        raise ValueError(f'{name} must be zero or positive, got {value}')


def not_positive_or_infinite(name: str, value: Any) -> None:
    """Require a number or an array to be zero or negative. Infinity means no limit."""
    inside = value <= 0.0
    if inside is not True and not _all(inside):
        raise ValueError(f'{name} must be zero or negative, got {value}')


def offset(name: str, value: Any) -> None:
    """Require a control point off the axle: a number or an array."""
    inside = (value != 0.0) & (abs(value) < math.inf)
    if inside is not True and not _all(inside):
        raise ValueError(
            f'{name} must be finite and not 0, because the Jacobian of the axle centre has rank 1; '
            f'got {_first(value, inside)}'
        )


def finite(name: str, value: Any) -> None:
    """Require a finite number, or an array of them."""
    if type(value) is float:
        if not math.isfinite(value):
            raise ValueError(f'{name} must be finite, got {value}')
        return
    # A finite sum has finite terms. Of a few numbers it is several times as fast as a test of each.
    if value.size <= FEW and math.isfinite(sum(value.ravel().tolist())):
        return
    # Loaded already, as there are arrays.
    import numpy as np

    inside = np.isfinite(value)
    if not inside.all():
        raise ValueError(f'{name} must be finite, got {_first(value, inside)}')


def _all(inside: Any) -> bool:
    """Return whether a comparison holds for each entry of an array, or for a number."""
    return bool(inside.all() if hasattr(inside, 'all') else inside)


def _first(value: Any, inside: Any) -> str:
    """Return the first invalid entry and its index, for an error message."""
    if getattr(inside, 'ndim', 0) == 0:
        return f'{value}'
    index = tuple(int(axis[0]) for axis in (~inside).nonzero())
    return f'{value[index]} at index {index if len(index) > 1 else index[0]}'


# --- Messages


def short(value: Any, express: Callable[[Any], str] = str) -> str:
    """Return a value as text of at most 60 characters."""
    try:
        got = express(value)
    except ValueError:  # of an integer with thousands of digits
        got = f'an object of class {type(value).__name__}'
    return got if len(got) <= 60 else f'{got[:57]}...'


Text = Annotated[str, text]
Name = Annotated[str, nonempty]
Names = Annotated[tuple[str, ...], names]
Count = Annotated[int, partial(integer, low=1)]
