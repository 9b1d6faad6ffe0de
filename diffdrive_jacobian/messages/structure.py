"""Types of the fields of messages, from a message class or from a definition in a bag.

Both give the same `Structure`, so what reads, writes, compares or changes fields needs no other
description of a message. None of it needs rclpy.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.names import import_type

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
"""Format characters of the module `struct`, by the names that rosidl gives the types of numbers."""
_SIZES = {'?': 1, 'c': 1, 'b': 1, 'B': 1, 'h': 2, 'H': 2, 'i': 4, 'I': 4, 'q': 8, 'Q': 8, 'f': 4, 'd': 8}
_IN_DEFINITIONS = {
    **{name: name for name in _CODES if 'int' in name},
    **{'bool': 'boolean', 'byte': 'octet', 'char': 'uint8', 'float32': 'float', 'float64': 'double'},
}
"""Names of these types in .msg files, and those of rosidl."""
_NESTED = re.compile(
    r'(?P<array>.+)\[(?P<count>\d+)\]|sequence<(?P<sequence>[^,]+)(?:, (?P<most>\d+))?>'
)
_TEXT = re.compile(r'(?P<wide>w?)string(?:<=?(?P<most>\d+)>?)?')
_CLASS = re.compile(r'(\w+)/(\w+)')
_LINE = re.compile(
    r'\s*(?P<type>[A-Za-z][\w/]*(?:<=\d{1,9})?)(?P<nested>\[(?:<=)?\d{,9}\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)',
    re.ASCII,
)
_SEPARATOR = re.compile(r'^=+\nMSG: (\S+)\n', re.MULTILINE)


class DefinitionError(MessageError):
    """A definition of a message type that is invalid or incomplete."""


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
        return next(name for name, code in _CODES.items() if code == self.code)


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
LITTLE_ENDIAN, BIG_ENDIAN = b'\x00\x01', b'\x00\x00'
PLAIN = (LITTLE_ENDIAN, BIG_ENDIAN)
"""First bytes of plain CDR, version 1."""
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
    if text in _CODES:
        return Number(_CODES[text])
    if found := _TEXT.fullmatch(text):
        return Text(bool(found['wide']), _number(found['most']))
    if (found := _NESTED.fullmatch(text)) and found['array']:
        return Array(_of_class(name, found['array']), int(found['count']))
    if found:
        return Sequence(_of_class(name, found['sequence']), _number(found['most']))
    if found := _CLASS.fullmatch(text):
        # Fields of messages are messages; those of services and actions too.
        return structure(import_type(f'{found[1]}/msg/{found[2]}'))
    raise TypeError(f'field {name} must have a type of ROS 2, got {text}')


def defined(name: str, text: str) -> Structure:
    """Return the types of the fields of a message from its definition, as bags store it.

    Args:
        name: `package/msg/Name`.
        text: Its .msg file, followed by those of the messages in its fields, each after a line of `=`
            and one of `MSG: ` and its name.

    Raises:
        DefinitionError: The definition is invalid, lacks that of a field, or contains itself.
    """
    first, *rest = _SEPARATOR.split(text.replace('\r\n', '\n'))
    texts = {_class_name(one): content for one, content in zip(rest[::2], rest[1::2], strict=True)}
    try:
        return _Definitions({**texts, _class_name(name): first}).structure(_class_name(name))
    except RecursionError as error:
        raise DefinitionError(f'the definitions in {name} are nested too deep') from error


class _Definitions:
    """The .msg files of a type and of its fields, by `package/Name`."""

    def __init__(self, texts: dict[str, str]) -> None:
        self._texts = texts
        self._known: dict[str, Structure | None] = {}
        """None while it is read."""

    def structure(self, name: str) -> Structure:
        if name not in self._known:
            if name not in self._texts:
                raise DefinitionError(f'the definition of {name} is missing')
            self._known[name] = None
            self._known[name] = Structure(name, tuple(self._fields(name)))
        known = self._known[name]
        if known is None:
            raise DefinitionError(f'{name} contains itself')
        return known

    def _fields(self, name: str) -> Iterator[tuple[str, FieldType]]:
        package = name.partition('/')[0]
        for line in self._texts[name].split('\n'):
            content = line.partition('#')[0]
            if not content.strip():
                continue
            found = _LINE.fullmatch(content)
            if found is None:
                raise DefinitionError(f'{name} has the line {line[:80]!r}, which is no field')
            # What has a value after an equals sign is a constant; other values are defaults.
            if found['rest'].startswith('='):
                continue
            yield found['name'], self._field(package, found['type'], found['nested'])

    def _field(self, package: str, kind: str, nested: str | None) -> FieldType:
        if kind in _IN_DEFINITIONS:
            element: FieldType = Number(_CODES[_IN_DEFINITIONS[kind]])
        elif found := _TEXT.fullmatch(kind):
            element = Text(bool(found['wide']), _number(found['most']))
        else:
            element = self.structure(_class_name(kind if '/' in kind else f'{package}/{kind}'))
        if nested is None:
            return element
        count = nested.strip('[]')
        if count == '0':
            raise DefinitionError('an array must have at least 1 element, got 0')
        if count.isdecimal():
            return Array(element, int(count))
        return Sequence(element, _number(count.removeprefix('<=')))


def _class_name(name: str) -> str:
    """Return `package/Name` of `package/msg/Name`."""
    return name.replace('/msg/', '/')


def _number(text: str | None) -> int | None:
    return int(text) if text else None


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
    """Return the size of each number of a value that has nothing but numbers of one size; 0: it has."""
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
