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

"""Journals: what a recorder has received, on the disk almost at once, readable up to the last message.

A bag is complete only when it is closed. A recorder that is killed loses its index, its metadata and up
to a whole chunk of messages. So messages are written to a journal first, in the order in which they were
received. The bag is written from it at the end, or by recover_run after a crash.

A journal is an MCAP file without an end: it has no index. A chunk with a checksum is written several
times a second. Each message has its number, so that a gap is noticed. Custom data are in attachments,
which have checksums of their own.
"""

from __future__ import annotations

import os
import threading
import zlib
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, Chunk, Header, McapRecord, Schema
from mcap.records import Channel as McapChannel
from mcap.records import Message as McapMessage
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9
from ruamel.yaml import YAML

from diffdrive_jacobian.bags.files import MCAP_MAGIC
from diffdrive_jacobian.locks import lock

PARAMETERS = 'parameters of '
"""Followed by a node's name, the key of the custom data that holds its parameters as JSON."""
LOST = 'messages lost'
"""Key of the custom data with the number of messages that are known to be missing, by topic, as JSON."""
LEFT_OUT = 'topics left out'
"""Key of the custom data with the reasons why topics were not recorded, by topic, as JSON."""
LIBRARY = 'diffdrive_jacobian journal'
"""The writer of a journal, according to its header."""
CUSTOM_DATA = 'application/x-rosbag2-custom-data'
"""Media type of the attachments with custom data. Their names are the keys."""
BLOCK = 8 << 20
"""Approximate size of the largest chunk (bytes). A message that is larger has a chunk of its own."""
OVERHEAD = 250
"""Approximate memory of a record without its payload (bytes)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Channel:
    """A topic as it was recorded."""

    id: int
    topic: str
    type_name: str
    definition: str
    type_hash: str
    qos: tuple[Qos, ...] = ()
    """The distinct profiles that its publishers offered."""


@dataclass(frozen=True, slots=True)
class Message:
    """A message: its channel, when it was received (ns), and its CDR."""

    channel: int
    stamp: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Text:
    """An entry of the custom data; a later one replaces an earlier one with the same key."""

    key: str
    value: str


Record = Channel | Message | Text


class _Chunk:
    """Messages and descriptions of topics that are not written yet."""

    def __init__(self) -> None:
        self.records = RecordBuilder()
        self.start, self.end = 2**64 - 1, 0
        """Times of the first and the last message (ns)."""

    def pack(self) -> bytes:
        """Return the record."""
        data: bytes = self.records.end()
        return packed(
            Chunk(
                compression='',
                data=data,
                message_start_time=min(self.start, self.end),
                message_end_time=self.end,
                uncompressed_crc=zlib.crc32(data),
                uncompressed_size=len(data),
            )
        )


def packed(*records: McapRecord) -> bytes:
    """Return records of MCAP as they are in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()
    return data


def _topic(number: int, channel: Channel) -> bytes:
    """Return the records that describe a topic and its type."""
    profiles = StringIO()
    YAML(typ='safe').dump(dump_qos_v9(list(channel.qos)), profiles)
    extra = {'offered_qos_profiles': profiles.getvalue(), 'topic_type_hash': channel.type_hash}
    return packed(
        Schema(id=number, name=channel.type_name, encoding='ros2msg', data=channel.definition.encode()),
        McapChannel(
            id=number,
            schema_id=number,
            topic=channel.topic,
            message_encoding='cdr',
            metadata=extra,
        ),
    )


class JournalWriter:
    """Appends records to a new file. Records may be added in one thread and flushed in another."""

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            FileExistsError: It exists.
            OSError: It cannot be written.
        """
        self.path = path
        # Unbuffered: the buffer of `open` would raise again when it is closed after a failed write.
        self._file = open(path, 'x+b', buffering=0)  # noqa: SIM115
        lock(self._file, wait=True)
        self._lock = threading.Lock()
        # Records that cannot be in a chunk.
        self._records = [MCAP_MAGIC + packed(Header(profile='ros2', library=LIBRARY))]
        self._chunks = [_Chunk()]
        self._numbers: dict[int, int] = {}
        self._topics = self._messages = 0
        self.waiting = len(self._records[0])
        """Memory held by records that are not yet written, or being written (bytes)."""
        self._added = self.waiting
        self._frames = self._written = self._synced = 0

    @property
    def size(self) -> int:
        """Bytes of all records so far, written or not."""
        return self._added + self._frames

    def add(self, record: Record) -> None:
        """Append a record; it is written by `flush`.

        Raises:
            KeyError: The channel of a message was not added.
        """
        with self._lock:
            if isinstance(record, Message):
                channel, data, stamp = self._numbers[record.channel], record.data, record.stamp
                self._messages += 1
                chunk = self._chunk(len(data))
                before = chunk.records.count
                McapMessage(channel, stamp, data, stamp, self._messages).write(chunk.records)
                chunk.start, chunk.end = min(chunk.start, stamp), max(chunk.end, stamp)
                size = chunk.records.count - before
            elif isinstance(record, Channel):
                # With other profiles it is another channel of MCAP, of the same topic.
                self._topics += 1
                self._numbers[record.id] = self._topics
                described = _topic(self._topics, record)
                size = len(described)
                self._chunk(size).records.write(described)
            else:
                entry = Attachment(0, 0, record.key, CUSTOM_DATA, record.value.encode())
                self._records.append(packed(entry))
                size = len(self._records[-1])
            self._added += size
            self.waiting += OVERHEAD + size

    def _chunk(self, size: int) -> _Chunk:
        """Return the chunk of the next record, which has this size."""
        if self._chunks[-1].records.count >= BLOCK or size > BLOCK:
            self._chunks.append(_Chunk())
        return self._chunks[-1]

    def flush(self) -> None:
        """Write all records to the operating system, where they survive the end of the process.

        Raises:
            OSError: The disk is full or was removed. What was not written is dropped.
        """
        with self._lock:
            records, self._records = self._records, []
            chunks, self._chunks = self._chunks, [_Chunk()]
            waiting = self.waiting
        try:
            self._write(b''.join(records))
            # The memory of each is freed while the rest is being written.
            chunks.reverse()
            while chunks:
                chunk = chunks.pop()
                if size := chunk.records.count:
                    record = chunk.pack()
                    self._frames += len(record) - size
                    self._write(record)
        finally:
            with self._lock:
                self.waiting -= waiting

    def _write(self, content: bytes) -> None:
        data = memoryview(content)
        while data:
            written = os.write(self._file.fileno(), data)
            self._written += written
            data = data[written:]

    def sync(self) -> None:
        """Wait until all flushed records are on the disk, where they survive a power cut.

        Raises:
            OSError: The disk is full or was removed.
        """
        written = self._written
        if written > self._synced:
            os.fsync(self._file.fileno())
            self._synced = written

    def in_place(self) -> bool:
        """Return whether the file is still at `path`: not removed, renamed or replaced."""
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(self._file.fileno()))
        except OSError:
            return False

    def close(self) -> None:
        """Close the file; records that were not flushed are lost."""
        self._file.close()


def is_being_written(path: Path) -> bool:
    """Return whether the process that writes a journal is still running, as far as it has a lock."""
    with open(path, 'rb') as file:
        return lock(file, shared=True) is False
