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

"""What is left of a damaged bag or a journal: one loop over its records, and what it found missing."""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

from rosbags.interfaces import Qos
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from diffdrive_jacobian.bags.bag_reader import MetadataError, parse_parameters
from diffdrive_jacobian.bags.corrected_reader import UNPACK_ERRORS, zstd
from diffdrive_jacobian.bags.files import (
    ZSTD,
    NotARegularFileError,
    bag_files,
    check_regular,
    file_kind,
)
from diffdrive_jacobian.bags.journal import PARAMETERS, Channel, Message, Record, Text
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, definition_and_hash
from diffdrive_jacobian.bags.metadata import Metadata
from diffdrive_jacobian.bags.salvage import Found, Topic, read_mcap, read_sqlite
from diffdrive_jacobian.safe_yaml import YAML_ERRORS
from diffdrive_jacobian.text import printable

BLOCK = 1 << 20
"""Size of the parts in which a file is decompressed (bytes)."""
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
LAST_ENCAPSULATION = 0x0B
"""Of CDR, in the second byte of a message; the first one is 0."""
Key = tuple[str, str]
"""Name and type of a topic."""


@dataclass(slots=True)
class Findings:
    """What was found besides the records, complete once all of them were read."""

    lost: list[str] = field(default_factory=list)
    """Descriptions of what could not be read."""
    unchecked: list[str] = field(default_factory=list)
    """What cannot be checked, so that losses would not be noticed."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Topics that cannot be written, and the reasons."""
    seen: Counter[str] = field(default_factory=Counter)
    """Messages by topic."""
    hashes: dict[Key, str] = field(default_factory=dict)
    """Hashes of types in the data files."""
    times: list[tuple[int, int, str]] = field(default_factory=list)
    """Of the first and the last message of each file, and its name."""
    channels: dict[Key, Channel] = field(default_factory=dict)
    """The topics, each with all its profiles so far."""
    copy: Metadata = field(default_factory=Metadata)
    """The last copy of metadata.yaml in a data file."""

    @property
    def losses(self) -> list[str]:
        """Descriptions of what could not be read or written."""
        left_out = [f'{printable(topic)} is left out: {why}' for topic, why in self.left_out.items()]
        return [*self.lost, *left_out]


class DamagedBag:
    """What is left of a bag, as records."""

    def __init__(self, path: Path, scratch: Path) -> None:
        """Find the files, and decompress those that are compressed.

        Args:
            path: A bag's directory, one of its files, or a journal.
            scratch: An empty directory for decompressed files.

        Raises:
            NotABagError: There is nothing of a bag.
            OSError: It cannot be read.
        """
        self.path = path
        files = bag_files(path)
        self.metadata = Metadata.read((path if path.is_dir() else path.parent) / 'metadata.yaml')
        listed = self.metadata.files
        self._missing = listed - {file.name for file in files}
        if path.is_file() and (self._missing or not listed):
            # It describes another bag than this file.
            self.metadata, self._missing = Metadata(problem=self.metadata.problem), set()
        self._sources = [(file.name, _readable(file, scratch)) for file in files]
        self.found = Findings()

    def records(self) -> Iterator[Record]:
        """Yield all that can be read, from the beginning; `found` says what cannot."""
        self.found = found = Findings()
        found.lost += [self._missing_file(name) for name in sorted(self._missing)]
        found.lost += [f'metadata.yaml: {self.metadata.problem}'] if self.metadata.problem else []
        yield from self._texts(self.metadata.custom_data)
        for name, source in self._sources:
            yield from self._of_file(name, source)
        self._compare_counts()
        self._compare_descriptions()

    def _missing_file(self, name: str) -> str:
        """Describe a file that metadata.yaml lists and that cannot be read."""
        with suppress(OSError, ValueError):
            try:
                check_regular(self.path / name)
            except NotARegularFileError as error:
                return str(error)
        return f'{name} is missing'

    def _texts(self, texts: list[Text]) -> Iterator[Text]:
        """Yield custom data, but none that no reader would accept."""
        for text in texts:
            try:
                if text.key.startswith(PARAMETERS):
                    parse_parameters(text.key, text.value)
                yield text
            except MetadataError as error:
                if (loss := f'{error}: left out') not in self.found.lost:
                    self.found.lost.append(loss)

    # --- One data file

    def _of_file(self, name: str, source: Path) -> Iterator[Record]:
        found = self.found
        topics: dict[int, Topic] = {}
        faults: Counter[str] = Counter()
        start, end = 2**63, -1
        for one in self._contents(name, source):
            if isinstance(one, str):
                copy = Metadata.read(one)
                found.copy = copy if copy.content else found.copy
                yield from self._texts(copy.custom_data)
            elif isinstance(one, Text):
                yield from self._texts([one])
            elif isinstance(one, Topic):
                topics[one.id] = one
                if one.type_hash:
                    found.hashes[one.name, one.type_name] = one.type_hash
                yield from self._channel(one)
            else:
                topic = topics.get(one.channel)
                found.seen[topic.name if topic else ''] += 1
                if topic is None:
                    faults['belong to no known topic'] += 1
                elif channel := found.channels.get((topic.name, topic.type_name)):
                    data = _payload(one.data)
                    if data is None or not 0 <= one.stamp < 2**63:
                        faults['are not CDR or have an invalid time'] += 1
                        continue
                    start, end = min(start, one.stamp), max(end, one.stamp)
                    yield Message(channel.id, one.stamp, data)
        found.times += [(start, end, name)] if end >= 0 else []
        found.lost += [f'{name}: {count} messages {what}' for what, count in faults.items()]

    def _contents(self, name: str, source: Path) -> Iterator[Found]:
        def lost(what: str) -> None:
            self.found.lost.append(f'{name}: {what}')

        def unchecked(what: str) -> None:
            self.found.unchecked.append(f'{name}: {what}')

        if file_kind(source) == 'sqlite3':
            yield from read_sqlite(source, lost, unchecked)
        else:
            with open(source, 'rb') as file:
                yield from read_mcap(file, lost, unchecked)

    def _channel(self, topic: Topic) -> Iterator[Channel]:
        """Yield a topic's channel, with all profiles so far, if it is new or has new ones."""
        channels, key = self.found.channels, (topic.name, topic.type_name)
        before = channels.get(key)
        if before is None:
            if topic.name in self.found.left_out:
                return
            try:
                if not topic.name or not topic.type_name:
                    raise UnknownTypeError('it has no name or no type')
                if topic.encoding != 'cdr':
                    raise UnknownTypeError(f'its messages are {topic.encoding!r}, only cdr can be saved')
                text, type_hash = definition_and_hash(topic.type_name, topic.definition, topic.type_hash)
            except UnknownTypeError as error:
                self.found.left_out[topic.name] = str(error)
                return
            channel = Channel(
                id=len(channels),
                topic=topic.name,
                type_name=topic.type_name,
                definition=text,
                type_hash=type_hash,
            )
        else:
            channel = before
        profiles = [one for one in _profiles(topic.qos) if one not in channel.qos]
        channels[key] = channel = replace(channel, qos=(*channel.qos, *profiles))
        if channel != before:
            yield channel

    # --- What metadata.yaml says

    def _compare_counts(self) -> None:
        """Compare the messages that were found with metadata.yaml, or with its copy in the file."""
        found, source, metadata = self.found, 'metadata.yaml', self.metadata
        if metadata.message_count is None:
            source, metadata = 'the copy of metadata.yaml', found.copy
            if not len(self._sources) == len(metadata.files) == 1:
                # The copies in several files count what was written before them.
                metadata = Metadata()
        if self.path.is_dir() and not (metadata is self.metadata and metadata.files):
            found.unchecked.append(
                'there is no valid metadata.yaml, so files that are missing, or of another recording, '
                'cannot be noticed'
            )
            # The parts of one recording follow one another.
            found.unchecked += [
                f'{second} begins before {first} ends: they may be of two recordings, or the same '
                'messages twice'
                for (_, end, first), (start, _, second) in pairwise(sorted(found.times))
                if start < end
            ]
        self._compare_with(source, metadata)

    def _compare_with(self, source: str, metadata: Metadata) -> None:
        seen, count = self.found.seen, metadata.message_count
        differing = {
            topic: number for topic, number in metadata.topic_counts.items() if number != seen[topic]
        }
        total = seen.total()
        if not differing and count in (None, total):
            return
        topics = ', '.join(
            f'{printable(topic)} {seen[topic]} of {number}' for topic, number in differing.items()
        )
        difference = f'{source} counts {count} messages, {total} were found'
        difference += f' ({topics})' if topics else ''
        fewer = (count or 0) > total or any(number > seen[topic] for topic, number in differing.items())
        (self.found.lost if fewer else self.found.unchecked).append(difference)

    def _compare_descriptions(self) -> None:
        """Compare metadata.yaml with the topics in the files, and with its copy there."""
        found, metadata = self.found, self.metadata
        hashes = found.copy.type_hashes | found.hashes
        differing = [
            f'type hash of {topic}'
            for (topic, kind), text in metadata.type_hashes.items()
            if hashes.get((topic, kind), text) != text
        ]
        custom = {text.key: text.value for text in metadata.custom_data}
        copied = found.copy.custom_data if metadata.content else ()
        differing += [text.key for text in copied if custom.get(text.key) != text.value]
        if differing:
            what = printable(', '.join(differing), 300)
            found.lost.append(f'metadata.yaml differs from the data file, from which is saved: {what}')


def _readable(file: Path, scratch: Path) -> Path:
    """Return the file, or a copy: of one that is compressed, or of SQLite, which may change it."""
    copy = Path(tempfile.mkdtemp(dir=scratch)) / file.name.removesuffix(ZSTD)
    if file.suffix == ZSTD:
        # If it is cut off, what was decompressed is read; the reader reports the rest.
        with suppress(*UNPACK_ERRORS), zstd.open(file, 'rb') as packed, open(copy, 'wb') as out:
            for block in iter(partial(packed.read, BLOCK), b''):
                out.write(block)
        return copy
    if file_kind(file) == 'sqlite3':
        for ending in ('', '-wal', '-journal'):
            with suppress(FileNotFoundError):
                shutil.copyfile(f'{file}{ending}', f'{copy}{ending}')
        return copy
    return file


def _payload(data: bytes) -> bytes | None:
    """Return a message as CDR; None: it is not CDR, or cannot be unpacked."""
    if data.startswith(ZSTD_MAGIC):
        try:
            data = zstd.decompress(data)
        except UNPACK_ERRORS:
            return None
    return data if len(data) > 4 and data[0] == 0 and data[1] <= LAST_ENCAPSULATION else None


def _profiles(text: str) -> list[Qos]:
    """Return the offered profiles in the text of rosbag2 that are valid."""
    try:
        profiles = parse_qos(text)
    except (ReaderError, LookupError, TypeError, ValueError, AttributeError, *YAML_ERRORS):
        return []
    return [
        one._replace(avoid_ros_namespace_conventions=False)
        for one in profiles
        if all(
            type(number) is int and 0 <= number < 2**63
            for number in (one.depth, *one.deadline, *one.lifespan, *one.liveliness_lease_duration)
        )
    ]
