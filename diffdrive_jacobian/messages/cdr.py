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

"""Reading and writing single fields of serialized messages, without message objects.

rclpy converts each message between CDR bytes and nested Python objects, which costs several times what
sending the bytes costs. A `Writer` packs numbers into the bytes of a template. A `Reader` unpacks the
fields that are asked for. Both follow from the `Structure` of the message. None of them needs rclpy.

Little-endian CDR, version 1: 4 bytes of encapsulation (0, 1, and 2 that are ignored), then the fields in
order, each number aligned to its size. Alignment counts from the end of the encapsulation. Other
encodings, such as those of big-endian machines, are left to rclpy.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from collections.abc import Sequence as Values
from functools import lru_cache
from itertools import pairwise
from operator import itemgetter
from typing import Any, NamedTuple

from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.structure import (
    COUNT,
    ENCAPSULATION,
    LITTLE_ENDIAN,
    Array,
    FieldType,
    Number,
    Sequence,
    Structure,
    Text,
    check_plain,
    check_readable,
    field_value,
    least_size,
    structure,
    uniform_size,
)

_MAX_LAYOUTS = 16
"""Layouts that a Reader keeps, one for each size of message."""
_MAX_VALUES = 256
"""Largest number of values of a layout that is kept."""
_MAX_REMEMBERED = 1024
"""Largest message whose texts are remembered (bytes)."""


class DecodingError(MessageError):
    """Bytes that are not a message of the type, or too many."""


class Reader:
    """Reads fields of serialized messages.

    Where the fields are depends on the lengths of the strings and sequences before them. These are
    usually the same in each message. So the layout of the last message of the same size is tried first:
    one unpacking gives the lengths and the fields, and the fields are right if the lengths are.
    """

    def __init__(
        self,
        kind: Any,
        fields: Values[str],
        value: Callable[..., Any] = lambda *fields: fields,
        *,
        whole: bool = True,
        deserialize: Callable[[bytes, Any], Any] | None = None,
    ) -> None:
        """Compile a reader.

        Args:
            kind: Type of the messages: their class or its `Structure`.
            fields: Paths such as `header.stamp.sec`. A path to a number gives a number, to a string a
                str, to an array or sequence of them a tuple. `goals[].pose.position.x` gives a tuple
                with that field of each element of a sequence.
            value: Makes a value of the fields, one argument each. What it raises is passed on. By
                default their tuple.
            whole: Whether what follows the last field must be valid too.
            deserialize: `rclpy.serialization.deserialize_message`, for other encapsulations than that
                of little-endian CDR, which are refused otherwise. It needs the class.

        Raises:
            ValueError: A field does not exist, or cannot be read on its own.
            TypeError: The message has a wide string.
        """
        self._class = kind
        self._type = kind if isinstance(kind, Structure) else structure(kind)
        check_plain(self._type)
        self._fields = tuple(fields)
        for field in self._fields:
            check_readable(self._type, field)
        self._value = value
        self._whole = whole
        self._deserialize = deserialize
        self._layouts: dict[int, _Layout] = {}

    def __call__(self, data: bytes) -> Any:
        """Return the value of a message.

        As in rclpy, bytes after the message are ignored, strings end at the first NUL, and invalid UTF-8
        is replaced by U+FFFD. Unlike rclpy, a sequence that claims more elements than there are bytes is
        refused everywhere. In a nested structure, such as `polygon.points`, rclpy reads it as empty and
        the fields after it from the wrong place.

        Raises:
            DecodingError: The bytes are not a message of this type.
        """
        layout = self._layouts.get(len(data))
        if layout is not None:
            values = layout.unpack_from(data)
            if layout.lengths(values) == layout.expected:
                return self._value(*layout.fields(values))
        return self._value(*self._read_new(data))

    def _read_new(self, data: bytes) -> tuple[Any, ...]:
        """Read a message whose layout is not known."""
        if len(data) >= ENCAPSULATION and data[:2] != LITTLE_ENDIAN:
            return self._read_message(data)
        try:
            layout = _Walk(data, self._fields, self._whole).layout(self._type)
        except struct.error as error:
            raise self._undecodable() from error
        values = layout.unpack_from(data)
        if len(values) <= _MAX_VALUES:
            if len(self._layouts) >= _MAX_LAYOUTS:
                self._layouts.clear()
            self._layouts[len(data)] = layout
        return layout.fields(values)

    def _read_message(self, data: bytes) -> tuple[Any, ...]:
        """Return the fields of a message object."""
        if self._deserialize is None:
            raise DecodingError(
                f'a {self._type.short_name} message must be little-endian CDR, which begins with 0001, '
                f'if rclpy does not read it; it begins with {data[:2].hex()}'
            )
        try:
            message = self._deserialize(data, self._class)
        except RuntimeError as error:
            raise self._undecodable() from error
        return tuple(field_value(message, field) for field in self._fields)

    def _undecodable(self) -> DecodingError:
        return DecodingError(f'it is not a {self._type.short_name} message')


class _Layout(NamedTuple):
    """Where the fields are in messages with certain lengths of strings and sequences."""

    unpack_from: Callable[[bytes], tuple[Any, ...]]
    lengths: Callable[[tuple[Any, ...]], Any]
    """Returns the encapsulation and the lengths among the unpacked values."""
    expected: Any
    fields: Callable[[tuple[Any, ...]], tuple[Any, ...]]
    """Returns the fields among the unpacked values."""


class _Format:
    """What of a message is unpacked at once: the fields that are read, and the lengths on the way."""

    def __init__(self) -> None:
        self._codes = ['<']
        self._end = 0
        self.values = 0
        """Number of values."""

    def add(self, start: int, code: str, size: int, values: int = 1) -> int:
        """Add values from an offset on, with the bytes before them skipped. Return the first index."""
        if start > self._end:
            self._codes.append(f'{start - self._end}x')
        self._codes.append(code)
        self._end = start + size
        first, self.values = self.values, self.values + values
        return first

    def compiled(self, end: int) -> struct.Struct:
        """Return it for messages of at least some bytes."""
        self.add(end, '', 0, 0)
        return struct.Struct(''.join(self._codes))


class _Walk:
    """One pass over a message, which collects its layout. Raises struct.error where the bytes end."""

    def __init__(self, data: bytes, fields: tuple[str, ...], whole: bool) -> None:
        self._data = data
        self._fields = fields
        self._missing = set(fields)
        self._whole = whole
        self._offset = ENCAPSULATION
        self._format = _Format()
        # The encapsulation, and then the length of each string and sequence.
        self._lengths = [self._format.add(0, '2s', 2)]
        self._picks: dict[str, Any] = {field: [] for field in fields if '[]' in field}
        """Where the fields are among the unpacked values: an index, a slice, or a list of them."""
        self._texts: set[str] = set()

    def layout(self, kind: Structure) -> _Layout:
        self._walk(kind, '')
        compiled = self._format.compiled(self._offset)
        lengths = itemgetter(*self._lengths)
        expected = lengths(compiled.unpack_from(self._data))
        return _Layout(compiled.unpack_from, lengths, expected, self._picker())

    def _picker(self) -> Callable[[tuple[Any, ...]], tuple[Any, ...]]:
        """Return a function that returns the fields among the unpacked values."""
        picks = [self._picks[field] for field in self._fields]
        texts = [number for number, field in enumerate(self._fields) if field in self._texts]
        simple = not any(isinstance(one, list) for one in picks)
        # An itemgetter of one index returns no tuple.
        if simple and not texts and len(picks) > 1:
            return itemgetter(*picks)
        # A short message has few texts, and usually the same ones as before.
        convert = _converted_before if self._offset <= _MAX_REMEMBERED else _converted
        if simple and texts == [0] and len(picks) > 2:
            # A frame and numbers, as of an odometry, without a loop.
            text, numbers = picks[0], itemgetter(*picks[1:])
            return lambda values: (convert(values[text]), *numbers(values))

        def pick(values: tuple[Any, ...]) -> tuple[Any, ...]:
            picked = [
                tuple(values[index] for index in one) if isinstance(one, list) else values[one]
                for one in picks
            ]
            for number in texts:
                picked[number] = convert(picked[number])
            return tuple(picked)

        return pick

    @property
    def _done(self) -> bool:
        return not (self._missing or self._whole)

    def _walk(self, kind: FieldType, path: str) -> None:
        match kind:
            case Structure():
                if not kind.fields:
                    self._advance(1)
                for name, field in kind.fields:
                    if self._done:
                        return
                    self._walk(field, f'{path}.{name}' if path else name)
            case Number():
                self._numbers(kind, 1, path)
            case Text():
                if (index := self._text(path in self._missing)) is not None:
                    self._found(path, index, is_text=True)
            case Array():
                self._elements(kind.element, kind.count, path)
            case Sequence():
                count = self._length()
                if not self._done:
                    self._elements(kind.element, count, path)

    def _found(self, path: str, pick: int | slice, *, is_text: bool = False) -> None:
        """Note where a field is among the unpacked values, if it is asked for."""
        if path not in self._missing:
            return
        if is_text:
            self._texts.add(path)
        if '[]' in path:
            self._picks[path].append(pick)
        else:
            self._picks[path] = pick
            self._missing.discard(path)

    def _elements(self, kind: FieldType, count: int, path: str) -> None:
        # Without this check a large number would take long, or much memory.
        if count * least_size(kind) > len(self._data) - self._offset:
            raise struct.error('more elements than bytes')
        if isinstance(kind, Number):
            self._numbers(kind, count, path, many=True)
            return
        inner = f'{path}[]'
        unit = uniform_size(kind)
        if unit and not any(one.startswith(inner) for one in self._missing):
            # Such as points, which are doubles without padding.
            self._advance(count * least_size(kind), unit if count else 1)
            return
        if isinstance(kind, Text):
            first, wanted = self._format.values, path in self._missing
            for _ in range(count):
                self._text(wanted)
            # Each string comes after its length.
            self._found(path, slice(first + 1, self._format.values, 2), is_text=True)
            return
        for _ in range(count):
            self._walk(kind, inner)
        self._missing.difference_update([one for one in self._missing if one.startswith(inner)])

    def _numbers(self, kind: Number, count: int, path: str, *, many: bool = False) -> None:
        start = self._advance(count * kind.size, kind.size if count else 1)
        if path in self._missing:
            first = self._format.add(start, f'{count}{kind.code}', count * kind.size, count)
            self._found(path, slice(first, first + count) if many else first)

    def _text(self, wanted: bool) -> int | None:
        """Pass a string. Return its index among the values if it is wanted."""
        size = self._length()
        start = self._advance(size)
        return self._format.add(start, f'{size}s', size) if wanted else None

    def _length(self) -> int:
        """Return the length of a string or a sequence, which is among the values."""
        start = self._advance(COUNT.size, COUNT.size)
        (length,) = struct.unpack_from('<I', self._data, start)
        self._lengths.append(self._format.add(start, 'I', COUNT.size))
        return int(length)

    def _advance(self, size: int, alignment: int = 1) -> int:
        """Pass some bytes. Return where they begin."""
        start = self._offset + (ENCAPSULATION - self._offset) % alignment
        self._offset = start + size
        if self._offset > len(self._data):
            raise struct.error('the bytes end within the message')
        return start


def _converted(raw: Any) -> Any:
    """Return a string, or strings as deep in tuples as they are."""
    if isinstance(raw, bytes):
        return raw.partition(b'\0')[0].decode('utf-8', 'replace')
    return tuple(map(_converted, raw))


_converted_before = lru_cache(maxsize=64)(_converted)


class Writer:
    """Writes serialized messages that differ from a template in some numbers."""

    def __init__(
        self,
        template: Any,
        fields: Values[str],
        numbers: Callable[[Any], tuple[Any, ...]] = lambda values: values,
        kind: Structure | None = None,
    ) -> None:
        """Serialize the template.

        Args:
            template: A message. Its strings and the lengths of its sequences are those of all messages
                that are written.
            fields: Paths of the numbers that are written, in the order of the message:
                `pose.position.x`, `covariance[7]` for an element, `covariance` for all elements of an
                array or sequence.
            numbers: Returns these numbers of a value, one for each field or element of a field.
            kind: Its type. None: that of its class.

        Raises:
            ValueError: A field does not exist, is no number, or is not in the order of the message.
            MessageError: The template cannot be serialized.
            TypeError: The message has a wide string.
        """
        encoder = _Encoder()
        message_class: Any = type(template)
        kind = kind or structure(message_class)
        check_plain(kind)
        try:
            encoder.encode(kind, template, '')
        except (struct.error, OverflowError, UnicodeEncodeError) as error:
            raise MessageError(f'{kind.short_name} cannot be serialized: {error}') from error
        self._name = kind.short_name
        runs = _runs(encoder, fields)
        content = bytes(encoder.buffer)
        # All is packed at once: what does not change as strings of bytes, between the runs of numbers.
        total = sum(run.numbers for run in runs)
        constants: list[bytes] = []
        layout, end, order, first = '<', 0, [], 0
        for run in runs:
            order += [total + len(constants), *range(first, first + run.numbers)]
            constants.append(content[end : run.start])
            layout += f'{run.start - end}s{run.format}'
            end, first = run.end, first + run.numbers
        # With an empty one at the end: an itemgetter of one index returns no tuple.
        order += [total + len(constants), total + len(constants) + 1]
        constants += [content[end:], b'']
        layout += f'{len(content) - end}s0s'
        self._numbers, self._count = numbers, total
        self._constants, self._in_order = tuple(constants), itemgetter(*order)
        self._pack = struct.Struct(layout).pack

    def __call__(self, value: Any) -> bytes:
        """Return the message with the numbers of a value.

        Raises:
            MessageError: A number is out of range for its field, or their count is wrong.
        """
        numbers = self._numbers(value)
        if len(numbers) != self._count:
            raise MessageError(
                f'{self._name} cannot be serialized: it needs {self._count} numbers, got {len(numbers)}'
            )
        try:
            return self._pack(*self._in_order(numbers + self._constants))
        except (struct.error, OverflowError) as error:
            raise MessageError(f'{self._name} cannot be serialized: {error}') from error


class _Encoder:
    """Serializes a message, and notes where its numbers are. Padding is zero."""

    def __init__(self) -> None:
        self.buffer = bytearray(LITTLE_ENDIAN + b'\0\0')
        self.numbers: dict[str, tuple[int, Number]] = {}
        """Offset and type of each number, by its path."""
        self.arrays: dict[str, list[str]] = {}
        """Paths of the numbers of each array or sequence."""

    def encode(self, kind: FieldType, value: Any, path: str) -> None:
        """Append a value."""
        match kind:
            case Structure():
                if not kind.fields:
                    self.buffer += b'\0'
                for name, field in kind.fields:
                    self.encode(field, getattr(value, name), f'{path}.{name}' if path else name)
            case Number():
                self._align(kind.size)
                self.numbers[path] = len(self.buffer), kind
                self.buffer += struct.pack(f'<{kind.code}', value)
            case Text():
                # rclpy passes strings on as C strings.
                encoded = value.partition('\0')[0].encode() + b'\0'
                self._count(len(encoded))
                self.buffer += encoded
            case Array() | Sequence():
                if isinstance(kind, Sequence):
                    self._count(len(value))
                elif len(value) != kind.count:
                    raise struct.error(f'{path} must have {kind.count} elements, got {len(value)}')
                elements = [f'{path}[{number}]' for number in range(len(value))]
                for element, one in zip(elements, value, strict=True):
                    self.encode(kind.element, one, element)
                if isinstance(kind.element, Number):
                    self.arrays[path] = elements

    def _count(self, count: int) -> None:
        self._align(COUNT.size)
        self.buffer += struct.pack('<I', count)

    def _align(self, size: int) -> None:
        self.buffer += bytes((ENCAPSULATION - len(self.buffer)) % size)


class _Run(NamedTuple):
    """Numbers that are packed without anything else but zeros between them."""

    start: int
    end: int
    format: str
    numbers: int


def _runs(encoder: _Encoder, fields: Values[str]) -> list[_Run]:
    """Return the runs of the fields, as few as possible."""
    paths = [path for field in fields for path in encoder.arrays.get(field, [field])]
    unknown = [path for path in paths if path not in encoder.numbers]
    if unknown:
        raise ValueError(f"a field must be a number of the message, got '{unknown[0]}'")
    slots = [encoder.numbers[path] for path in paths]
    if any(offset >= after for (offset, _), (after, _) in pairwise(slots)):
        raise ValueError(f'fields must be in the order of the message, got {list(fields)}')
    runs: list[_Run] = []
    for offset, kind in slots:
        if runs and not any(encoder.buffer[runs[-1].end : offset]):
            start, end, text, count = runs.pop()
            text += f'{offset - end}x'
        else:
            start, text, count = offset, '', 0
        runs.append(_Run(start, offset + kind.size, text + kind.code, count + 1))
    return runs
