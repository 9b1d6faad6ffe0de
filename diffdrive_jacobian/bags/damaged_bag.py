"""Reading of what is left of a damaged bag or a journal: topics, messages and custom data."""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from rosbags.interfaces import Qos
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from diffdrive_jacobian.bags.bag_reader import MetadataError, parse_parameters
from diffdrive_jacobian.bags.corrected_reader import UNPACK_ERRORS, zstd
from diffdrive_jacobian.bags.files import (
    ZSTD,
    NotARegularFileError,
    bag_files,
    check_regular,
    file_kind,
)
from diffdrive_jacobian.bags.journal import (
    PARAMETERS,
    Channel,
    Message,
    Record,
    Text,
)
from diffdrive_jacobian.bags.message_definitions import (
    Definition,
    UnknownTypeError,
    definition,
    known_definition,
)
from diffdrive_jacobian.bags.salvage import Topic, read_mcap, read_sqlite
from diffdrive_jacobian.safe_yaml import YAML_ERRORS, load_yaml
from diffdrive_jacobian.text import printable

_PARSE_ERRORS = (TypesysError, LookupError, ValueError, AssertionError, RecursionError)
BLOCK = 1 << 20
"""Size of the parts in which a file is decompressed (bytes)."""
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
LAST_ENCAPSULATION = 0x0B
"""Of CDR, in the second byte of a message; the first one is 0."""


def definition_and_hash(topic: Topic) -> tuple[str, str]:
    """Return the definition of a topic's type, and the definition's hash (RIHS01).

    Raises:
        UnknownTypeError: The file lacks one of them, and the type is not known.
    """
    known: Definition | None = None
    try:
        known = _known(topic.type_name)
        reason = f'{topic.type_name} is installed in another version than it was recorded'
    except UnknownTypeError as error:
        reason = str(error)
    # Where the hashes are the same, the text in the file may be damaged, or differ in comments.
    if known is not None and (
        topic.type_hash == known.type_hash
        or (not topic.type_hash and topic.definition in ('', known.text))
    ):
        return known.text, known.type_hash
    if topic.definition and topic.type_hash:
        return topic.definition, topic.type_hash
    if not topic.definition:
        raise UnknownTypeError(reason)
    try:
        return topic.definition, _hash(topic.definition, topic.type_name)
    except _PARSE_ERRORS as error:
        raise UnknownTypeError(reason) from error


def _known(type_name: str) -> Definition:
    """Return the definition of an installed type, or of one that is known without ROS."""
    try:
        return definition(type_name)
    except UnknownTypeError:
        with suppress(UnknownTypeError):
            return known_definition(type_name)
        raise


def _hash(text: str, type_name: str) -> str:
    """Return the hash of a definition.

    It is only parsed. rosbags' `register` would generate code from it and execute that.
    """
    store = get_typestore(Stores.EMPTY)
    store.fielddefs.update(get_types_from_msg(text, type_name))
    return store.hash_rihs01(type_name)


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
        self.lost: list[str] = []
        """Descriptions of what could not be read. This and the next two are complete after all records
        were read."""
        self.unchecked: list[str] = []
        """What cannot be checked, so that losses would not be noticed."""
        self.left_out: dict[str, str] = {}
        """Topics that cannot be written, and the reasons."""
        folder = path if path.is_dir() else path.parent
        self._metadata, self._problem = _metadata(folder / 'metadata.yaml')
        listed = _listed(self._metadata)
        self._missing = listed - {file.name for file in files}
        if path.is_file() and (self._missing or not listed):
            self._metadata, self._missing = {}, set()
        self.message_count = self._metadata.get('message_count')
        """Number of messages according to metadata.yaml; None: it has none."""
        self._sources = [(file.name, _unpacked(file, scratch)) for file in files]

    @property
    def losses(self) -> list[str]:
        """Descriptions of what could not be read or written."""
        left_out = [f'{topic} is left out: {why}' for topic, why in self.left_out.items()]
        return [*self.lost, *left_out]

    def records(self) -> Iterator[Record]:
        """Yield all that can be read, from the beginning, and describe what cannot in `lost`."""
        self.lost = [self._missing_file(name) for name in sorted(self._missing)]
        self.lost += [f'metadata.yaml: {self._problem}'] if self._problem else []
        self.unchecked, self.left_out = [], {}
        self._seen: Counter[str] = Counter()
        for text in _custom_data(self._metadata):
            yield from self._text(text)
        channels: dict[tuple[str, str], Channel] = {}
        self._copy: dict[str, Any] = {}
        self._hashes: dict[tuple[str, str], str] = {}
        self._times: list[tuple[int, int, str]] = []
        """Of the first and the last message of each file, and its name."""
        for name, source in self._sources:
            yield from self._of_file(name, source, channels)
        self._compare_counts()
        self._compare_descriptions()

    def _compare_counts(self) -> None:
        """Compare the messages that were found with metadata.yaml, or with its copy in the file."""
        source, metadata = 'metadata.yaml', self._metadata
        if not isinstance(self.message_count, int):
            source, metadata = 'the copy of metadata.yaml', self._copy
            if not len(self._sources) == len(_listed(metadata)) == 1:
                # The copies in several files count what was written before them.
                metadata = {}
        if self.path.is_dir() and not (metadata is self._metadata and _listed(metadata)):
            self.unchecked.append(
                'there is no valid metadata.yaml, so files that are missing, or of another recording, '
                'cannot be noticed'
            )
            # The parts of one recording follow one another.
            self.unchecked += [
                f'{second} begins before {first} ends: they may be of two recordings, or the same '
                'messages twice'
                for (_, end, first), (start, _, second) in pairwise(sorted(self._times))
                if start < end
            ]
        seen, counts = self._seen, Counter[str]()
        for described, number in _described_topics(metadata):
            if isinstance(number, int):
                counts[str(described.get('name'))] += number
        count = metadata.get('message_count')
        pairs = [(count, seen.total())] if isinstance(count, int) else []
        pairs += [(number, seen[topic]) for topic, number in counts.items()]
        if any(number != found for number, found in pairs):
            topics = ', '.join(
                f'{printable(topic)} {seen[topic]} of {number}'
                for topic, number in counts.items()
                if number != seen[topic]
            )
            difference = f'{source} counts {count} messages, {seen.total()} were found'
            difference += f' ({topics})' if topics else ''
            fewer = any(number > found for number, found in pairs)
            (self.lost if fewer else self.unchecked).append(difference)

    def _compare_descriptions(self) -> None:
        """Compare metadata.yaml with the topics in the files, and with its copy there."""
        described = _type_hashes(self._metadata)
        found = _type_hashes(self._copy) | self._hashes
        differing = [
            f'type hash of {topic}'
            for (topic, kind), text in described.items()
            if found.get((topic, kind), text) != text
        ]
        custom = {text.key: text.value for text in _custom_data(self._metadata)}
        copied = _custom_data(self._copy) if self._metadata else ()
        differing += [text.key for text in copied if custom.get(text.key) != text.value]
        if differing:
            what = printable(', '.join(differing), 300)
            self.lost.append(f'metadata.yaml differs from the data file, from which is saved: {what}')

    def _missing_file(self, name: str) -> str:
        """Describe a file that metadata.yaml lists and that cannot be read."""
        try:
            check_regular(self.path / name)
        except NotARegularFileError as error:
            return str(error)
        except (OSError, ValueError):
            pass
        return f'{name} is missing'

    def _text(self, text: Text) -> Iterator[Text]:
        """Yield custom data, unless no reader would accept it."""
        try:
            if text.key.startswith(PARAMETERS):
                parse_parameters(text.key, text.value)
        except MetadataError as error:
            if (loss := f'{error}: left out') not in self.lost:
                self.lost.append(loss)
            return
        yield text

    def _of_file(
        self, name: str, source: Path, channels: dict[tuple[str, str], Channel]
    ) -> Iterator[Record]:
        ids: dict[int, int | None] = {}
        names: dict[int, str] = {}
        faults: Counter[str] = Counter()
        start, end = 2**63, -1
        with open(source, 'rb') as file:
            reader = partial(read_mcap, file)
            if file_kind(source) == 'sqlite3':
                reader = partial(read_sqlite, source)
            for one in reader(
                lambda what: self.lost.append(f'{name}: {what}'),
                lambda what: self.unchecked.append(f'{name}: {what}'),
            ):
                if isinstance(one, str):
                    metadata, problem = _metadata(one)
                    self._copy = metadata or self._copy
                    self.lost += [f'{name}: {problem}'] if problem else []
                    for text in _custom_data(metadata):
                        yield from self._text(text)
                elif isinstance(one, Text):
                    yield from self._text(one)
                elif isinstance(one, Topic):
                    known = channels.get((one.name, one.type_name))
                    channel = self._channel(one, channels)
                    ids[one.id] = None if channel is None else channel.id
                    names[one.id] = one.name
                    if one.type_hash:
                        self._hashes[one.name, one.type_name] = one.type_hash
                    if channel is not None and channel != known:
                        yield channel
                else:
                    self._seen[names.get(one.channel, '')] += 1
                    if one.channel not in ids:
                        faults['belong to no known topic'] += 1
                    elif (to := ids[one.channel]) is not None:
                        data = _payload(one.data)
                        if data is None or not 0 <= one.stamp < 2**63:
                            faults['are not CDR or have an invalid time'] += 1
                        else:
                            start, end = min(start, one.stamp), max(end, one.stamp)
                            yield Message(to, one.stamp, data)
        self._times += [(start, end, name)] if end >= 0 else []
        self.lost += [f'{name}: {count} messages {what}' for what, count in faults.items()]

    def _channel(self, topic: Topic, channels: dict[tuple[str, str], Channel]) -> Channel | None:
        """Return a topic's channel, with all profiles so far; None: it is left out."""
        key = topic.name, topic.type_name
        if key not in channels and topic.name not in self.left_out:
            try:
                if not topic.name or not topic.type_name:
                    raise UnknownTypeError('it has no name or no type')
                if topic.encoding != 'cdr':
                    raise UnknownTypeError(f'its messages are {topic.encoding!r}, only cdr can be saved')
                text, type_hash = definition_and_hash(topic)
            except UnknownTypeError as error:
                self.left_out[topic.name] = str(error)
                return None
            channels[key] = Channel(
                id=len(channels),
                topic=topic.name,
                type_name=topic.type_name,
                definition=text,
                type_hash=type_hash,
            )
        if (channel := channels.get(key)) is not None:
            profiles = [one for one in _profiles(topic.qos) if one not in channel.qos]
            channels[key] = replace(channel, qos=(*channel.qos, *profiles))
        return channels.get(key)


def _unpacked(file: Path, scratch: Path) -> Path:
    """Return the file, or a copy: of one that is compressed, or of SQLite, which may change it."""
    copy = Path(tempfile.mkdtemp(dir=scratch)) / file.name.removesuffix(ZSTD)
    if file.suffix == ZSTD:
        # If it is cut off, what was decompressed is read; the reader reports the rest.
        with suppress(*UNPACK_ERRORS), zstd.open(file, 'rb') as packed, open(copy, 'wb') as out:
            while block := packed.read(BLOCK):
                out.write(block)
        return copy
    if file_kind(file) == 'sqlite3':
        for ending in ('', '-wal', '-journal'):
            with suppress(FileNotFoundError):
                shutil.copyfile(f'{file}{ending}', f'{copy}{ending}')
        return copy
    return file


def _metadata(source: Path | str) -> tuple[dict[str, Any], str]:
    """Return the content of metadata.yaml or of its text, {} if it is missing or damaged.

    And the reason if it was not read at all.
    """
    try:
        if isinstance(source, Path):
            check_regular(source)
        found = load_yaml(source, aliases=True)
    except NotARegularFileError as error:
        return {}, str(error)
    except (FileNotFoundError, *YAML_ERRORS):
        return {}, ''
    found = found.get('rosbag2_bagfile_information', found) if isinstance(found, dict) else {}
    return (found if isinstance(found, dict) else {}), ''


def _listed(metadata: dict[str, Any]) -> set[str]:
    """Return the names of the data files that metadata.yaml lists."""
    paths = metadata.get('relative_file_paths')
    return {Path(str(name)).name for name in paths} if isinstance(paths, list) else set()


def _described_topics(metadata: dict[str, Any]) -> Iterator[tuple[dict[str, Any], Any]]:
    """Yield the description of each topic in metadata.yaml, and its number of messages."""
    topics = metadata.get('topics_with_message_count')
    for topic in topics if isinstance(topics, list) else ():
        described = topic.get('topic_metadata') if isinstance(topic, dict) else None
        if isinstance(described, dict):
            yield described, topic.get('message_count')


def _type_hashes(metadata: dict[str, Any]) -> dict[tuple[str, str], str]:
    """Return the hashes of types in metadata.yaml by name and type of the topic."""
    topics = _described_topics(metadata)
    hashes = ((one, one.get('type_description_hash')) for one, _ in topics)
    return {(str(one.get('name')), str(one.get('type'))): str(text) for one, text in hashes if text}


def _custom_data(metadata: dict[str, Any]) -> Iterator[Text]:
    custom = metadata.get('custom_data')
    for key, value in custom.items() if isinstance(custom, dict) else ():
        # Damaged text may contain surrogates, which no file can hold.
        yield Text(*(str(one).encode('utf-8', 'replace').decode() for one in (key, value)))


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
