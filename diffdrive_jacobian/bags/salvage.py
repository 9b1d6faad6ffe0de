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


_IN_JOURNAL = {Opcode.ATTACHMENT, Opcode.DATA_END}
"""The records of a journal after its header and outside of its chunks."""


class _Fields(ReadDataStream):
    """The fields of a record. One that ends behind the record is an error; the library cuts it off."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


class _Claims:
    """What an MCAP file says of itself, and what was found in it: where they differ, that is lost."""

    def __init__(self) -> None:
        self.found: Counter[int] = Counter()
        """Messages by channel."""
        self._topics: dict[int, Topic] = {}
        self._counts: dict[int, int] | None = None
        # Only the last of each kind counts, so that each part of the file is read once.
        self._checksums: dict[str, tuple[int, int, int]] = {}
        self._is_journal = False
        self._last_number = self._behind = self._redescribed = 0
        self._in_data, self._unchecked = True, False

    def take(self, record: McapRecord | None, start: int, end: int) -> None:
        """Take the counts and checksums from a record between two places of the file."""
        if isinstance(record, Statistics):
            self._counts = record.channel_message_counts
        elif isinstance(record, Header):
            self._is_journal |= record.library == LIBRARY
        elif isinstance(record, DataEnd):
            self._in_data = False
            self._checksums['data section'] = 0, start, record.data_section_crc
        elif isinstance(record, Footer):
            self._checksums['summary'] = record.summary_start or start, end - 4, record.summary_crc

    def may_have(self, opcode: int) -> bool:
        """Return whether such a record may be outside of chunks: a journal has few kinds."""
        return not self._is_journal or not self._in_data or opcode in _IN_JOURNAL

    def has_checksum(self, attachment: bytes) -> bool:
        """Return whether an attachment has the right checksum, or none, as only others write it."""
        content, checksum = attachment[:-4], attachment[-4:]
        right = zlib.crc32(content).to_bytes(4, 'little')
        return checksum == right or (checksum == bytes(4) and not self._is_journal)

    def met_message(self, message: McapMessage, *, checked: bool) -> None:
        """Count a message. `checked`: it is in a chunk with a checksum."""
        self.found[message.channel_id] += 1
        self._behind += not self._in_data
        self._last_number = max(self._last_number, message.sequence)
        self._unchecked |= self._in_data and not checked

    def met_topic(self, topic: Topic, *, checked: bool) -> None:
        """Compare a description of a topic with the first one of the same number."""
        self._redescribed += self._topics.setdefault(topic.id, topic) != topic
        self._unchecked |= self._in_data and not checked

    def compare(self, file: BinaryIO, note: Note, doubt: Note) -> None:
        """Report what differs, and what cannot be checked, after all of the file was read."""
        data_is_right = False
        for what, (start, end, checksum) in self._checksums.items():
            right = checksum != 0 and file_checksum(file, start, end) == checksum
            if checksum and not right:
                note(f'the checksum of its {what} is wrong')
            data_is_right |= right and what == 'data section'
        if self._redescribed:
            note(f'{self._redescribed} descriptions of topics differ from earlier ones')
        if self._behind:
            note(f'{self._behind} of its messages are behind its data section')
        found, counts, last = self.found, self._counts, self._last_number
        if self._is_journal and last != found.total():
            note(f'its messages have the numbers 1 to {last}, {found.total()} were found')
        if counts is not None and any(counts.get(one, 0) != found[one] for one in {*counts, *found}):
            note(
                f'its statistics count {sum(counts.values())} messages, {found.total()} were found, '
                'or their topics differ'
            )
        if data_is_right:
            return
        if self._unchecked:
            doubt('it has no checksums of its messages, so altered ones cannot be noticed')
        elif counts is None and not self._is_journal:
            doubt('it has no count of its messages')


def read_mcap(file: BinaryIO, note: Note, doubt: Note) -> Iterator[Found]:
    """Yield what is in an MCAP file (mcap.dev/spec) up to its end, or where it is cut off or damaged.

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
    claims, schemas = _Claims(), dict[int, Schema]()
    good, opcode = len(MCAP_MAGIC), 0
    # Where a record is invalid, the position of the next one is unknown.
    with suppress(*_INVALID):
        for opcode, payload, end in _walk(file, size):
            if opcode == Opcode.CHUNK:
                yield from _in_chunk(payload, schemas, claims, note, cut=end > size)
            elif end <= size:
                record = _parsed(opcode, payload)
                if opcode == Opcode.ATTACHMENT and not claims.has_checksum(payload):
                    note(f'an attachment of {len(payload)} bytes is damaged: it is left out')
                    record = None
                yield from _contents(record, schemas, claims, checked=False)
                if not claims.may_have(opcode):
                    note(f'a record has the opcode {opcode}, which is none of a journal')
                claims.take(record, end - len(payload) - _HEAD.size, end)
            if end <= size:
                good = end
    file.seek(good)
    if good == size and opcode != Opcode.FOOTER:
        doubt('it has no end: what its writer had not written yet is not in it')
    elif opcode != Opcode.FOOTER or file.read(len(MCAP_MAGIC) + 1) != MCAP_MAGIC:
        note(f'it is cut off: the last {size - good} of its {size} bytes are not a complete record')
    claims.compare(file, note, doubt)


def _in_chunk(
    payload: bytes, schemas: dict[int, Schema], claims: _Claims, note: Note, *, cut: bool
) -> Iterator[Found]:
    """Yield what is in a chunk, which may be cut off, up to an invalid record."""
    try:
        # The library reads what there is of a chunk that is cut off.
        chunk = Chunk.read(ReadDataStream(BytesIO(payload)))
        data = unpack(chunk.compression, chunk.data, chunk.uncompressed_size)
    except (*UNPACK_ERRORS, *_INVALID) as error:
        why = str(error) or 'it is too short'
        note(f'a chunk of {len(payload)} bytes cannot be unpacked: {why}')
        return
    size, checksum = chunk.uncompressed_size, chunk.uncompressed_crc
    right = len(data) == size and checksum in (0, zlib.crc32(data))
    if not cut and not right:
        seconds = (chunk.message_end_time - chunk.message_start_time) / NANOSECONDS
        what = f'a chunk of {size} bytes ({seconds:.1f} s)'
        note(f'{what} is damaged: its messages may be altered')
    good = 0
    with suppress(*_INVALID):
        for opcode, record, end in _walk(BytesIO(data), len(data)):
            if end <= len(data):
                parsed = _parsed(opcode, record)
                yield from _contents(parsed, schemas, claims, checked=checksum != 0)
                good = end
    if good < len(data) and not cut:
        note(f'the last {len(data) - good} of the {size} bytes of a chunk are not complete records')


def _contents(
    record: McapRecord | None, schemas: dict[int, Schema], claims: _Claims, *, checked: bool
) -> Iterator[Found]:
    """Yield what is in a complete record."""
    if isinstance(record, McapMessage):
        claims.met_message(record, checked=checked)
        yield Message(record.channel_id, record.log_time, record.data)
    elif isinstance(record, Schema):
        schemas[record.id] = record
    elif isinstance(record, McapChannel):
        schema = schemas.get(record.schema_id)
        topic = Topic(
            record.id,
            record.topic,
            schema.name if schema else '',
            record.message_encoding,
            record.metadata.get('offered_qos_profiles', ''),
            record.metadata.get('topic_type_hash', ''),
            schema.data.decode() if schema else '',
        )
        claims.met_topic(topic, checked=checked)
        yield topic
    elif isinstance(record, Attachment):
        if record.media_type == CUSTOM_DATA:
            yield Text(record.name, record.data.decode())
    elif isinstance(record, Metadata) and record.name == 'rosbag2':
        yield record.metadata.get('serialized_metadata', '')


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
    """Parse a complete record; None: it is of a kind that is not read.

    Raises:
        EndOfFile, ValueError: It is invalid.
    """
    fields = _Fields(BytesIO(payload))
    record: McapRecord | None = None
    if opcode == Opcode.MESSAGE:
        record = McapMessage.read(fields, len(payload))
    elif kind := _RECORDS.get(opcode):
        record = kind.read(fields)
    return record


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
