"""Messages of damaged MCAP and SQLite files: all that are complete."""

from __future__ import annotations

import os
import sqlite3
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from diffdrive_jacobian.bags import mcap
from diffdrive_jacobian.bags.corrected_reader import UNPACK_ERRORS, unpack
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

_MESSAGE = [int, int, int, bytes]
"""Types of the columns of a message: its number, topic, time and data."""


def read_sqlite(path: Path, note: Note, doubt: Note) -> Iterator[Found]:
    """Yield what is in an SQLite file of rosbag2, up to the row that SQLite refuses; as `read_mcap`.

    Args:
        path: A copy of the file, with its `-wal` and `-journal`. SQLite may change it.
        note: As of `read_mcap`.
        doubt: As of `read_mcap`.
    """
    doubt('SQLite has no checksums, so altered messages cannot be noticed')
    last = read = 0
    with closing(sqlite3.connect(path)) as database:

        def rows(query: str) -> Iterator[Any]:
            """Yield the rows up to the one that SQLite refuses."""
            try:
                yield from database.execute(query)
            # The names of damaged columns may be no text.
            except (sqlite3.Error, UnicodeDecodeError) as error:
                refusal = f'SQLite refuses the rest: {error}'
                note(f'{refusal}; it may be had with `sqlite3 {path.name} .recover`')

        database.text_factory = lambda data: data.decode(errors='replace')
        # SQLite refuses all of a file that is cut off, or fills its last page up with zeros.
        for _ in rows('PRAGMA writable_schema = ON'):
            pass
        for (page,) in rows('PRAGMA page_size'):
            os.truncate(path, path.stat().st_size // page * page)
        tables = {name for (name,) in rows('SELECT name FROM sqlite_master')}
        if 'metadata' in tables:
            for (text,) in rows('SELECT metadata FROM metadata'):
                yield str(text)
        definitions: dict[str, str] = {}
        if 'message_definitions' in tables:
            columns = 'topic_type, encoded_message_definition'
            definitions.update(rows(f'SELECT {columns} FROM message_definitions'))
        for number, *texts in rows('SELECT * FROM topics'):
            # Older versions have no profiles and no hash.
            name, kind, encoding, qos, type_hash = [*map(str, texts), *5 * ['']][:5]
            definition = str(definitions.get(kind, ''))
            yield Topic(number, name, kind, encoding, qos, type_hash, definition)
        for number, *message in rows('SELECT rowid, topic_id, timestamp, data FROM messages'):
            if [type(value) for value in (number, *message)] == _MESSAGE:
                yield Message(*message)
                read += 1
            last = max(last, number)
        for (problem,) in rows('PRAGMA integrity_check(1)'):
            if problem != 'ok':
                note(f'SQLite finds it damaged: {" ".join(problem.split())}')
    if last > read:
        note(f'its messages have the numbers 1 to {last}, {read} were found')
