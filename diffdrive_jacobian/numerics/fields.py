"""Dataclasses whose fields declare their checks, and the checks that need no NumPy.

    @dataclass(frozen=True)
    class Delay(Checked):
        topic: Name
        seconds: Positive
        copies: Annotated[int, partial(integer, low=1)] = 1

A check is a function `check(name, value)`. It returns the value, converted if need be, or raises a
ValueError that says what is wrong, what was got and what is allowed. Those of numbers are in `checks`.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache, partial
from numbers import Integral
from typing import Annotated, Any, TypeAlias

Check: TypeAlias = Callable[[str, Any], Any]


class Checked:
    """Base class of frozen dataclasses whose annotations declare checks.

    Annotations are evaluated when the first value is made. One with a name that exists for type
    checkers only declares no check. In a dataclass with slots a `__post_init__` calls
    `Checked.__post_init__(self)`, because `super()` does not work there.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check and convert the fields, those of base classes first.

        Raises:
            ValueError: A field is invalid.
        """
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


def text(name: str, value: Any) -> str:
    """Require a string."""
    if not isinstance(value, str):
        raise ValueError(f'{name} must be a string, got {short(value, repr)}')
    return value


def nonempty(name: str, value: Any) -> str:
    """Require a string that is not empty."""
    if not isinstance(value, str) or not value:
        raise ValueError(f'{name} must be a string that is not empty, got {short(value, repr)}')
    return value


def names(name: str, value: Any) -> tuple[str, ...]:
    """Require strings that are not empty, but not a single string. Returns a tuple."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ValueError(f'{name} must be a tuple of names, got {short(value, repr)}')
    found = tuple(value)
    if not all(isinstance(one, str) and one for one in found):
        raise ValueError(f'{name} must be a tuple of names, got {short(value, repr)}')
    return found


def one_of(*allowed: Any) -> Check:
    """Return a check that requires one of some values."""

    def check(name: str, value: Any) -> Any:
        if value not in allowed:
            choices = ', '.join(map(repr, allowed))
            raise ValueError(f'{name} must be one of {choices}, got {short(value, repr)}')
        return value

    return check


def integer(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """Require an integer from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not low <= int(value) <= high:
        allowed = f'of at least {low}' if high == math.inf else f'from {low} to {high}'
        raise ValueError(f'{name} must be an integer {allowed}, got {short(value, repr)}')
    return int(value)


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
