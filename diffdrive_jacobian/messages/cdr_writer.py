"""Writing serialized messages from a template."""

from __future__ import annotations

import struct
from collections.abc import Callable
from collections.abc import Sequence as Values
from itertools import pairwise
from typing import Any

from diffdrive_jacobian.messages.cdr_types import (
    COUNT,
    ENCAPSULATION,
    LITTLE_ENDIAN,
    Array,
    FieldType,
    Number,
    Sequence,
    Structure,
    Text,
    structure,
)
from diffdrive_jacobian.messages.errors import MessageError


class Writer:
    """Writes serialized messages that differ from a template in some numbers."""

    def __init__(self, template: Any, fields: Values[str]) -> None:
        """Serialize the template.

        Args:
            template: A message. Its strings and the lengths of its sequences are those of all messages
                that are written.
            fields: Paths of the numbers that are written, in the order of the message:
                `pose.position.x`, `covariance[7]` for an element, `covariance` for all elements of an
                array or sequence.

        Raises:
            ValueError: A field does not exist, is no number, or is not in the order of the message.
            MessageError: The template cannot be serialized.
            TypeError: The message has a type of field that is not supported.
        """
        encoder = _Encoder()
        message_class: Any = type(template)
        kind = structure(message_class)
        try:
            encoder.encode(kind, template, '')
        except (struct.error, OverflowError, UnicodeEncodeError) as error:
            raise MessageError(f'{kind.name} cannot be serialized: {error}') from error
        self._name = kind.name
        self._buffer = encoder.buffer
        self._runs = _runs(encoder, fields)
        self._single = self._runs[0][:2] if len(self._runs) == 1 else None

    def __call__(self, *values: Any) -> bytes:
        """Return the message with these numbers, one for each field or element of a field.

        Raises:
            MessageError: A number is out of range for its field, or their count is wrong.
        """
        buffer = self._buffer
        try:
            if self._single is not None:
                pack_into, offset = self._single
                pack_into(buffer, offset, *values)
            else:
                for pack_into, offset, part in self._runs:
                    pack_into(buffer, offset, *values[part])
        except (struct.error, OverflowError) as error:
            raise MessageError(f'{self._name} cannot be serialized: {error}') from error
        return bytes(buffer)


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


_Run = tuple[Callable[..., None], int, slice]
"""A function that packs numbers into a buffer, the offset of the first, and which values they are."""


def _runs(encoder: _Encoder, fields: Values[str]) -> list[_Run]:
    """Compile the packing of fields, with as few calls as possible.

    Packing writes zeros between the numbers, so numbers are packed together where the template has
    nothing else between them.
    """
    paths = [path for field in fields for path in encoder.arrays.get(field, [field])]
    unknown = [path for path in paths if path not in encoder.numbers]
    if unknown:
        raise ValueError(f"a field must be a number of the message, got '{unknown[0]}'")
    slots = [encoder.numbers[path] for path in paths]
    if any(offset >= after for (offset, _), (after, _) in pairwise(slots)):
        raise ValueError(f'fields must be in the order of the message, got {list(fields)}')
    runs: list[_Run] = []
    first = 0
    while first < len(slots):
        start, kind = slots[first]
        text, end, last = f'<{kind.code}', start + kind.size, first + 1
        while last < len(slots):
            offset, kind = slots[last]
            if any(encoder.buffer[end:offset]):
                break
            text += f'{offset - end}x{kind.code}'
            end, last = offset + kind.size, last + 1
        runs.append((struct.Struct(text).pack_into, start, slice(first, last)))
        first = last
    return runs
