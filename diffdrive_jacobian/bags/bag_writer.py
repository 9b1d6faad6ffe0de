"""Writing of bags from the records of a journal: rosbag2 version 9, MCAP or SQLite."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin

from diffdrive_jacobian.bags.journal import Channel, Message, Record, Text
from diffdrive_jacobian.bags.qos import to_rosbags
from diffdrive_jacobian.bags.storage import BagReader, BagWriter

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
_SUM = (1 << 64) - 1


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


def check_target(target: Path) -> None:
    """Check that a bag can have this path, before anything is recorded for it.

    Raises:
        FileExistsError: It exists, possibly as a broken symbolic link.
        OSError: Its name is not UTF-8, as metadata.yaml must be.
    """
    if os.path.lexists(target):
        raise FileExistsError(f'{target} exists already')
    try:
        target.name.encode()
    except UnicodeEncodeError:
        raise OSError(errno.EILSEQ, f'the name of a bag must be UTF-8, got {target.name!a}') from None


def build_bag(records: Callable[[], Iterable[Record]], target: Path, storage: str) -> Summary:
    """Write records to a new bag, and give it its name after it was read back.

    Args:
        records: Returns all records, with each call from the beginning.
        target: The bag's directory; it must not exist.
        storage: `mcap` or `sqlite3`.

    Raises:
        FileExistsError: `target` exists.
        OSError: It cannot be written, or is not read back as it was written. It is removed then.
    """
    check_target(target)
    channels = {record.id: record for record in records() if isinstance(record, Channel)}
    scratch = Path(tempfile.mkdtemp(prefix=f'.{target.name[:40]}.building-', dir=target.parent))
    try:
        # The directory has the final name, after which rosbags names the files.
        bag = scratch / target.name
        summary, written = _write(records(), channels, bag, storage)
        if _contents(bag) != written:
            raise OSError(errno.EIO, 'what was read back from it is not what was written to it')
        for path in bag.iterdir():
            _sync(path)
        _sync(bag)
        # Renaming would replace an empty directory that was created meanwhile.
        check_target(target)
        os.rename(bag, target)
        _sync(target.parent)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return summary


@dataclass(slots=True)
class Content:
    """Counts and checksums of messages by topic, which do not depend on the order."""

    counts: Counter[str] = field(default_factory=Counter)
    checksums: Counter[str] = field(default_factory=Counter)

    def add(self, topic: str, stamp: int, data: bytes | memoryview) -> None:
        """Count a message and add its checksum to that of its topic."""
        self.counts[topic] += 1
        self.checksums[topic] += (zlib.crc32(data) * 0x9E3779B97F4A7C15 + stamp) & _SUM


def _write(
    records: Iterable[Record], channels: dict[int, Channel], path: Path, storage: str
) -> tuple[Summary, Content]:
    writer = BagWriter(path, version=9, storage_plugin=STORAGES[storage])
    content = Content()
    try:
        writer.open()
        connections = {
            channel.id: writer.add_connection(
                channel.topic,
                channel.type_name,
                msgdef=channel.definition,
                rihs01=channel.type_hash,
                offered_qos_profiles=[to_rosbags(fields) for fields in channel.qos],
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
    except BaseException as error:
        with suppress(Exception):
            # Closing would fail for the same reason as writing.
            writer.abort()
        if isinstance(error, sqlite3.Error):
            raise OSError(errno.EIO, str(error)) from error
        raise
    topics = {channel.topic: content.counts[channel.topic] for channel in channels.values()}
    return Summary(messages=sum(topics.values()), topics=topics, start=start, end=end), content


def _contents(path: Path) -> Content:
    """Read a whole bag.

    Raises:
        OSError: It cannot be read.
    """
    content = Content()
    reader = BagReader(path)
    try:
        reader.open()
        try:
            for connection, stamp, data in reader.messages(reader.connections):
                content.add(connection.topic, stamp, data)
        finally:
            reader.close()
    except Exception as error:  # whatever the parsers of a wrong file raise
        raise OSError(errno.EIO, f'it cannot be read back: {error!r}') from error
    return content


def _sync(path: Path) -> None:
    """Wait until a file or a directory is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
