"""Dataclasses whose fields declare their checks, and the checks that need no NumPy.

    @dataclass(frozen=True)
    class Delay(Checked):
        topic: Name
        seconds: Positive
        copies: Annotated[int, integer(1)] = 1

A check is a function `check(name, value)`. It returns the value, converted if need be, or raises a
ValueError that says what is wrong, what was got and what is allowed. Those of numbers are in `checks`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import cache
from numbers import Integral
from typing import Annotated, Any, TypeAlias, get_type_hints

Check: TypeAlias = Callable[[str, Any], Any]


class Checked:
    """Base class of frozen dataclasses whose annotations declare checks.

    Annotations are evaluated when the first value is made, so the modules of subclasses must import
    their names also at run time. In a dataclass with slots a `__post_init__` calls
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
    hints = get_type_hints(kind, include_extras=True)
    return [(name, check) for name, hint in hints.items() for check in getattr(hint, '__metadata__', ())]


def optional(check: Check) -> Check:
    """Return a check that also allows None."""
    return lambda name, value: None if value is None else check(name, value)


def text(name: str, value: Any) -> str:
    """Require a string."""
    if not isinstance(value, str):
        raise ValueError(f'{name} must be a string, got {value!r}')
    return value


def nonempty(name: str, value: Any) -> str:
    """Require a string that is not empty."""
    if not isinstance(value, str) or not value:
        raise ValueError(f'{name} must be a string that is not empty, got {value!r}')
    return value


def names(name: str, value: Any) -> tuple[str, ...]:
    """Require strings that are not empty, but not a single string. Returns a tuple."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ValueError(f'{name} must be a tuple of names, got {value!r}')
    found = tuple(value)
    if not all(isinstance(one, str) and one for one in found):
        raise ValueError(f'{name} must be a tuple of names, got {value!r}')
    return found


def one_of(*allowed: Any) -> Check:
    """Return a check that requires one of some values."""

    def check(name: str, value: Any) -> Any:
        if value not in allowed:
            raise ValueError(f'{name} must be one of {", ".join(map(repr, allowed))}, got {value!r}')
        return value

    return check


def integer(low: int, high: float = math.inf) -> Check:
    """Return a check that requires an integer from `low` to `high`."""
    allowed = f'from {low} to {high}' if high < math.inf else f'of at least {low}'

    def check(name: str, value: Any) -> int:
        if type(value) is bool or not isinstance(value, Integral) or not low <= int(value) <= high:
            raise ValueError(f'{name} must be an integer {allowed}, got {value!r}')
        return int(value)

    return check


Text = Annotated[str, text]
Name = Annotated[str, nonempty]
Names = Annotated[tuple[str, ...], names]
Count = Annotated[int, integer(1)]
