"""Messages of a damaged MCAP file: all that are complete.

MCAP (mcap.dev/spec) is read record by record up to the damage, including chunks that were cut off.
Checksums and counts, which are optional, show whether messages were altered or are missing.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import BinaryIO, NamedTuple

from diffdrive_jacobian.bags.files import MCAP_MAGIC
from diffdrive_jacobian.bags.journal import Message
from diffdrive_jacobian.bags.limits import (
    MAX_RECORD,
    UNPACK_ERRORS,
    Budget,
    check_record,
    unpack,
)
from diffdrive_jacobian.bags.storage import file_checksum
from diffdrive_jacobian.text import format_size
from diffdrive_jacobian.time_units import NANOSECONDS

Schemas = dict[int, tuple[str, str]]
"""Numbers of types to their names and definitions."""
Note = Callable[[str], None]
"""Is called with a description of a loss, or of what cannot be checked."""


class Topic(NamedTuple):
    """A topic as a file describes it, with the `id` of its messages. Unknown fields are empty."""

    id: int
    name: str
    type_name: str
    encoding: str
    qos: str = ''
    """Offered profiles (YAML)."""
    type_hash: str = ''
    definition: str = ''


Found = Topic | Message | str
"""A text is a copy of metadata.yaml in the file."""


_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
_STATISTICS, _METADATA, _DATA_END = 0x0B, 0x0C, 0x0F
_OPCODES = range(0x01, 0x10)
_HEAD = struct.Struct('<BQ')
_MESSAGE_HEAD = struct.Struct('<HIQQ')
_ATTACHMENT = 0x09


class _Cursor:
    """Reads the fields of an MCAP record, or raises ValueError if the record is too short."""

    def __init__(self, data: bytes) -> None:
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


class _Check:
    """Compares the messages that were found with the checksums and counts of the file."""

    def __init__(self, file: BinaryIO, note: Note, doubt: Note) -> None:
        self._file = file
        self._note, self._doubt = note, doubt
        self._found: Counter[int] = Counter()
        self._counts: dict[int, int] | None = None
        self._topics: dict[int, Topic] = {}
        self._unchecked = False
        self._behind = self._differing = 0
        self._in_data, self._data_is_right = True, False
        # Only the last of each kind counts, so that each part of the file is read once.
        self._checksums: dict[str, tuple[int, int, int]] = {}

    def add(self, found: Found, checked: bool) -> None:
        """Count what was found; `checked`: in a chunk with a checksum."""
        if isinstance(found, Message):
            self._found[found.channel] += 1
            self._behind += not self._in_data
        elif isinstance(found, Topic):
            self._differing += self._topics.setdefault(found.id, found) != found
        self._unchecked |= self._in_data and not checked and not isinstance(found, str)

    def add_record(self, opcode: int, payload: bytes, end: int) -> None:
        """Take the counts and checksums from a record, or raise ValueError if it is invalid."""
        cursor, start = _Cursor(payload), end - len(payload) - _HEAD.size
        if opcode == _STATISTICS:
            cursor.take(42)
            counts = _Cursor(cursor.take(cursor.number(4)))
            self._counts = {}
            while counts:
                channel = counts.number(2)
                self._counts[channel] = counts.number(8)
        elif opcode == _DATA_END:
            self._in_data = False
            self._checksums['data section'] = 0, start, cursor.number(4)
        elif opcode == _FOOTER:
            summary, _, checksum = (cursor.number(length) for length in (8, 8, 4))
            self._checksums['summary'] = summary or start, end - 4, checksum

    def finish(self) -> None:
        """Report what differs, and what cannot be checked."""
        for what, (start, end, checksum) in self._checksums.items():
            right = checksum != 0 and file_checksum(self._file, start, end) == checksum
            if checksum and not right:
                self._note(f'the checksum of its {what} is wrong')
            self._data_is_right |= right and what == 'data section'
        if self._differing:
            self._note(f'{self._differing} descriptions of topics differ from earlier ones')
        if self._behind:
            self._note(f'{self._behind} of its messages are behind its data section')
        found, counts = self._found, self._counts
        if counts is not None and any(counts.get(one, 0) != found[one] for one in {*counts, *found}):
            self._note(
                f'its statistics count {sum(counts.values())} messages, {found.total()} were found, '
                'or their topics differ'
            )
        if not self._data_is_right and self._unchecked:
            self._doubt('it has no checksums of its messages, so altered ones cannot be noticed')
        elif not self._data_is_right and counts is None:
            self._doubt('it has no count of its messages')


def read_mcap(file: BinaryIO, note: Note, doubt: Note) -> Iterator[Found]:
    """Read an MCAP file up to its end, or up to where it is cut off or damaged.

    Args:
        file: The file.
        note: Is called with a description of each loss.
        doubt: Is called with what cannot be checked.
    """
    size = file.seek(0, 2)
    file.seek(0)
    if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
        note(f'its {size} bytes are not the start of an MCAP file')
        return
    schemas: Schemas = {}
    budget, check = Budget(size), _Check(file, note, doubt)
    good, opcode = len(MCAP_MAGIC), 0
    try:
        for opcode, payload, end in _walk(file, size, note):
            if opcode == _CHUNK:
                yield from _read_chunk(payload, end > size, schemas, budget, check, note)
            elif end <= size:
                for found in _read_record(opcode, payload, schemas):
                    check.add(found, False)
                    yield found
                check.add_record(opcode, payload, end)
            if end <= size:
                good = end
    except ValueError:
        # A record is invalid, so the position of the next one is unknown.
        pass
    file.seek(good)
    if opcode != _FOOTER or file.read(len(MCAP_MAGIC) + 1) != MCAP_MAGIC:
        note(f'it is cut off: the last {size - good} of its {size} bytes are not a complete record')
    check.finish()


def _walk(file: BinaryIO, size: int, note: Note) -> Iterator[tuple[int, bytes, int]]:
    """Yield opcode, payload and end of each record. The end of one that is cut off is beyond `size`.

    A message is yielded when a record or the end follows it. Otherwise its length may be damaged.
    """
    waiting: list[tuple[int, bytes, int]] = []
    end, opcode = file.tell(), 0
    while end <= size and opcode != _FOOTER and (head := file.read(_HEAD.size)):
        if head[0] not in _OPCODES:
            waiting = [] if opcode == _MESSAGE else waiting
            break
        yield from waiting
        waiting = []
        if len(head) < _HEAD.size:
            break
        opcode, length = _HEAD.unpack(head)
        end += _HEAD.size + length
        if opcode == _ATTACHMENT or (length > MAX_RECORD and end <= size):
            if opcode != _ATTACHMENT:
                note(f'a record of {format_size(length)} is not read: it is too large')
            # A damaged length may be larger than any position.
            file.seek(min(end, size))
            continue
        waiting = [(opcode, file.read(min(length, size, MAX_RECORD)), end)]
    yield from waiting


def _read_chunk(
    payload: bytes, cut: bool, schemas: Schemas, budget: Budget, check: _Check, note: Note
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
    right = len(data) == size and checksum in (0, zlib.crc32(data))
    if not cut and not right:
        seconds = (end - start) / NANOSECONDS
        note(f'a chunk of {size} bytes ({seconds:.1f} s) is damaged: its messages may be altered')
    good = 0
    try:
        for opcode, record, ending in _walk(BytesIO(data), len(data), note):
            if ending <= len(data):
                for found in _read_record(opcode, record, schemas):
                    check.add(found, checksum != 0)
                    yield found
                good = ending
    except ValueError:
        # As in read_mcap.
        pass
    if good < len(data) and not cut:
        note(f'the last {len(data) - good} of the {size} bytes of a chunk are not complete records')


def _read_record(opcode: int, payload: bytes, schemas: Schemas) -> Iterator[Found]:
    """Read a complete record, or raise ValueError if it is invalid."""
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
