"""Types of the fields of a message class, as CDR encodes them.

They are derived from the description that rosidl generates into each class,
`get_fields_and_field_types()`, so that a change of a message changes its encoding too.
"""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

_CODES = {
    'boolean': '?',
    'octet': 'c',
    'int8': 'b',
    'uint8': 'B',
    'int16': 'h',
    'uint16': 'H',
    'int32': 'i',
    'uint32': 'I',
    'int64': 'q',
    'uint64': 'Q',
    'float': 'f',
    'double': 'd',
}
_SIZES = {'?': 1, 'c': 1, 'b': 1, 'B': 1, 'h': 2, 'H': 2, 'i': 4, 'I': 4, 'q': 8, 'Q': 8, 'f': 4, 'd': 8}
_ARRAY = re.compile(r'(.+)\[(\d+)\]')
_SEQUENCE = re.compile(r'sequence<([^,]+)>')
_STRUCTURE = re.compile(r'(\w+)/(\w+)')


@dataclass(frozen=True, slots=True)
class Number:
    """A number, a boolean or a byte. It is aligned to its size."""

    code: str
    """Format character of the module `struct`."""
    size: int
    """Bytes."""


@dataclass(frozen=True, slots=True)
class Text:
    """A string: its length with the final NUL as uint32, UTF-8, NUL."""


@dataclass(frozen=True, slots=True)
class Array:
    """Elements of a fixed number."""

    element: FieldType
    count: int


@dataclass(frozen=True, slots=True)
class Sequence:
    """Elements after their number, a uint32."""

    element: FieldType


@dataclass(frozen=True, slots=True)
class Structure:
    """The fields of a message, in the order of its definition."""

    name: str
    fields: tuple[tuple[str, FieldType], ...]


FieldType: TypeAlias = Number | Text | Array | Sequence | Structure
COUNT = Number('I', 4)
"""The length of a string or of a sequence."""
LITTLE_ENDIAN = b'\x00\x01'
"""First bytes of plain CDR, version 1, little-endian."""
ENCAPSULATION = 4
"""Bytes before the first field."""


@cache
def structure(message_class: Any) -> Structure:
    """Return the types of the fields of a message class.

    Raises:
        TypeError: There are no fields, or one has a type that is not supported: a wide or bounded
            string, a bounded sequence or a `long double`.
    """
    fields = message_class.get_fields_and_field_types()
    name = message_class.__name__
    if not fields:
        raise TypeError(f'{name} has no fields')
    return Structure(name, tuple((one, _field_type(f'{name}.{one}', fields[one])) for one in fields))


@cache
def least_size(kind: FieldType) -> int:
    """Return a lower bound of the encoded size of a value (bytes)."""
    match kind:
        case Number():
            return kind.size
        case Text() | Sequence():
            return COUNT.size
        case Array():
            return kind.count * least_size(kind.element)
        case Structure():
            return max(1, sum(least_size(one) for _, one in kind.fields))


def _field_type(name: str, text: str) -> FieldType:
    if text in _CODES:
        code = _CODES[text]
        return Number(code, _SIZES[code])
    if text == 'string':
        return Text()
    if found := _ARRAY.fullmatch(text):
        return Array(_field_type(name, found[1]), int(found[2]))
    if found := _SEQUENCE.fullmatch(text):
        return Sequence(_field_type(name, found[1]))
    if found := _STRUCTURE.fullmatch(text):
        # Fields of messages are messages; those of services and actions too.
        return structure(getattr(importlib.import_module(f'{found[1]}.msg'), found[2]))
    raise TypeError(
        f'field {name} must not have type {text}: only plain strings and sequences are supported'
    )
