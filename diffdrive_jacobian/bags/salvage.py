"""Messages of damaged MCAP and SQLite files: all that are complete."""

from __future__ import annotations

import os
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Chunk,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    Schema,
    Statistics,
)
from mcap.records import Channel as McapChannel
from mcap.records import Message as McapMessage

from diffdrive_jacobian.bags.corrected_reader import UNPACK_ERRORS, unpack
from diffdrive_jacobian.bags.files import MCAP_MAGIC, file_checksum
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

_OPCODES = frozenset(Opcode)
_INVALID = (EndOfFile, ValueError, struct.error)
"""What is raised for an invalid record."""
_HEAD = struct.Struct('<BQ')
"""Before the fields of a record: its opcode and their length."""
_RECORDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: McapChannel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
"""The records that are read besides messages."""


class _Fields(ReadDataStream):
    """The fields of a record. One that ends behind the record is an error; the library cuts it off."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


class _McapFile:
    """Reads an MCAP file, and compares what is found with the checksums and counts in it."""

    def __init__(self, file: BinaryIO, note: Note, doubt: Note) -> None:
        self._file = file
        self._note, self._doubt = note, doubt
        self._schemas: dict[int, Schema] = {}
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
        if self._file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            self._note(f'its {size} bytes are not the start of an MCAP file')
            return
        good, opcode = len(MCAP_MAGIC), 0
        # Where a record is invalid, the position of the next one is unknown.
        with suppress(*_INVALID):
            for opcode, payload, end in _walk(self._file, size):
                if opcode == Opcode.CHUNK:
                    yield from self._chunk(payload, end > size)
                elif end <= size:
                    record = _parsed(opcode, payload)
                    yield from self._record(record, checked=False)
                    self._check(record, opcode, payload, end)
                if end <= size:
                    good = end
        self._file.seek(good)
        if good == size and opcode != Opcode.FOOTER:
            self._doubt('it has no end: what its writer had not written yet is not in it')
        elif opcode != Opcode.FOOTER or self._file.read(len(MCAP_MAGIC) + 1) != MCAP_MAGIC:
            lost = f'the last {size - good} of its {size} bytes are not a complete record'
            self._note(f'it is cut off: {lost}')
        self._finish()

    def _chunk(self, payload: bytes, cut: bool) -> Iterator[Found]:
        try:
            # The library reads what there is of a chunk that is cut off.
            chunk = Chunk.read(ReadDataStream(BytesIO(payload)))
            data = unpack(chunk.compression, chunk.data, chunk.uncompressed_size)
        except (*UNPACK_ERRORS, *_INVALID) as error:
            why = str(error) or 'it is too short'
            self._note(f'a chunk of {len(payload)} bytes cannot be unpacked: {why}')
            return
        size, checksum = chunk.uncompressed_size, chunk.uncompressed_crc
        right = len(data) == size and checksum in (0, zlib.crc32(data))
        if not cut and not right:
            seconds = (chunk.message_end_time - chunk.message_start_time) / NANOSECONDS
            what = f'a chunk of {size} bytes ({seconds:.1f} s)'
            self._note(f'{what} is damaged: its messages may be altered')
        good = 0
        with suppress(*_INVALID):
            for opcode, record, ending in _walk(BytesIO(data), len(data)):
                if ending <= len(data):
                    yield from self._record(_parsed(opcode, record), checked=checksum != 0)
                    good = ending
        if good < len(data) and not cut:
            lost = f'the last {len(data) - good} of the {size} bytes of a chunk'
            self._note(f'{lost} are not complete records')

    def _record(self, record: McapRecord | None, *, checked: bool) -> Iterator[Found]:
        """Yield what is in a complete record; `checked`: it is in a chunk with a checksum."""
        if isinstance(record, McapMessage):
            self._found[record.channel_id] += 1
            self._behind += not self._in_data
            self._last = max(self._last, record.sequence)
            self._unchecked |= self._in_data and not checked
            yield Message(record.channel_id, record.log_time, record.data, record.sequence)
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, McapChannel):
            schema = self._schemas.get(record.schema_id)
            topic = Topic(
                record.id,
                record.topic,
                schema.name if schema else '',
                record.message_encoding,
                record.metadata.get('offered_qos_profiles', ''),
                record.metadata.get('topic_type_hash', ''),
                schema.data.decode() if schema else '',
            )
            self._differing += self._topics.setdefault(record.id, topic) != topic
            self._unchecked |= self._in_data and not checked
            yield topic
        elif isinstance(record, Attachment):
            if record.media_type == CUSTOM_DATA:
                yield Text(record.name, record.data.decode())
        elif isinstance(record, Metadata) and record.name == 'rosbag2':
            yield record.metadata.get('serialized_metadata', '')

    def _check(self, record: McapRecord | None, opcode: int, payload: bytes, end: int) -> None:
        """Take the counts and checksums from a record of the file."""
        start = end - len(payload) - _HEAD.size
        if self._numbered and self._in_data and opcode not in (Opcode.ATTACHMENT, Opcode.DATA_END):
            self._note(f'a record has the opcode {opcode}, which is none of a journal')
        if isinstance(record, Statistics):
            self._counts = record.channel_message_counts
        elif isinstance(record, Header):
            self._numbered |= record.library == LIBRARY
        elif opcode == Opcode.ATTACHMENT:
            if payload[-4:] not in (bytes(4), _checksum(payload[:-4])):
                self._note(f'an attachment of {len(payload)} bytes is damaged: it is left out')
        elif isinstance(record, DataEnd):
            self._in_data = False
            self._checksums['data section'] = 0, start, record.data_section_crc
        elif isinstance(record, Footer):
            self._checksums['summary'] = record.summary_start or start, end - 4, record.summary_crc

    def _finish(self) -> None:
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
    while end <= size and opcode != Opcode.FOOTER and (head := file.read(_HEAD.size)):
        if head[0] not in _OPCODES:
            waiting = [] if opcode == Opcode.MESSAGE else waiting
            break
        yield from waiting
        waiting = []
        if len(head) < _HEAD.size:
            break
        opcode, length = _HEAD.unpack(head)
        end += _HEAD.size + length
        waiting = [(opcode, file.read(min(length, size - file.tell())), end)]
    yield from waiting


def _parsed(opcode: int, payload: bytes) -> McapRecord | None:
    """Parse a complete record; None: it is of a kind that is not read, or an altered attachment.

    Raises:
        EndOfFile, ValueError: It is invalid.
    """
    fields = _Fields(BytesIO(payload))
    record: McapRecord | None = None
    if opcode == Opcode.MESSAGE:
        record = McapMessage.read(fields, len(payload))
    elif opcode == Opcode.ATTACHMENT and payload[-4:] != _checksum(payload[:-4]):
        pass
    elif kind := _RECORDS.get(opcode):
        record = kind.read(fields)
    return record


def _checksum(content: bytes) -> bytes:
    return zlib.crc32(content).to_bytes(4, 'little')


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
