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

"""Types of the fields of messages, and the fields of message objects by their paths.

A message class and a definition in a bag give the same `Structure`. None of this needs rclpy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any, TypeAlias

from diffdrive_jacobian.messages.names import import_type

CODES = {
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
"""Format characters of the module `struct`, by the names that rosidl gives the types of numbers."""
_SIZES = {'?': 1, 'c': 1, 'b': 1, 'B': 1, 'h': 2, 'H': 2, 'i': 4, 'I': 4, 'q': 8, 'Q': 8, 'f': 4, 'd': 8}
_NESTED = re.compile(
    r'(?P<array>.+)\[(?P<count>\d+)\]|sequence<(?P<sequence>[^,]+)(?:, (?P<most>\d+))?>'
)
_TEXT = re.compile(r'(?P<wide>w?)string(?:<=?(?P<most>\d+)>?)?')
_CLASS = re.compile(r'(\w+)/(\w+)')


@dataclass(frozen=True, slots=True)
class Number:
    """A number, a boolean or a byte. It is aligned to its size."""

    code: str
    """Format character of the module `struct`."""

    @property
    def size(self) -> int:
        """Bytes."""
        return _SIZES[self.code]

    @property
    def limits(self) -> tuple[int, int] | None:
        """Least and largest value of an integer type; None: it is none."""
        if self.code not in 'bBhHiIqQ':
            return None
        bits = 8 * self.size
        return (0, 2**bits - 1) if self.code.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)

    @property
    def is_float(self) -> bool:
        """Whether it is a float32 or a float64."""
        return self.code in 'fd'

    def __str__(self) -> str:
        """Return the name of the type, as rosidl has it."""
        return next(name for name, code in CODES.items() if code == self.code)


@dataclass(frozen=True, slots=True)
class Text:
    """A string: its length with the final NUL as uint32, UTF-8, NUL."""

    wide: bool = False
    """Whether it is a wide string, which CDR encodes otherwise."""
    most: int | None = None
    """Largest number of characters; None: any."""

    def __str__(self) -> str:
        """Return the name of the type, as rosidl has it."""
        return f'{"w" * self.wide}string{"" if self.most is None else f"<{self.most}>"}'


@dataclass(frozen=True, slots=True)
class Array:
    """Elements of a fixed number."""

    element: FieldType
    count: int

    def __str__(self) -> str:
        """Return the name of the type, as rosidl has it."""
        return f'{self.element}[{self.count}]'


@dataclass(frozen=True, slots=True)
class Sequence:
    """Elements after their number, a uint32."""

    element: FieldType
    most: int | None = None
    """Largest number of elements; None: any."""

    def __str__(self) -> str:
        """Return the name of the type, as rosidl has it."""
        return f'sequence<{self.element}{"" if self.most is None else f", {self.most}"}>'


@dataclass(frozen=True, slots=True)
class Structure:
    """The fields of a message, in the order of its definition. One without fields takes one byte."""

    name: str
    """`package/Name`."""
    fields: tuple[tuple[str, FieldType], ...]

    @property
    def short_name(self) -> str:
        """The name without its package."""
        return self.name.rpartition('/')[2]

    def __str__(self) -> str:
        """Return the name of the type, as rosidl has it."""
        return self.name

    def __hash__(self) -> int:
        """Return the hash of the name: that of all fields would take longer than what it caches."""
        return hash(self.name)


FieldType: TypeAlias = Number | Text | Array | Sequence | Structure
COUNT = Number('I')
"""The length of a string or of a sequence."""
LITTLE_ENDIAN = b'\x00\x01'
"""First bytes of little-endian CDR, version 1."""
ENCAPSULATION = 4
"""Bytes before the first field."""


def structure(message_class: Any) -> Structure:
    """Return the types of the fields of a message class, as rosidl has generated them into it.

    Raises:
        TypeError: A field is a `long double`, which ROS 2 messages cannot have.
    """
    return _structure(message_class)


@cache
def _structure(message_class: Any) -> Structure:
    fields = message_class.get_fields_and_field_types()
    name = f'{message_class.__module__.partition(".")[0]}/{message_class.__name__}'
    return Structure(name, tuple((one, _of_class(f'{name}.{one}', fields[one])) for one in fields))


def _of_class(name: str, text: str) -> FieldType:
    """Return a type that rosidl describes, such as `sequence<double, 3>`."""
    if text in CODES:
        return Number(CODES[text])
    if found := _TEXT.fullmatch(text):
        return Text(bool(found['wide']), _number(found['most']))
    if (found := _NESTED.fullmatch(text)) and found['array']:
        return Array(_of_class(name, found['array']), int(found['count']))
    if found:
        return Sequence(_of_class(name, found['sequence']), _number(found['most']))
    if found := _CLASS.fullmatch(text):
        # Fields are messages, or parts of an action, such as Fibonacci_Feedback.
        action, _, part = found[2].partition('_')
        if part:
            return structure(getattr(import_type(f'{found[1]}/action/{action}'), part))
        return structure(import_type(f'{found[1]}/msg/{found[2]}'))
    raise TypeError(f'field {name} must have a type of ROS 2, got {text}')


def _number(text: str | None) -> int | None:
    return int(text) if text else None


def blank(kind: FieldType) -> Any:
    """Return a message of a type with zeros, and with empty strings and sequences."""
    match kind:
        case Structure():
            return SimpleNamespace(**{name: blank(field) for name, field in kind.fields})
        case Array():
            return [blank(kind.element) for _ in range(kind.count)]
        case Sequence():
            return []
        case Text():
            return ''
    return 0


def check_plain(kind: FieldType) -> None:
    """Raise TypeError if a field is a wide string, which is neither read nor written here."""
    match kind:
        case Structure():
            for name, field in kind.fields:
                try:
                    check_plain(field)
                except TypeError as error:
                    raise TypeError(f'{kind.name}.{name} must not be a wide string') from error
        case Array() | Sequence():
            check_plain(kind.element)
        case Text(wide=True):
            raise TypeError('a wide string')


@cache
def uniform_size(kind: FieldType) -> int:
    """Return the size of the numbers of a value that has nothing but those of one size; else 0."""
    match kind:
        case Number():
            return kind.size
        case Array():
            return uniform_size(kind.element) if kind.count else 0
        case Structure() if kind.fields:
            sizes = {uniform_size(one) for _, one in kind.fields}
            return sizes.pop() if len(sizes) == 1 else 0
    return 0


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


def walk(
    kind: FieldType, value: Any, path: str = '', *, whole: Callable[[FieldType], bool] = lambda _: False
) -> Iterator[tuple[str, FieldType, Any]]:
    """Yield path, type and value of each field of a message.

    An array or a sequence of numbers or strings is one value, as are types that are `whole`. One of
    messages is its length, `len(path)`, and then the fields of its elements, `path[0].x`.
    """
    match kind:
        case _ if whole(kind):
            yield path, kind, value
        case Structure() if value is not None:
            for name, field in kind.fields:
                inner = f'{path}.{name}' if path else name
                yield from walk(field, getattr(value, name), inner, whole=whole)
        case Array(Structure() as element) | Sequence(Structure() as element):
            yield f'len({path})', COUNT, len(value)
            for index, one in enumerate(value):
                yield from walk(element, one, f'{path}[{index}]', whole=whole)
        case _:
            yield path, kind, value


def parts(message: Any) -> Iterator[tuple[Structure, Any]]:
    """Yield a message and all messages in it, each with its type, the outer ones first."""
    kind = structure(type(message))
    yield kind, message
    for name, field in kind.fields:
        value = getattr(message, name)
        match field:
            case Structure():
                yield from parts(value)
            case Array(Structure()) | Sequence(Structure()):
                for one in value:
                    yield from parts(one)


def plain(value: Any) -> Any:
    """Return an array or a sequence of numbers or strings as a tuple of Python's; others as they are."""
    if isinstance(value, (str, bytes, int, float)):
        return value
    return tuple(value.tolist() if hasattr(value, 'tolist') else value)


def is_stamp(kind: FieldType) -> bool:
    """Whether a type is a time or a duration, with `sec` and `nanosec`."""
    return isinstance(kind, Structure) and kind.name in (
        'builtin_interfaces/Time',
        'builtin_interfaces/Duration',
    )


def is_identifier(kind: FieldType) -> bool:
    """Whether a type is a UUID, with the bytes `uuid`."""
    return isinstance(kind, Structure) and kind.name == 'unique_identifier_msgs/UUID'


def field_value(message: Any, field: str) -> Any:
    """Return a field of a message object, as `cdr.Reader` returns it."""
    before, sequence, after = field.partition('[].')
    if sequence:
        return tuple(plain(_value(one, after)) for one in _value(message, before))
    return plain(_value(message, field))


def _value(message: Any, path: str) -> Any:
    for name in path.split('.'):
        message = getattr(message, name)
    return message


def check_readable(kind: Structure, field: str) -> None:
    """Raise ValueError unless `cdr.Reader` can return this field."""
    found: FieldType = kind
    of_each = True
    for step in field.split('.'):
        name = step.removesuffix('[]')
        inner = dict(found.fields) if isinstance(found, Structure) else {}
        if name not in inner:
            raise ValueError(
                f"a field of {kind.short_name} must be a path to one of its fields, got '{field}'; "
                f'{name!r} is none of {list(inner)}'
            )
        found = inner[name]
        if step != name:
            of_each = isinstance(found, Sequence) and isinstance(found.element, Structure)
            found = getattr(found, 'element', found)
    simple = found.element if isinstance(found, (Array, Sequence)) else found
    if not (of_each and isinstance(simple, (Number, Text)) and field.count('[]') <= 1):
        raise ValueError(
            f'a field of {kind.short_name} must be a number, a string, an array or sequence of them, '
            f"or such a field of each element of one sequence ('goals[].pose.position.x'), got '{field}'"
        )
