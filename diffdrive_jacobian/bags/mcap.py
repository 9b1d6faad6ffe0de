"""Records of MCAP files: their kinds, and the fields in them (mcap.dev/spec)."""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

MAGIC = b'\x89MCAP0\r\n'
"""At the beginning and at the end of a file."""
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = range(0x01, 0x07)
ATTACHMENT, STATISTICS, METADATA, DATA_END = 0x09, 0x0B, 0x0C, 0x0F
OPCODES = range(0x01, 0x10)
HEAD = struct.Struct('<BQ')
"""Before the fields of a record: its opcode and their length."""
MESSAGE_HEAD = struct.Struct('<HIQQ')
"""Before the data of a message: its channel, its number, and when it was received and sent (ns)."""
FOOTER_END = struct.Struct('<QQI8s')
"""Start of the summary and of its offsets, checksum of the summary, and the magic."""
_BLOCK = 1 << 20


def record(opcode: int, *fields: bytes) -> bytes:
    """Return a record."""
    return b''.join((HEAD.pack(opcode, sum(map(len, fields))), *fields))


def number(value: int, length: int) -> bytes:
    """Return a field with an unsigned number of so many bytes."""
    return value.to_bytes(length, 'little')


def text(value: str | bytes) -> bytes:
    """Return a field with a text."""
    data = value.encode() if isinstance(value, str) else value
    return number(len(data), 4) + data


def texts(values: dict[str, str]) -> bytes:
    """Return a field with a map of texts."""
    return text(b''.join(text(key) + text(value) for key, value in values.items()))


class Cursor:
    """Reads the fields of a record, or raises ValueError if the record is too short."""

    def __init__(self, data: bytes) -> None:
        """Start with the first field."""
        self._data = data
        self._at = 0

    @property
    def left(self) -> bytes:
        """The bytes that were not read yet."""
        return self._data[self._at :]

    def __bool__(self) -> bool:
        """Return whether there are bytes that were not read yet."""
        return self._at < len(self._data)

    def take(self, length: int) -> bytes:
        """Read so many bytes."""
        end = self._at + length
        if end > len(self._data):
            raise ValueError(f'{length} bytes expected, got {len(self._data) - self._at}')
        taken, self._at = self._data[self._at : end], end
        return taken

    def number(self, length: int) -> int:
        """Read an unsigned number of so many bytes."""
        return int.from_bytes(self.take(length), 'little')

    def text(self) -> str:
        """Read a text."""
        return self.take(self.number(4)).decode()

    def texts(self) -> dict[str, str]:
        """Read a map of texts."""
        inner, found = Cursor(self.take(self.number(4))), {}
        while inner:
            key = inner.text()
            found[key] = inner.text()
        return found


def file_checksum(file: BinaryIO, start: int, end: int) -> int:
    """Return the CRC-32 of a part of a file."""
    checksum = 0
    file.seek(min(start, end))
    while start < end and (block := file.read(min(end - start, _BLOCK))):
        checksum = zlib.crc32(block, checksum)
        start += len(block)
    return checksum
