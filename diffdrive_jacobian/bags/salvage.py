"""What is left of a broken bag: every message that can be read whole, and none that cannot.

MCAP (mcap.dev/spec) is read record by record up to the cut, chunks that were cut off included. SQLite
(sqlite.org/fileformat2.html) is read by its leaf pages: the tree above them may be missing or stale, and
so rows come to light, too, that were written, but never committed.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

from diffdrive_jacobian.bags.journal import Message
from diffdrive_jacobian.bags.limits import (
    MAX_RECORD,
    UNPACK_ERRORS,
    Budget,
    check_record,
    format_size,
    unpack,
)

Schemas = dict[int, tuple[str, str]]
"""Numbers of types to their names and definitions."""
Note = Callable[[str], None]  # Takes what was lost, in words.


class Topic(NamedTuple):
    """A topic as a file describes it, `id` as in its messages; what the file does not say is empty."""

    id: int
    name: str
    type_name: str
    encoding: str
    qos: str = ''
    """Offered profiles (YAML)."""
    type_hash: str = ''
    definition: str = ''


Found = Topic | Message | str
"""A text is what metadata.yaml holds, too."""


# --- MCAP

MCAP_MAGIC = b'\x89MCAP0\r\n'
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0C
_OPCODES = range(0x01, 0x10)
_HEAD = struct.Struct('<BQ')
_MESSAGE_HEAD = struct.Struct('<HIQQ')
_ATTACHMENT = 0x09


class _Cursor:
    """Reads the fields of an MCAP record; ValueError: the record is too short."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def left(self) -> bytes:
        """What was not taken yet."""
        return self._data[self._at :]

    def __bool__(self) -> bool:
        """Whether something is left."""
        return self._at < len(self._data)

    def take(self, length: int) -> bytes:
        end = self._at + length
        if end > len(self._data):
            raise ValueError(f'{length} bytes expected, got {len(self._data) - self._at}')
        taken, self._at = self._data[self._at : end], end
        return taken

    def number(self, length: int) -> int:
        return int.from_bytes(self.take(length), 'little')

    def text(self) -> str:
        return self.take(self.number(4)).decode()

    def texts(self) -> dict[str, str]:
        inner, found = _Cursor(self.take(self.number(4))), {}
        while inner:
            key = inner.text()
            found[key] = inner.text()
        return found


def read_mcap(file: BinaryIO, note: Note) -> Iterator[Found]:
    """Read an MCAP file up to its end, or to what was cut off or damaged."""
    size = file.seek(0, 2)
    file.seek(0)
    if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
        note(f'its {size} bytes do not begin as MCAP does')
        return
    schemas: Schemas = {}
    budget = Budget(size)
    good, opcode = len(MCAP_MAGIC), 0
    try:
        for opcode, payload, end in _walk(file, size, note):
            if opcode == _CHUNK:
                yield from _read_chunk(payload, end > size, schemas, budget, note)
            elif end <= size:
                yield from _read_record(opcode, payload, schemas)
            if end <= size:
                good = end
    except ValueError:
        pass  # A record is not what it says: what follows cannot be trusted either.
    file.seek(good)
    if opcode != _FOOTER or file.read(len(MCAP_MAGIC) + 1) != MCAP_MAGIC:
        note(f'it breaks off: the last {size - good} of its {size} bytes hold no whole record')


def _walk(file: BinaryIO, size: int, note: Note) -> Iterator[tuple[int, bytes, int]]:
    """Give opcode, payload and end of each record; the end of one that was cut off is beyond `size`.

    A message is given when a record follows it, or the end: else its length may be wrong.
    """
    held: list[tuple[int, bytes, int]] = []
    end, opcode = file.tell(), 0
    while end <= size and opcode != _FOOTER and (head := file.read(_HEAD.size)):
        if head[0] not in _OPCODES:
            held = [] if opcode == _MESSAGE else held
            break
        yield from held
        held = []
        if len(head) < _HEAD.size:
            break
        opcode, length = _HEAD.unpack(head)
        end += _HEAD.size + length
        if opcode == _ATTACHMENT or (length > MAX_RECORD and end <= size):
            if opcode != _ATTACHMENT:
                note(f'a record of {format_size(length)} is not read: it is too large')
            file.seek(end)
            continue
        held = [(opcode, file.read(min(length, size, MAX_RECORD)), end)]
    yield from held


def _read_chunk(
    payload: bytes, cut: bool, schemas: Schemas, budget: Budget, note: Note
) -> Iterator[Found]:
    cursor = _Cursor(payload)
    try:
        start, end, size, checksum = (cursor.number(length) for length in (8, 8, 8, 4))
        compression, length = cursor.text(), cursor.number(8)
        check_record(size, 'it')
        budget.spend(size)
        data = unpack(compression, cursor.left[:length], size)
    except UNPACK_ERRORS as error:
        note(f'a chunk of {len(payload)} bytes cannot be unpacked: {error}')
        return
    if not cut and (len(data) != size or (checksum and zlib.crc32(data) != checksum)):
        note(f'a chunk of {size} bytes is damaged ({(end - start) / 1e9:.1f} s)')
        return
    for opcode, record, ending in _walk(BytesIO(data), len(data), note):
        if ending <= len(data):
            yield from _read_record(opcode, record, schemas)


def _read_record(opcode: int, payload: bytes, schemas: Schemas) -> Iterator[Found]:
    """Read a record that is there whole; ValueError: it is not what it says."""
    cursor = _Cursor(payload)
    if opcode == _MESSAGE:
        channel, _, stamp, _ = _MESSAGE_HEAD.unpack(cursor.take(_MESSAGE_HEAD.size))
        yield Message(channel, stamp, cursor.left)
    elif opcode == _SCHEMA:
        number, name, _ = cursor.number(2), cursor.text(), cursor.text()
        schemas[number] = name, cursor.text()
    elif opcode == _CHANNEL:
        number, schema = cursor.number(2), cursor.number(2)
        name, encoding, extra = cursor.text(), cursor.text(), cursor.texts()
        type_name, definition = schemas.get(schema, ('', ''))
        qos, type_hash = (extra.get(key, '') for key in ('offered_qos_profiles', 'topic_type_hash'))
        yield Topic(number, name, type_name, encoding, qos, type_hash, definition)
    elif opcode == _METADATA and cursor.text() == 'rosbag2':
        yield cursor.texts().get('serialized_metadata', '')


# --- SQLite

SQLITE_MAGIC = b'SQLite format 3\0'
_LEAF = 0x0D
_WIDTHS = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)  # of the serial types below 10
_MAX_COLUMNS = 32
_COPIES = 4
"""How many times the size of a database its rows may be in all: pages have older copies sometimes."""


class _Pages:
    """An SQLite file as pages, numbered from 1, and the rows that those hold."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.bytes = file.seek(0, 2)
        file.seek(0)
        head = file.read(100).ljust(100, b'\0')
        self.size = {1: 65536}.get(size := int.from_bytes(head[16:18], 'big'), size)
        self.valid = head.startswith(SQLITE_MAGIC) and self.size in [2**n for n in range(9, 17)]
        self.usable = self.size - head[20]
        self.count = self.bytes // self.size if self.valid else 0
        self._budget = Budget(self.bytes, ratio=_COPIES)
        # How many there were at the last commit, if that is known.
        self.committed = int.from_bytes(head[28:32], 'big') if head[24:28] == head[92:96] else 0

    def page(self, number: int) -> bytes:
        self._file.seek((number - 1) * self.size)
        return self._file.read(self.size)

    def rows(self, number: int) -> Iterator[tuple[int, list[Any] | None]]:
        """Give the rows of a leaf page of a table: number and values, None if they cannot be read."""
        page, start = self.page(number), 100 if number == 1 else 0
        if page[start] != _LEAF:
            return
        count = int.from_bytes(page[start + 3 : start + 5], 'big')
        # A row takes six bytes at least.
        for index in range(min(count, self.size // 6)):
            row, at = 0, start + 8 + 2 * index
            try:
                length, at = _varint(page, int.from_bytes(page[at : at + 2], 'big'))
                row, at = _varint(page, at)
                yield row, _values(self._payload(page, at, length))
            except (ValueError, IndexError):
                yield row, None

    def _payload(self, page: bytes, at: int, length: int) -> bytes:
        """Give what a cell holds; what has no room in its page is in a chain of others."""
        most, least = self.usable - 35, (self.usable - 12) * 32 // 255 - 23
        local = length
        if length > most:
            local = least + (length - least) % (self.usable - 4)
            local = local if local <= most else least
        check_record(length, 'a row')
        self._budget.spend(length)
        parts = [page[at : at + local]]
        missing = length - len(parts[0])
        following = page[at + local : at + local + 4] if local < length else b''
        seen: set[int] = set()
        while missing > 0 and len(parts[0]) == local:
            number = int.from_bytes(following, 'big')
            if not 1 < number <= self.count or number in seen:
                raise ValueError('the chain breaks off or goes in a circle')
            seen.add(number)
            more = self.page(number)
            # Of a commit that never came, pages may be there without their content.
            if number > self.committed and not any(more):
                raise ValueError('a page of the chain was never written')
            parts.append(more[4 : min(self.usable, 4 + missing)])
            missing -= len(parts[-1])
            following = more[:4]
        if missing or any(following):
            raise ValueError(f'{length} bytes expected, {missing} are missing')
        return b''.join(parts)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for place in range(at, at + 8):
        value = value << 7 | data[place] & 0x7F
        if data[place] < 0x80:
            return value, place + 1
    return value << 8 | data[at + 8], at + 9


def _values(record: bytes) -> list[Any]:
    """Read a row; ValueError or IndexError: it is none."""
    body, at = _varint(record, 0)
    place = body
    values: list[Any] = []
    while at < body:
        kind, at = _varint(record, at)
        if kind in (10, 11) or len(values) == _MAX_COLUMNS:
            raise ValueError(f'no serial type, or too many columns: {kind}')
        width = _WIDTHS[kind] if kind < 10 else (kind - 12) // 2
        raw, place = record[place : place + width], place + width
        if kind >= 12:
            values.append(raw.decode() if kind % 2 else raw)
        else:
            number = kind - 8 if kind >= 8 else int.from_bytes(raw, 'big', signed=True)
            values.append(number if kind not in (0, 7) else None)
    if (at, place) != (body, len(record)):
        raise ValueError(f'a row of {place} bytes expected, got {len(record)}')
    return values


def read_sqlite(file: BinaryIO, note: Note) -> Iterator[Found]:
    """Read what an SQLite file of rosbag2 holds, committed or not; the rows in their order."""
    pages = _Pages(file)
    if not pages.valid:
        note(f'its {pages.bytes} bytes do not begin as an SQLite database does')
        return
    topics: dict[int, list[Any]] = {}
    definitions: dict[str, str] = {}
    starts: list[tuple[int, int]] = []
    for number in range(1, pages.count + 1):
        for row, values in pages.rows(number):
            if not values or values[0] is not None:
                continue
            kinds = [type(value) for value in values[1:]]
            if kinds == [int, int, bytes]:
                starts.append((row, number))
                break
            if kinds == [int, str]:
                yield values[2]
            elif set(kinds) == {str} and values[1].startswith('/'):
                topics[row] = values[1:]
            elif kinds == [str] * 4:
                definitions[values[1]] = values[3]
    for row, values in topics.items():
        name, kind, encoding, qos, type_hash = [*values, '', ''][:5]
        yield Topic(row, name, kind, encoding, qos, type_hash, definitions.get(kind, ''))
    last = read = 0
    starts.sort()
    for (_, number), (limit, _) in zip(starts, [*starts, (2**63, 0)][1:], strict=True):
        for row, values in pages.rows(number):
            # Pages have older copies sometimes.
            if values and last < row < limit:
                yield Message(*values[1:])
                last, read = row, read + 1
    if last > read:
        note(f'{last - read} of its first {last} messages cannot be read')
    if missing := max(pages.committed * pages.size - pages.bytes, pages.bytes % pages.size):
        note(f'it breaks off: {missing} bytes are missing or hold no whole page')
