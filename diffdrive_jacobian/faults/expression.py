"""Values that are printed as the Python expression that makes them: faults and properties."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from typing import Any

from diffdrive_jacobian.numerics.fields import Checked

LONG, SHOWN = 8, 2
"""Length beyond which a message shows the beginning of a sequence only, and how many elements of it."""


@dataclass(frozen=True, repr=False)
class Expression(Checked):
    """Base class of checked dataclasses that are printed as the expression that makes them.

    Subclasses are decorated with `@dataclass(frozen=True, repr=False)`.
    """

    def __post_init__(self) -> None:
        """Check the fields. Errors begin with the name of the class."""
        try:
            super().__post_init__()
        except ValueError as error:
            raise ValueError(f'{type(self).__name__}: {error}') from None

    def __repr__(self) -> str:
        """Return the expression that makes this value."""
        return self._expression(literal)

    def __str__(self) -> str:
        """Return the expression with long sequences cut, for messages."""
        return self._expression(brief)

    def _expression(self, literal: Callable[[Any], str]) -> str:
        shown = []
        for one in sorted(fields(self), key=lambda one: bool(one.kw_only)):
            value = getattr(self, one.name)
            if one.default is MISSING and not one.kw_only:
                shown.append(literal(value))
            elif value != one.default:
                shown.append(f'{one.name}={literal(value)}')
        return f'{type(self).__name__}({", ".join(shown)})'


def literal(value: Any) -> str:
    """Return a Python expression for a value; `repr` of an infinite float is none."""
    if isinstance(value, float) and not math.isfinite(value):
        return f"float('{value}')"
    if isinstance(value, (list, tuple)):
        inner = ', '.join(map(literal, value))
        return f'[{inner}]' if isinstance(value, list) else f'({inner}{"," * (len(value) == 1)})'
    return repr(value)


def brief(value: Any) -> str:
    """Return `literal` of a value, of a long sequence only the beginning."""
    if isinstance(value, (list, tuple)) and len(value) > LONG:
        first = literal(value[:SHOWN])
        return f'{first[:-1]}, ... {len(value)} in all{first[-1]}'
    return literal(value)
