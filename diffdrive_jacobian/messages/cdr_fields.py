"""Paths of the fields that a Reader returns, such as `header.stamp.sec` and `len(goals)`."""

from __future__ import annotations

import re
from operator import attrgetter
from typing import Any

from diffdrive_jacobian.messages.cdr_types import Array, FieldType, Number, Sequence, Structure, Text

LENGTH = re.compile(r'len\(([\w.]+)\)')


def field_value(message: Any, field: str) -> Any:
    """Return a field of a message object, as the Reader returns it."""
    length = LENGTH.fullmatch(field)
    value = attrgetter(length[1] if length else field)(message)
    if length:
        return len(value)
    if isinstance(value, (str, bytes, int, float)):
        return value
    return tuple(value.tolist() if hasattr(value, 'tolist') else value)


def check_readable(kind: Structure, field: str) -> None:
    """Raise ValueError unless a Reader can return this field."""
    length = LENGTH.fullmatch(field)
    found: FieldType = kind
    for name in (length[1] if length else field).split('.'):
        inner = dict(found.fields) if isinstance(found, Structure) else {}
        if name not in inner:
            raise ValueError(
                f"a field of {kind.name} must be a path to one of its fields, got '{field}'; "
                f'{name!r} is none of {list(inner)}'
            )
        found = inner[name]
    if length:
        readable = isinstance(found, Sequence)
    else:
        simple = found.element if isinstance(found, (Array, Sequence)) else found
        readable = isinstance(simple, (Number, Text))
    if not readable:
        raise ValueError(
            f'a field of {kind.name} must be a number, a string, an array or sequence of them, or '
            f"len() of a sequence, got '{field}'"
        )
