"""Writing serialized messages from a template."""

from __future__ import annotations

import struct
from collections.abc import Sequence as Values
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

from diffdrive_jacobian.messages.errors import MessageError
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
    structure,
)


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
            TypeError: The message has a wide string.
        """
        encoder = _Encoder()
        message_class: Any = type(template)
        kind = structure(message_class)
        check_plain(kind)
        try:
            encoder.encode(kind, template, '')
        except (struct.error, OverflowError, UnicodeEncodeError) as error:
            raise MessageError(f'{kind.short_name} cannot be serialized: {error}') from error
        self._name = kind.short_name
        runs = _runs(encoder, fields)
        content = bytes(encoder.buffer)
        # All is packed at once: what does not change as strings of bytes, between the runs of numbers.
        layout, end, constants = '<', 0, []
        for run in runs:
            constants.append(content[end : run.start])
            layout += f'{run.start - end}s{run.format}'
            end = run.end
        tail = content[end:]
        layout += f'{len(tail)}s' if any(tail) else f'{len(tail)}x'
        self._tail = (tail,) if any(tail) else ()
        self._pack = struct.Struct(layout).pack
        self._head = constants[:1]
        self._first = slice(runs[0].numbers if len(runs) > 1 else None)
        self._more = list(zip(constants, _parts(runs), strict=True))[1:]

    def __call__(self, *values: Any) -> bytes:
        """Return the message with these numbers, one for each field or element of a field.

        Raises:
            MessageError: A number is out of range for its field, or their count is wrong.
        """
        try:
            if not self._more:
                return self._pack(*self._head, *values, *self._tail)
            if len(self._more) == 1:
                # Usually a stamp, the names of frames, and numbers.
                ((constant, part),) = self._more
                return self._pack(
                    *self._head, *values[self._first], constant, *values[part], *self._tail
                )
            arguments = [*self._head, *values[self._first]]
            for constant, part in self._more:
                arguments.append(constant)
                arguments += values[part]
            return self._pack(*arguments, *self._tail)
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
    """Return the runs of the fields, as few as possible.

    Raises:
        ValueError: A field is no number, or is not in the order of the message.
    """
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


def _parts(runs: list[_Run]) -> list[slice]:
    """Return which of the values are those of each run. Those after the last one are left to it."""
    ends = list(accumulate(run.numbers for run in runs))
    starts = [0, *ends[:-1]][: len(runs)]
    return [slice(*pair) for pair in zip(starts, [*ends[:-1], None], strict=False)]
