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

"""Writing of bags from the records of a journal: rosbag2 version 9, MCAP."""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter

from diffdrive_jacobian.bags.bag_reader import BagError, DamagedBagError, messages, open_bag
from diffdrive_jacobian.bags.corrected_reader import FOOTER
from diffdrive_jacobian.bags.files import (
    MCAP_MAGIC,
    REPLACED,
    file_checksum,
    is_journal,
    scratch_directory,
)
from diffdrive_jacobian.bags.journal import Channel, Message, Record, Text

if TYPE_CHECKING:
    from rosbags.rosbag2.writer import StorageWriter

_CHUNK_CHECKSUM = 9 + 3 * 8
"""Place of the checksum in the record of a chunk, after opcode, length, times and size."""
_DATA_END = 9 + 4
"""Size of the record that ends the data section and has its checksum."""
_BAG_SUFFIXES = ('.mcap', '.db3', '.zstd', '.db3-shm', '.db3-wal', '.db3-journal')
"""Endings of the files of a bag besides metadata.yaml."""
_SUM = (1 << 64) - 1


class _CheckedMcapWriter(McapWriter):
    """rosbags' writer, with checksums of chunks, data section and summary (mcap.dev/spec)."""

    def close_chunk(self) -> None:
        place = self.bio.tell() + _CHUNK_CHECKSUM
        checksum = zlib.crc32(self.chunk.bio.getbuffer())
        super().close_chunk()
        end = self.bio.tell()
        self.bio.seek(place)
        self.bio.write(struct.pack('<I', checksum))
        self.bio.seek(end)

    def close(self, version: int, metadata: str) -> None:
        super().close(version, metadata)
        with open(self.path, 'r+b') as file:
            footer = file.seek(-FOOTER.size - len(MCAP_MAGIC), 2)
            summary, *_ = FOOTER.unpack(file.read(FOOTER.size))
            self._write_checksum(file, 0, summary - _DATA_END, summary - 4)
            self._write_checksum(file, summary, footer + 16, footer + 16)

    @staticmethod
    def _write_checksum(file: BinaryIO, start: int, end: int, place: int) -> None:
        checksum = file_checksum(file, start, end)
        file.seek(place)
        file.write(struct.pack('<I', checksum))


class BagWriter(Writer):
    """rosbags' writer with these checksums."""

    STORAGE_PLUGINS: Mapping[StoragePlugin, type[StorageWriter]] = {
        StoragePlugin.MCAP: _CheckedMcapWriter
    }


@dataclass(frozen=True, kw_only=True, slots=True)
class Summary:
    """Content of a bag."""

    messages: int
    topics: dict[str, int]
    """Messages by topic."""
    start: int | None
    """Time of the first message (ns); None: there is none."""
    end: int | None
    """Time of the last message (ns)."""
    lost: dict[str, int] = field(default_factory=dict)
    """Messages that are known to be missing, by topic."""


def check_target(target: Path, *, replace: bool = False) -> None:
    """Check that a bag can have this path, before anything is recorded for it.

    Raises:
        FileExistsError: It exists, possibly as a broken symbolic link, and is not to be replaced or
            is not a bag.
        OSError: Its name is not UTF-8, as metadata.yaml must be.
    """
    if os.path.lexists(target):
        if not replace:
            raise FileExistsError(f'{target} exists already')
        if not _is_nothing_but_a_bag(target):
            raise FileExistsError(f'{target} exists already and is not a bag: it is not replaced')
    try:
        target.name.encode()
    except UnicodeEncodeError:
        raise OSError(errno.EILSEQ, f'the name of a bag must be UTF-8, got {target.name!a}') from None


def _is_nothing_but_a_bag(path: Path) -> bool:
    """Return whether a path is a directory with files of a bag only."""
    files = [] if path.is_symlink() or not path.is_dir() else list(path.iterdir())
    return bool(files) and all(
        file.is_file()
        and (file.name == 'metadata.yaml' or file.suffix in _BAG_SUFFIXES)
        and not is_journal(file)
        for file in files
    )


def build_bag(
    channels: Iterable[Channel],
    records: Iterable[Record],
    target: Path,
    *,
    replace: bool = False,
    compressed: bool = False,
) -> Summary:
    """Write records to a new bag, and give it its name after it was read back as readers do.

    Args:
        channels: The topics, each with all its profiles.
        records: The messages and the custom data. Channels among them are not used.
        target: The bag's directory.
        replace: Whether it may replace another bag, which stays until the new one is complete.
        compressed: Whether the chunks are compressed by zstd.

    Raises:
        OSError: As of `check_target`; or it cannot be written, or is not read back as it was written.
            It is removed then.
    """
    check_target(target, replace=replace)
    with scratch_directory(target) as scratch:
        # The directory has the final name, after which rosbags names the files.
        bag = scratch / target.name
        summary, written = _write(records, {one.id: one for one in channels}, bag, compressed)
        if _contents(bag) != written:
            raise OSError(errno.EIO, 'what was read back from it is not what was written to it')
        for path in bag.iterdir():
            _sync(path)
        _sync(bag)
        # Renaming would replace an empty directory that was created meanwhile.
        check_target(target, replace=replace)
        if replace and target.exists():
            old = scratch / REPLACED
            os.rename(target, old)
            try:
                os.rename(bag, target)
            except OSError:
                os.rename(old, target)
                raise
        else:
            os.rename(bag, target)
        _sync(target.parent)
    return summary


@dataclass(slots=True)
class _Content:
    """Counts and checksums of messages by topic, which do not depend on the order."""

    counts: Counter[str] = field(default_factory=Counter)
    checksums: Counter[str] = field(default_factory=Counter)

    def add(self, topic: str, stamp: int, data: bytes | memoryview) -> None:
        self.counts[topic] += 1
        self.checksums[topic] += (zlib.crc32(data) * 0x9E3779B97F4A7C15 + stamp) & _SUM


def _write(
    records: Iterable[Record], channels: dict[int, Channel], path: Path, compressed: bool
) -> tuple[Summary, _Content]:
    writer = BagWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if compressed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    content = _Content()
    try:
        writer.open()
        connections = {
            channel.id: writer.add_connection(
                channel.topic,
                channel.type_name,
                msgdef=channel.definition,
                rihs01=channel.type_hash,
                offered_qos_profiles=channel.qos,
            )
            for channel in channels.values()
        }
        start = end = None
        for record in records:
            if isinstance(record, Text):
                writer.set_custom_data(record.key, record.value)
            elif isinstance(record, Message):
                writer.write(connections[record.channel], record.stamp, record.data)
                content.add(channels[record.channel].topic, record.stamp, record.data)
                start = record.stamp if start is None else min(start, record.stamp)
                end = record.stamp if end is None else max(end, record.stamp)
        writer.close()
    except BaseException:
        with suppress(Exception):
            # Closing would fail for the same reason as writing.
            writer.abort()
        raise
    summary = Summary(
        messages=content.counts.total(),
        topics={channel.topic: content.counts[channel.topic] for channel in channels.values()},
        start=start,
        end=end,
    )
    return summary, content


def _contents(path: Path) -> _Content:
    """Read a whole bag as all readers do, or raise OSError."""
    content = _Content()
    try:
        with open_bag(path) as reader:
            for connection, stamp, data in messages(reader, reader.connections):
                content.add(connection.topic, stamp, data)
    except BagError as error:
        # The whole message would name a directory that is removed.
        why = error.why if isinstance(error, DamagedBagError) else str(error.__cause__ or error)
        raise OSError(errno.EIO, f'it cannot be read back: {why}') from error
    return content


def _sync(path: Path) -> None:
    """Wait until a file or a directory is on the disk, as far as its file system can."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network and FUSE file systems cannot do that with directories.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP) or not path.is_dir():
            raise
    finally:
        os.close(descriptor)
