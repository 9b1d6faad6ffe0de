"""Bags made from what was recorded: rosbag2's version 9, MCAP or SQLite, through rosbags."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin, Writer

from diffdrive_jacobian.bags.journal import Channel, Message, Record, Text
from diffdrive_jacobian.bags.qos import to_rosbags

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}


@dataclass(frozen=True, kw_only=True, slots=True)
class Summary:
    """What a bag holds."""

    messages: int
    topics: dict[str, int]
    """Messages by topic."""
    start: int | None
    """Stamp of the first message (ns); None: there is none."""
    end: int | None
    """Stamp of the last one (ns)."""


def build_bag(records: Callable[[], Iterable[Record]], target: Path, storage: str) -> Summary:
    """Write records into a new bag, which appears whole or not at all.

    Args:
        records: Gives them, from the beginning with each call.
        target: The bag's directory; it must not exist.
        storage: `mcap` or `sqlite3`.

    Raises:
        FileExistsError: `target` exists.
        OSError: It cannot be written; nothing is left of it.
    """
    if target.exists():
        raise FileExistsError(f'{target} exists already')
    channels = {record.id: record for record in records() if isinstance(record, Channel)}
    workshop = target.parent / f'.{target.name}.building'
    shutil.rmtree(workshop, ignore_errors=True)
    try:
        # In a directory of the final name, for rosbags names the files after it.
        summary = _write(records(), channels, workshop / target.name, storage)
        for path in (workshop / target.name).iterdir():
            _sync(path)
        _sync(workshop / target.name)
        os.rename(workshop / target.name, target)
        _sync(target.parent)
    finally:
        shutil.rmtree(workshop, ignore_errors=True)
    return summary


def _write(records: Iterable[Record], channels: dict[int, Channel], path: Path, storage: str) -> Summary:
    writer = Writer(path, version=9, storage_plugin=STORAGES[storage])
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
        topics = {channel.topic: 0 for channel in channels.values()}
        start = end = None
        for record in records:
            if isinstance(record, Text):
                writer.set_custom_data(record.key, record.value)
            elif isinstance(record, Message):
                writer.write(connections[record.channel], record.stamp, record.data)
                topics[channels[record.channel].topic] += 1
                start = record.stamp if start is None else min(start, record.stamp)
                end = record.stamp if end is None else max(end, record.stamp)
        writer.close()
    except BaseException as error:
        with suppress(Exception):
            # What it cannot write now it cannot write then.
            writer.abort()
        if isinstance(error, sqlite3.Error):
            raise OSError(errno.EIO, str(error)) from error
        raise
    return Summary(messages=sum(topics.values()), topics=topics, start=start, end=end)


def _sync(path: Path) -> None:
    """Wait until a file or a directory is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
