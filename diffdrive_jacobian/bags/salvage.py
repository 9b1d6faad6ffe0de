"""Messages of damaged MCAP and SQLite files: all that are complete."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

from diffdrive_jacobian.bags import mcap
from diffdrive_jacobian.bags.corrected_reader import UNPACK_ERRORS, unpack
from diffdrive_jacobian.bags.files import SQLITE_MAGIC
from diffdrive_jacobian.bags.journal import CUSTOM_DATA, LIBRARY, Message, Text
from diffdrive_jacobian.time_units import NANOSECONDS

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


Found = Topic | Message | Text | str
"""A `str` is a copy of metadata.yaml in the file."""


# --- MCAP


class _McapFile:
    """Reads an MCAP file, and compares what is found with the checksums and counts in it."""

    def __init__(self, file: BinaryIO, note: Note, doubt: Note) -> None:
        self._file = file
        self._note, self._doubt = note, doubt
        self._schemas: dict[int, tuple[str, str]] = {}
        """Numbers of types to their names and definitions."""
        self._found: Counter[int] = Counter()
        self._counts: dict[int, int] | None = None
        self._topics: dict[int, Topic] = {}
        self._unchecked = False
        self._behind = self._differing = 0
        self._numbered, self._last = False, 0
        self._in_data, self._data_is_right = True, False
        # Only the last of each kind counts, so that each part of the file is read once.
        self._checksums: dict[str, tuple[int, int, int]] = {}

    def read(self) -> Iterator[Found]:
        size = self._file.seek(0, 2)
        self._file.seek(0)
        if self._file.read(len(mcap.MAGIC)) != mcap.MAGIC:
            self._note(f'its {size} bytes are not the start of an MCAP file')
            return
        good, opcode = len(mcap.MAGIC), 0
        # Where a record is invalid, the position of the next one is unknown.
        with suppress(ValueError):
            for opcode, payload, end in _walk(self._file, size):
                if opcode == mcap.CHUNK:
                    yield from self._chunk(payload, end > size)
                elif end <= size:
                    yield from self._record(opcode, payload, checked=False)
                    self._check(opcode, payload, end)
                if end <= size:
                    good = end
        self._file.seek(good)
        if good == size and opcode != mcap.FOOTER:
            self._doubt('it has no end: what its writer had not written yet is not in it')
        elif opcode != mcap.FOOTER or self._file.read(len(mcap.MAGIC) + 1) != mcap.MAGIC:
            lost = f'the last {size - good} of its {size} bytes are not a complete record'
            self._note(f'it is cut off: {lost}')
        self._finish()

    def _chunk(self, payload: bytes, cut: bool) -> Iterator[Found]:
        cursor = mcap.Cursor(payload)
        try:
            start, end, size, checksum = (cursor.number(length) for length in (8, 8, 8, 4))
            compression, length = cursor.text(), cursor.number(8)
            data = unpack(compression, cursor.left[:length], size)
        except UNPACK_ERRORS as error:
            self._note(f'a chunk of {len(payload)} bytes cannot be unpacked: {error}')
            return
        right = len(data) == size and checksum in (0, zlib.crc32(data))
        if not cut and not right:
            what = f'a chunk of {size} bytes ({(end - start) / NANOSECONDS:.1f} s)'
            self._note(f'{what} is damaged: its messages may be altered')
        good = 0
        with suppress(ValueError):
            for opcode, record, ending in _walk(BytesIO(data), len(data)):
                if ending <= len(data):
                    yield from self._record(opcode, record, checked=checksum != 0)
                    good = ending
        if good < len(data) and not cut:
            lost = f'the last {len(data) - good} of the {size} bytes of a chunk'
            self._note(f'{lost} are not complete records')

    def _record(self, opcode: int, payload: bytes, *, checked: bool) -> Iterator[Found]:
        """Read a complete record, or raise ValueError; `checked`: in a chunk with a checksum."""
        cursor = mcap.Cursor(payload)
        if opcode == mcap.MESSAGE:
            channel, number, stamp, _ = mcap.MESSAGE_HEAD.unpack(cursor.take(mcap.MESSAGE_HEAD.size))
            self._found[channel] += 1
            self._behind += not self._in_data
            self._last = max(self._last, number)
            self._unchecked |= self._in_data and not checked
            yield Message(channel, stamp, cursor.left, number)
        elif opcode == mcap.SCHEMA:
            number, name, _ = cursor.number(2), cursor.text(), cursor.text()
            self._schemas[number] = name, cursor.text()
        elif opcode == mcap.CHANNEL:
            number, schema = cursor.number(2), cursor.number(2)
            name, encoding, extra = cursor.text(), cursor.text(), cursor.texts()
            type_name, definition = self._schemas.get(schema, ('', ''))
            qos, type_hash = (extra.get(key, '') for key in ('offered_qos_profiles', 'topic_type_hash'))
            topic = Topic(number, name, type_name, encoding, qos, type_hash, definition)
            self._differing += self._topics.setdefault(number, topic) != topic
            self._unchecked |= self._in_data and not checked
            yield topic
        elif opcode == mcap.ATTACHMENT and payload[-4:] == _checksum(payload[:-4]):
            # Its times.
            cursor.take(16)
            key, media_type = cursor.text(), cursor.text()
            if media_type == CUSTOM_DATA:
                yield Text(key, cursor.take(cursor.number(8)).decode())
        elif opcode == mcap.METADATA and cursor.text() == 'rosbag2':
            yield cursor.texts().get('serialized_metadata', '')

    def _check(self, opcode: int, payload: bytes, end: int) -> None:
        """Take the counts and checksums from a record, or raise ValueError if it is invalid."""
        cursor, start = mcap.Cursor(payload), end - len(payload) - mcap.HEAD.size
        if self._numbered and self._in_data and opcode not in (mcap.ATTACHMENT, mcap.DATA_END):
            self._note(f'a record has the opcode {opcode}, which is none of a journal')
        if opcode == mcap.STATISTICS:
            cursor.take(42)
            counts = mcap.Cursor(cursor.take(cursor.number(4)))
            self._counts = {}
            while counts:
                channel = counts.number(2)
                self._counts[channel] = counts.number(8)
        elif opcode == mcap.HEADER:
            cursor.text()
            self._numbered |= cursor.text() == LIBRARY
        elif opcode == mcap.ATTACHMENT:
            if payload[-4:] not in (bytes(4), _checksum(payload[:-4])):
                self._note(f'an attachment of {len(payload)} bytes is damaged: it is left out')
        elif opcode == mcap.DATA_END:
            self._in_data = False
            self._checksums['data section'] = 0, start, cursor.number(4)
        elif opcode == mcap.FOOTER:
            summary, _, checksum = (cursor.number(length) for length in (8, 8, 4))
            self._checksums['summary'] = summary or start, end - 4, checksum

    def _finish(self) -> None:
        """Report what differs, and what cannot be checked."""
        for what, (start, end, checksum) in self._checksums.items():
            right = checksum != 0 and mcap.file_checksum(self._file, start, end) == checksum
            if checksum and not right:
                self._note(f'the checksum of its {what} is wrong')
            self._data_is_right |= right and what == 'data section'
        if self._differing:
            self._note(f'{self._differing} descriptions of topics differ from earlier ones')
        if self._behind:
            self._note(f'{self._behind} of its messages are behind its data section')
        found, counts = self._found, self._counts
        if self._numbered and self._last != found.total():
            self._note(f'its messages have the numbers 1 to {self._last}, {found.total()} were found')
        if counts is not None and any(counts.get(one, 0) != found[one] for one in {*counts, *found}):
            self._note(
                f'its statistics count {sum(counts.values())} messages, {found.total()} were found, '
                'or their topics differ'
            )
        if not self._data_is_right and self._unchecked:
            self._doubt('it has no checksums of its messages, so altered ones cannot be noticed')
        elif not self._data_is_right and counts is None and not self._numbered:
            self._doubt('it has no count of its messages')


def read_mcap(file: BinaryIO, note: Note, doubt: Note) -> Iterator[Found]:
    """Yield what is in an MCAP file (mcap.dev/spec) up to its end, or where it is cut off or damaged.

    Args:
        file: The file.
        note: Is called with a description of each loss.
        doubt: Is called with what cannot be checked.
    """
    return _McapFile(file, note, doubt).read()


def _walk(file: BinaryIO, size: int) -> Iterator[tuple[int, bytes, int]]:
    """Yield opcode, payload and end of each record. The end of one that is cut off is beyond `size`.

    A message is yielded when a record or the end follows it. Otherwise its length may be damaged.
    """
    waiting: list[tuple[int, bytes, int]] = []
    end, opcode = file.tell(), 0
    while end <= size and opcode != mcap.FOOTER and (head := file.read(mcap.HEAD.size)):
        if head[0] not in mcap.OPCODES:
            waiting = [] if opcode == mcap.MESSAGE else waiting
            break
        yield from waiting
        waiting = []
        if len(head) < mcap.HEAD.size:
            break
        opcode, length = mcap.HEAD.unpack(head)
        end += mcap.HEAD.size + length
        waiting = [(opcode, file.read(min(length, size - file.tell())), end)]
    yield from waiting


def _checksum(content: bytes) -> bytes:
    return mcap.number(zlib.crc32(content), 4)


# --- SQLite

_LEAF = 0x0D
_WIDTHS = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)  # of the serial types below 10
_MAX_COLUMNS = 32
_MESSAGE = [int, int, bytes]
"""Types of the columns of a message after its number: topic, time and data."""
_LOCKS = 1 << 30
"""Place of the page that SQLite uses for locks only."""


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
        # Number of pages at the last commit; 0: unknown.
        self.committed = int.from_bytes(head[28:32], 'big') if head[24:28] == head[92:96] else 0
        self._locks = _LOCKS // self.size + 1 if self.valid else 0
        self._unused = int.from_bytes(head[36:40], 'big')
        # Ends of chains with nothing but zeros, as of a black picture.
        self._zero_ends: set[int] = set()

    def page(self, number: int) -> bytes:
        self._file.seek((number - 1) * self.size)
        return self._file.read(self.size)

    def erased(self) -> int:
        """Return the number of committed pages that hold nothing but zeros and should not.

        The ends of chains are known after their rows were read. SQLite clears pages that it does not
        use any more, and never writes the page of its locks.
        """
        zeros = bytes(self.size)
        numbers = range(1, min(self.count, self.committed) + 1)
        empty = sum(self.page(number) == zeros for number in numbers if number != self._locks)
        return max(0, empty - len(self._zero_ends) - self._unused)

    def rows(self, number: int) -> Iterator[tuple[int, list[Any] | None]]:
        """Yield number and values of the rows of a table's leaf page; None: a row cannot be read."""
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
        """Return the content of a cell, which may continue in a chain of overflow pages."""
        most, least = self.usable - 35, (self.usable - 12) * 32 // 255 - 23
        local = length
        if length > most:
            local = least + (length - least) % (self.usable - 4)
            local = local if local <= most else least
        parts = [page[at : at + local]]
        missing = length - len(parts[0])
        following = page[at + local : at + local + 4] if local < length else b''
        seen: set[int] = set()
        number, more = 0, b''
        while missing > 0 and len(parts[0]) == local:
            number = int.from_bytes(following, 'big')
            if not 1 < number <= self.count or number in seen:
                raise ValueError('the chain of pages is incomplete or a cycle')
            seen.add(number)
            more = self.page(number)
            # Before a commit, pages may exist without their content.
            if number > self.committed and not any(more):
                raise ValueError('a page of the chain was never written')
            parts.append(more[4 : min(self.usable, 4 + missing)])
            missing -= len(parts[-1])
            following = more[:4]
        if missing or any(following):
            raise ValueError(f'{length} bytes expected, {missing} are missing')
        if number and not any(more):
            self._zero_ends.add(number)
        return b''.join(parts)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for place in range(at, at + 8):
        value = value << 7 | data[place] & 0x7F
        if data[place] < 0x80:
            return value, place + 1
    return value << 8 | data[at + 8], at + 9


def _values(record: bytes) -> list[Any]:
    """Return the values of a row, or raise ValueError or IndexError if it is invalid."""
    body, at = _varint(record, 0)
    place = body
    values: list[Any] = []
    while at < body:
        kind, at = _varint(record, at)
        if kind in (10, 11) or len(values) == _MAX_COLUMNS:
            raise ValueError(f'invalid serial type, or too many columns: {kind}')
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


def read_sqlite(file: BinaryIO, note: Note, doubt: Note) -> Iterator[Found]:
    """Yield what is in an SQLite file of rosbag2 (sqlite.org/fileformat2.html), as `read_mcap`.

    It is read by its leaf pages, since the tree above them may be missing or out of date. So rows are
    found, in their order, that were written but not committed.
    """
    doubt('SQLite has no checksums, so altered messages cannot be noticed')
    pages = _Pages(file)
    if not pages.valid:
        note(f'its {pages.bytes} bytes are not the start of an SQLite database')
        return
    topics: dict[int, list[Any]] = {}
    definitions: dict[str, str] = {}
    starts: list[tuple[int, int]] = []
    for number in range(1, pages.count + 1):
        for row, values in pages.rows(number):
            if not values or values[0] is not None:
                continue
            kinds = [type(value) for value in values[1:]]
            if kinds == _MESSAGE:
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
            # There may be older copies of pages.
            if values and [type(value) for value in values[1:]] == _MESSAGE and last < row < limit:
                yield Message(*values[1:])
                last, read = row, read + 1
    if last > read:
        note(f'{last - read} of its first {last} messages cannot be read')
    if erased := pages.erased():
        note(f'{erased} of its {pages.committed} pages are empty: what was in them is lost')
    if missing := max(pages.committed * pages.size - pages.bytes, pages.bytes % pages.size):
        note(f'it is cut off: {missing} bytes are missing or are not a complete page')
