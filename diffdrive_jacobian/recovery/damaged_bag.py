"""What a crash, a full disk or a cut has left of a bag, as the records of a journal."""

from __future__ import annotations

import re
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from rosbags.interfaces import QosTime
from rosbags.rosbag2 import ReaderError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from diffdrive_jacobian.bags.bag_writer import STORAGES
from diffdrive_jacobian.bags.bounded_reader import parse_bounded_qos
from diffdrive_jacobian.bags.journal import (
    JOURNAL,
    MAGIC,
    PARAMETERS,
    Channel,
    Message,
    Record,
    Text,
    journal_of,
    read_journal,
)
from diffdrive_jacobian.bags.limits import (
    UNPACK_ERRORS,
    Budget,
    unpack_file,
    unpack_message,
)
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, definition
from diffdrive_jacobian.bags.metadata import DamagedError, parse_parameters
from diffdrive_jacobian.bags.qos import to_rosbags
from diffdrive_jacobian.bounded_yaml import YAML_ERRORS, TooLargeError, load_yaml
from diffdrive_jacobian.recovery.salvage_mcap import MCAP_MAGIC, Topic, read_mcap
from diffdrive_jacobian.recovery.salvage_sqlite import SQLITE_MAGIC, read_sqlite
from diffdrive_jacobian.time_units import NANOSECONDS

KINDS = {'.mcap': 'mcap', '.db3': 'sqlite3', JOURNAL: 'journal'}
READERS = {'mcap': read_mcap, 'sqlite3': read_sqlite}
ZSTD, ZSTD_MAGIC = '.zstd', b'\x28\xb5\x2f\xfd'
MAX_DEFINITION = 200_000
"""Length of the longest definition of a type that is parsed; those of ROS have less than a tenth."""
LAST_ENCAPSULATION = 0x0B
"""Of CDR, in the second byte of a message; the first one is 0."""
MAGICS = {MCAP_MAGIC: 'mcap', SQLITE_MAGIC: 'sqlite3', MAGIC: 'journal'}


class NotABagError(Exception):
    """What was given cannot be one."""


class Remains:
    """What is left of a bag, as records."""

    def __init__(self, path: Path, workshop: Path) -> None:
        """Look what is there.

        Args:
            path: A bag's directory, one of its files, or a journal.
            workshop: An empty directory for what has to be unpacked.

        Raises:
            NotABagError: Nothing of a bag is there.
            OSError: It cannot be read.
        """
        self.path = path
        self.files = _files(path)
        self.kind = _kind(self.files[0])
        self.storage = 'mcap' if self.kind == 'journal' else self.kind
        self.lost: list[str] = []
        self.left_out: dict[str, str] = {}
        folder = path if path.is_dir() else path.parent
        self._metadata, self._problem = _metadata(folder / 'metadata.yaml')
        paths = self._metadata.get('relative_file_paths')
        listed = {Path(str(name)).name for name in paths} if isinstance(paths, list) else set()
        self._missing = listed - {file.name for file in self.files}
        if path.is_file() and (self._missing or not listed):
            self._metadata, self._missing = {}, set()
        self.promised = self._metadata.get('message_count')
        self._sources = [(file.name, _unpacked(file, workshop)) for file in self.files]

    @property
    def losses(self) -> list[str]:
        """What could not be read or written, in words."""
        left_out = [f'{topic} is left out: {why}' for topic, why in self.left_out.items()]
        return [*self.lost, *left_out]

    def records(self) -> Iterator[Record]:
        """Give all that can be read, from the beginning, and note what cannot."""
        self.lost = [f'{name} is missing' for name in sorted(self._missing)]
        self.lost += [f'metadata.yaml: {self._problem}'] if self._problem else []
        self.left_out, self._seen = {}, 0
        if self.kind == 'journal':
            if unread := (yield from self._of_journal()):
                self.lost.append(f'{self.path.name} breaks off: its last {unread} bytes hold no record')
            return
        for text in _custom_data(self._metadata):
            yield from self._text(text)
        channels: dict[tuple[str, str], Channel] = {}
        for name, source in self._sources:
            yield from self._of_file(name, source, channels)
        if isinstance(self.promised, int) and self.promised > self._seen:
            self.lost.append(f'metadata.yaml tells of {self.promised} messages, {self._seen} were found')

    def _of_journal(self) -> Generator[Record, None, int]:
        invalid: list[str] = []
        budget = Budget(self.path.stat().st_size)
        records = read_journal(self.path, invalid.append)
        channels: dict[tuple[str, str], Channel] = {}
        ids: dict[int, tuple[tuple[str, str], int | None]] = {}
        strange: Counter[str] = Counter()
        while True:
            try:
                record = next(records)
            except StopIteration as end:
                if invalid:
                    strange[f'records are invalid, the first: {invalid[0]}'] = len(invalid)
                self.lost += [f'{self.path.name}: {count} {what}' for what, count in strange.items()]
                return int(end.value)
            if isinstance(record, Text):
                if record.key == 'storage' and record.value in STORAGES:
                    self.storage = record.value
                yield from self._text(record)
            elif isinstance(record, Channel):
                key = record.topic, record.type_name
                if ids.setdefault(record.id, (key, None))[0] != key:
                    strange['descriptions of a topic have the number of another one'] += 1
                elif (channel := self._of_journal_channel(record, channels)) is not None:
                    ids[record.id] = key, channel.id
                    yield channel
            elif record.channel not in ids:
                strange['messages belong to no known topic'] += 1
            elif not 0 <= record.stamp < 2**63 or _payload(record.data, budget) is None:
                strange['messages are no CDR, or have no possible time'] += 1
            elif (to := ids[record.channel][1]) is not None:
                yield replace(record, channel=to)

    def _of_journal_channel(
        self, channel: Channel, channels: dict[tuple[str, str], Channel]
    ) -> Channel | None:
        """Return a topic as it is to be written, with all profiles so far; None: it is left out."""
        topic = Topic(
            channel.id,
            channel.topic,
            channel.type_name,
            'cdr',
            '',
            channel.type_hash,
            channel.definition,
        )
        known = self._channel(topic, channels)
        if known is None:
            return None
        profiles = [one for one in channel.qos if _is_profile(one) and one not in known.qos]
        key = channel.topic, channel.type_name
        channels[key] = replace(known, qos=(*known.qos, *profiles))
        return channels[key]

    def _text(self, text: Text) -> Iterator[Text]:
        """Yield custom data, unless no reader would accept it."""
        try:
            if text.key.startswith(PARAMETERS):
                parse_parameters(text.key, text.value)
        except DamagedError as error:
            if (loss := f'{error}: left out') not in self.lost:
                self.lost.append(loss)
            return
        yield text

    def _of_file(
        self, name: str, source: Path, channels: dict[tuple[str, str], Channel]
    ) -> Iterator[Record]:
        ids: dict[int, int | None] = {}
        strange: Counter[str] = Counter()
        budget = Budget(source.stat().st_size)
        with open(source, 'rb') as file:
            reader = READERS[_kind(source)]
            for one in reader(file, lambda what: self.lost.append(f'{name}: {what}')):
                if isinstance(one, str):
                    metadata, problem = _metadata(one)
                    self.lost += [f'{name}: {problem}'] if problem else []
                    for text in _custom_data(metadata):
                        yield from self._text(text)
                    continue
                if isinstance(one, Topic):
                    new = (one.name, one.type_name) not in channels
                    channel = self._channel(one, channels)
                    ids[one.id] = None if channel is None else channel.id
                    if channel is not None and new:
                        yield channel
                    continue
                self._seen += 1
                if one.channel not in ids:
                    strange['belong to no known topic'] += 1
                elif (to := ids[one.channel]) is not None:
                    data = _payload(one.data, budget)
                    if data is None or not 0 <= one.stamp < 2**63:
                        strange['are not CDR, are too large, or have no possible time'] += 1
                    else:
                        yield Message(to, one.stamp, data)
        self.lost += [f'{name}: {count} messages {what}' for what, count in strange.items()]

    def _channel(self, topic: Topic, channels: dict[tuple[str, str], Channel]) -> Channel | None:
        """Give a topic's channel; None: it has to be left out."""
        key = topic.name, topic.type_name
        if key not in channels and topic.name not in self.left_out:
            try:
                if not topic.name or not topic.type_name:
                    raise UnknownTypeError('it has no name or no type')
                if topic.encoding != 'cdr':
                    raise UnknownTypeError(f'its messages are {topic.encoding!r}, only cdr can be saved')
                text, type_hash = _described(topic)
            except UnknownTypeError as error:
                self.left_out[topic.name] = str(error)
                return None
            channels[key] = Channel(
                id=len(channels),
                topic=topic.name,
                type_name=topic.type_name,
                definition=text,
                type_hash=type_hash,
                qos=_qos(topic.qos),
            )
        return channels.get(key)


def is_recoverable(path: Path) -> bool:
    """Return whether a file or a folder holds something that may be left of a bag."""
    try:
        _files(path)
    except (NotABagError, OSError):
        return False
    return True


def _files(path: Path) -> list[Path]:
    """Give the files of a bag in their order."""
    if path.is_file():
        if not _kind(path):
            raise NotABagError(f'{path} is neither MCAP nor SQLite nor a journal of record_run')
        return [path]
    if not path.is_dir():
        raise NotABagError(f'there is no bag {path}, and no journal {journal_of(path)}')
    present = set(path.iterdir())
    # What was being compressed is there twice.
    files = [one for one in present if one.is_file() and one.with_suffix('') not in present - {one}]
    files = [one for one in files if _kind(one) in READERS]
    if not files:
        what = 'holds neither .mcap nor .db3 files' if present else 'is an empty folder'
        raise NotABagError(f'{path} {what}: it is not a bag')
    # Parts are numbered: 10 comes after 9.
    return sorted(
        files, key=lambda one: [int(n) if n.isdigit() else n for n in re.split('([0-9]+)', one.name)]
    )


def _kind(path: Path) -> str:
    """Tell what a file is, by its first bytes, or, as these may be damaged, by its name."""
    with open(path, 'rb') as file:
        begin = file.read(len(SQLITE_MAGIC))
    for magic, kind in MAGICS.items():
        if begin.startswith(magic):
            return kind
    name = path.with_suffix('') if path.suffix == ZSTD else path
    return KINDS.get(name.suffix, '')


def _unpacked(file: Path, workshop: Path) -> Path:
    """Give a file that can be read: itself, or a copy that is not compressed, or has its log in it."""
    copy = Path(tempfile.mkdtemp(dir=workshop)) / file.name.removesuffix(ZSTD)
    log = file.with_name(f'{file.name}-wal')
    if file.suffix == ZSTD:
        try:
            with open(copy, 'wb') as out:
                unpack_file(file, out)
        except TooLargeError as error:
            raise NotABagError(str(error)) from error
        except UNPACK_ERRORS:
            # As far as it goes; the reader sees that it breaks off.
            pass
        return copy
    if log.exists() and log.stat().st_size:
        size = file.stat().st_size + log.stat().st_size
        shutil.copyfile(file, copy)
        shutil.copyfile(log, copy.with_name(log.name))
        with suppress(sqlite3.Error), closing(sqlite3.connect(copy)) as database:
            database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        # A log can name any page: pages without end would follow, none of them in either file.
        return copy if copy.stat().st_size <= size else file
    return file


def _metadata(source: Path | str) -> tuple[dict[str, Any], str]:
    """Read what metadata.yaml holds, or its text in a bag's file.

    Returns:
        The content, empty if it is missing or damaged, and why it was not read if it is too large.
    """
    try:
        found = load_yaml(source)
    except TooLargeError as error:
        return {}, str(error)
    except (FileNotFoundError, *YAML_ERRORS):
        return {}, ''
    found = found.get('rosbag2_bagfile_information', found) if isinstance(found, dict) else {}
    return (found if isinstance(found, dict) else {}), ''


def _custom_data(metadata: dict[str, Any]) -> Iterator[Text]:
    custom = metadata.get('custom_data')
    for key, value in custom.items() if isinstance(custom, dict) else ():
        # In damaged text there may be what no file can hold.
        yield Text(*(str(one).encode('utf-8', 'replace').decode() for one in (key, value)))


def _payload(data: bytes, budget: Budget) -> bytes | None:
    """Return a message as CDR, or None if it is not CDR or unpacks to more than is read."""
    if data.startswith(ZSTD_MAGIC):
        try:
            data = unpack_message(data)
            budget.spend(len(data))
        except UNPACK_ERRORS:
            return None
    return data if len(data) > 4 and data[0] == 0 and data[1] <= LAST_ENCAPSULATION else None


def _described(topic: Topic) -> tuple[str, str]:
    """Give the definition of a topic's type and its hash.

    Raises:
        UnknownTypeError: The file does not tell them, and no installed package does.
    """
    try:
        installed = definition(topic.type_name)
        if topic.type_hash == installed.type_hash:
            # Its text may be damaged, or differ in comments.
            return installed.text, installed.type_hash
        if topic.definition and topic.type_hash:
            return topic.definition, topic.type_hash
        if topic.definition in ('', installed.text) and topic.type_hash in ('', installed.type_hash):
            return installed.text, installed.type_hash
        reason = f'{topic.type_name} is installed in another version than it was recorded'
    except UnknownTypeError as error:
        if topic.definition and topic.type_hash:
            return topic.definition, topic.type_hash
        reason = str(error)
    if not topic.definition:
        raise UnknownTypeError(reason)
    if len(topic.definition) > MAX_DEFINITION:
        raise UnknownTypeError(
            f'{reason}, and its definition has {len(topic.definition)} characters; at most '
            f'{MAX_DEFINITION} are parsed'
        )
    try:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(topic.definition, topic.type_name))
        return topic.definition, store.hash_rihs01(topic.type_name)
    except (TypesysError, KeyError) as error:
        raise UnknownTypeError(reason) from error


def _qos(text: str) -> tuple[dict[str, Any], ...]:
    """Read offered profiles as rosbag2 writes them; (): they cannot be read."""
    try:
        return tuple(
            {
                'history': one.history.value,
                'depth': int(one.depth),
                'reliability': one.reliability.value,
                'durability': one.durability.value,
                'deadline': _nanoseconds(one.deadline),
                'lifespan': _nanoseconds(one.lifespan),
                'liveliness': one.liveliness.value,
                'liveliness_lease_duration': _nanoseconds(one.liveliness_lease_duration),
            }
            for one in parse_bounded_qos(text)
        )
    except (ReaderError, LookupError, TypeError, ValueError, AttributeError, *YAML_ERRORS):
        return ()


def _is_profile(fields: dict[str, Any]) -> bool:
    """Return whether a bag can hold a profile of a journal."""
    try:
        to_rosbags(fields)
    except (KeyError, ValueError):
        return False
    return all(0 <= value < 2**63 for value in fields.values())


def _nanoseconds(time: QosTime) -> int:
    return NANOSECONDS * int(time.sec) + int(time.nsec)
