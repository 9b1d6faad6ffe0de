"""Journals: what a recorder has received, on the disk almost at once, readable up to the last record.

A bag is complete only when it is closed. A recorder that is killed loses its index, its metadata and up
to a whole chunk of messages. So messages are written to a journal first, in the order in which they were
received. The bag is written from it at the end, or by recover_run after a crash.

Layout: the magic, then records. A record has its kind (1 byte), the length of the payload (u32), its
CRC-32 (u32) and the payload, all little-endian. A record that was cut off or damaged ends the journal.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import struct
import tempfile
import threading
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.numerics.fields import Check, integer, sequence, short, text
from diffdrive_jacobian.text import printable

JOURNAL = '.journal'
"""Ends the name of a journal, after the name of the bag."""
PARAMETERS = 'parameters of '
"""Followed by a node's name, the key of the custom data that holds its parameters as JSON."""
LOST = 'messages lost'
"""Key of the custom data with the number of messages that are known to be missing, by topic, as JSON."""
LEFT_OUT = 'topics left out'
"""Key of the custom data with the reasons why topics were not recorded, by topic, as JSON."""
MAGIC = b'\x89ddjournal1\r\n\x1a\n'
_HEAD = struct.Struct('<cII')
_MESSAGE = struct.Struct('<Hq')
_CONNECTION, _DATA, _TEXT = b'C', b'M', b'T'
BLOCK = 8 << 20
"""Approximate number of bytes per write."""
OVERHEAD = 250
"""Approximate memory of a record without its payload (bytes)."""
_SURROGATE = re.compile('[\ud800-\udfff]')


def _unicode(name: str, value: Any) -> str:
    found: str = text(name, value)
    if _SURROGATE.search(found):
        raise ValueError(f'{name} must be valid Unicode, got {short(found, repr)}')
    return found


def _profiles(name: str, value: Any) -> tuple[dict[str, Any], ...]:
    for profile in sequence(name, value):
        if not isinstance(profile, dict) or not all(type(one) is int for one in profile.values()):
            raise ValueError(f'{name} must hold maps of integers, got {short(profile, repr)}')
    return tuple(value)


_TEXT_FIELDS: dict[str, Check] = {'key': _unicode, 'value': _unicode}
_CHANNEL_FIELDS: dict[str, Check] = {
    'id': partial(integer, low=0, high=2**16 - 1),
    'topic': _unicode,
    'type_name': _unicode,
    'definition': _unicode,
    'type_hash': _unicode,
    'qos': _profiles,
}


def journal_of(bag: Path) -> Path:
    """Return the path of a bag's journal, which exists while it is recorded and after a crash."""
    return bag.with_name(bag.name + JOURNAL)


class JournalError(DiffdriveError):
    """A file is not a journal, or a record in it is invalid."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Channel:
    """A topic as it was recorded."""

    id: int
    topic: str
    type_name: str
    definition: str
    type_hash: str
    qos: tuple[dict[str, Any], ...] = ()
    """The QoS profiles that its publishers offered, with the keys of rosbag2."""


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
        # The lock ends with the process, also if that is killed. Some file systems have no locks.
        with suppress(OSError):
            fcntl.flock(self._file, fcntl.LOCK_EX)
        self._lock = threading.Lock()
        self._pending = [MAGIC]
        self.waiting = len(MAGIC)
        """Memory held by records that are not yet written, or being written (bytes)."""
        self._written = 0
        self._synced = 0
        self._added = len(MAGIC)

    @property
    def size(self) -> int:
        """Bytes of all records so far, written or not."""
        return self._added

    def add(self, record: Record) -> None:
        """Append a record; it is written by `flush`."""
        if isinstance(record, Message):
            kind, payload = _DATA, record.data
            start = _MESSAGE.pack(record.channel, record.stamp)
        else:
            kind = _CONNECTION if isinstance(record, Channel) else _TEXT
            payload, start = json.dumps(asdict(record)).encode(), b''
        checksum = zlib.crc32(payload, zlib.crc32(start, ord(kind)))
        head = _HEAD.pack(kind, len(start) + len(payload), checksum) + start
        with self._lock:
            # The payload is kept as it is: large messages are not copied before they are written.
            self._pending += (head, payload)
            self._added += len(head) + len(payload)
            self.waiting += OVERHEAD + len(payload)

    def flush(self) -> None:
        """Write all records to the operating system, where they survive the end of the process.

        Raises:
            OSError: The disk is full or was removed. What was not written is dropped.
        """
        with self._lock:
            pending, self._pending = self._pending, []
            waiting = self.waiting
        try:
            for block in _blocks(pending):
                data = memoryview(block)
                while data:
                    written = os.write(self._file.fileno(), data)
                    self._written += written
                    data = data[written:]
        finally:
            with self._lock:
                self.waiting -= waiting

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

    def rescue(self) -> Path:
        """Return where a file that is not `in_place` was moved, or a copy of it if it was removed.

        The copy is in the directory of `path`, or in the nearest one above that still exists. It is
        complete when this returns.

        Raises:
            OSError: The copy cannot be written.
        """
        descriptor = self._file.fileno()
        with suppress(OSError):
            # Linux reports the present name.
            moved = Path(os.readlink(f'/proc/self/fd/{descriptor}'))
            if os.path.samestat(os.stat(moved), os.fstat(descriptor)):
                return moved
        path = Path(os.path.abspath(self.path))
        folders = (*path.parents, Path(tempfile.gettempdir()))
        folder = next(one for one in folders if one.is_dir() and os.access(one, os.W_OK))
        handle, name = tempfile.mkstemp(path.suffix, f'{path.stem[:50]}_rescued_', folder)
        with open(handle, 'wb') as copy:
            # The content of a removed file can still be read.
            while data := os.pread(descriptor, BLOCK, copy.tell()):
                copy.write(data)
            copy.flush()
            os.fsync(copy.fileno())
        return Path(name)

    def close(self) -> None:
        """Close the file; records that were not flushed are lost."""
        self._file.close()


def _blocks(pieces: list[bytes]) -> Iterator[bytes]:
    """Yield bytes joined to blocks of about BLOCK, since each write to a slow disk takes long."""
    block: list[bytes] = []
    size = 0
    for index, piece in enumerate(pieces):
        # The memory is freed while the rest is being written.
        pieces[index] = b''
        block.append(piece)
        size += len(piece)
        if size >= BLOCK:
            yield b''.join(block)
            block, size = [], 0
    if block:
        yield b''.join(block)


def is_being_written(path: Path) -> bool:
    """Return whether the process that writes a journal is still running, as far as it has a lock."""
    with open(path, 'rb') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            # The file system has no locks.
            return False
    return False


def read_journal(path: Path, note: Callable[[str], None] | None = None) -> Generator[Record, None, int]:
    """Read a journal up to its end, or to what was cut off or damaged.

    Args:
        path: The journal.
        note: Is called with a description of each record whose content is invalid although its checksum
            is right; the record is left out. By default it is an error.

    Returns:
        The records; the generator's value is how many bytes at the end could not be read.

    Raises:
        JournalError: The file is not a journal, or a record's content is invalid.
        OSError: It cannot be read.
    """
    with open(path, 'rb') as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(MAGIC)) != MAGIC:
            raise JournalError(f'{path} is not a journal of record_run')
        end = file.tell()
        while (raw := _read_record(file, size - end)) is not None:
            begin, end = end, file.tell()
            try:
                record = _parsed(*raw)
            except JournalError as error:
                if note is None:
                    raise JournalError(f'{path} is damaged at byte {begin}: {error}') from error
                note(f'the record at byte {begin} is invalid: {error}')
                continue
            yield record
        return size - end


def _read_record(file: BinaryIO, left: int) -> tuple[bytes, bytes] | None:
    """Return kind and payload of the next record; None: there is none, or it is damaged."""
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    kind, length, checksum = _HEAD.unpack(head)
    # Reading a damaged length could take gigabytes of memory.
    if kind not in (_CONNECTION, _DATA, _TEXT) or _HEAD.size + length > left:
        return None
    payload = file.read(length)
    if len(payload) < length or zlib.crc32(payload, ord(kind)) != checksum:
        return None
    if kind == _DATA and length < _MESSAGE.size:
        return None
    return kind, payload


def _parsed(kind: bytes, payload: bytes) -> Record:
    """Return a record.

    Raises:
        JournalError: The payload is not what `JournalWriter` writes.
    """
    if kind == _DATA:
        channel, stamp = _MESSAGE.unpack_from(payload)
        return Message(channel, stamp, payload[_MESSAGE.size :])
    try:
        content = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise JournalError(f'its content is not JSON: {printable(error)}') from error
    if kind == _TEXT:
        return Text(**_fields(content, _TEXT_FIELDS))
    return Channel(**_fields(content, _CHANNEL_FIELDS))


def _fields(content: object, checks: dict[str, Check]) -> dict[str, Any]:
    """Return a JSON object after a check of its fields.

    Raises:
        JournalError: It has other fields, or a field is invalid.
    """
    if not isinstance(content, dict) or content.keys() != checks.keys():
        raise JournalError(f'it must have the fields {", ".join(checks)}, got {short(content, repr)}')
    try:
        return {name: check(name, content[name]) for name, check in checks.items()}
    except ValueError as error:
        raise JournalError(str(error)) from error
