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

"""Reading of bags by rosbags: their messages, parameters and noted losses, with errors of our own."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError

from diffdrive_jacobian.bags.corrected_reader import CorrectedReader
from diffdrive_jacobian.bags.files import NotARegularFileError, check_regular, is_recoverable, journal_of
from diffdrive_jacobian.bags.journal import LEFT_OUT, LOST, PARAMETERS
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.numerics.checks import short
from diffdrive_jacobian.text import PATH_LIMIT, printable


class BagError(DiffdriveError):
    """A bag cannot be read, or lacks what is needed; the message says which and what."""

    def __init__(self, message: str) -> None:
        """Escape control characters in the message: names in it may come from the bag."""
        super().__init__(printable(message, PATH_LIMIT))


class MetadataError(DiffdriveError, ValueError):
    """A value in a bag is invalid; the message says which, what it is, and what is allowed."""


class DamagedBagError(BagError):
    """A bag is damaged; the message also names the command that saves what can be read."""

    def __init__(self, path: Path, why: str) -> None:
        """Set the message from the bag and what is wrong with it."""
        super().__init__(f'{printable(path, PATH_LIMIT)} is damaged: {why}{_advice(path)}')
        self.why = why


def _advice(path: Path) -> str:
    """Return the command that saves the messages of a damaged bag, or '' if it has none."""
    return f' ({_command(path)} saves what can be read)' if is_recoverable(path) else ''


def _command(path: Path) -> str:
    return f'`recover_run {printable(shlex.quote(str(path)), PATH_LIMIT)}`'


# --- Opening


@contextmanager
def open_bag(path: Path) -> Iterator[Reader]:
    """Open a bag; `messages` reads it.

    Raises:
        BagError: There is none, or it is damaged.
    """
    name = printable(path, PATH_LIMIT)
    if not path.exists():
        if (journal := journal_of(path)).is_file():
            raise BagError(
                f'there is no bag {name}, but the journal of an interrupted recording: '
                f'{_command(journal)} makes the bag of it'
            )
        raise BagError(f'there is no bag {name}')
    if not path.is_dir() and not path.is_file():
        raise BagError(f'{name} is not a bag: it is not a regular file')
    if path.is_file() and not is_recoverable(path):
        raise BagError(f'{name} is not a bag: it is neither MCAP nor SQLite')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        what = 'an empty folder' if not any(path.iterdir()) else 'a folder without metadata.yaml'
        raise BagError(f'{name} is {what}, not a bag{_advice(path)}')
    try:
        for file in path.iterdir() if path.is_dir() else ():
            # To open a pipe would wait for ever.
            if not file.is_dir():
                check_regular(file)
        reader = CorrectedReader(path)
        reader.open()
    except (ReaderError, NotARegularFileError) as error:
        raise DamagedBagError(path, f'it cannot be read: {printable(error, 200)}') from error
    except Exception as error:  # whatever the parsers of a damaged file raise
        raise DamagedBagError(path, f'it cannot be read: {printable(repr(error), 200)}') from error
    try:
        try:
            custom_data(reader)
            _check_topics(reader.connections, stored_connections(reader))
        except MetadataError as error:
            raise DamagedBagError(path, str(error)) from error
        yield reader
    finally:
        reader.close()


def stored_connections(reader: Reader) -> list[Connection]:
    """Return the topics of an open bag as its data files describe them."""
    storages = getattr(reader.storage, 'storages', [reader.storage])
    return [connection for storage in storages for connection in storage.connections]


def _check_topics(described: Sequence[Connection], stored: Iterable[Connection]) -> None:
    """Check the topics of an open bag, as metadata.yaml describes them and as its data files do.

    rosbags reads a message only if both are the same, and skips all others silently.

    Raises:
        MetadataError: A topic's name or type is not text, or a topic with messages is not described.
    """
    stored = list(stored)
    for connection in [*described, *stored]:
        for what, value in (('name', connection.topic), ('type', connection.msgtype)):
            if not isinstance(value, str) or not value:
                got = short(value, repr)
                raise MetadataError(f'the {what} of a topic must be text that is not empty, got {got}')
    for connection in stored:
        if connection.msgcount and not any(_alike(connection, one) for one in described):
            raise MetadataError(
                f'metadata.yaml does not describe the topic {printable(connection.topic)} of '
                f'{printable(connection.msgtype)} as the data file does '
                '(name, type, type hash, QoS, serialization)'
            )


def _alike(stored: Connection, described: Connection) -> bool:
    """Return whether rosbags considers two topics the same."""
    if (stored.topic, stored.msgtype, stored.ext) != (described.topic, described.msgtype, described.ext):
        return False
    return not stored.digest or not described.digest or stored.digest == described.digest


# --- Custom data: parameters and losses


def custom_data(reader: Reader) -> dict[str, str]:
    """Return the custom data of an open bag.

    Raises:
        MetadataError: They are not a map of texts.
    """
    custom = reader.storage.metadata.custom or {}
    if not isinstance(custom, dict) or not all(
        isinstance(text, str) for text in (*custom.keys(), *custom.values())
    ):
        raise MetadataError(f'custom_data must be a map of texts, got {short(custom, repr)}')
    return custom


def parse_parameters(key: str, content: str) -> dict[str, Any]:
    """Return the parameters of a node from the key and the value of an entry of the custom data.

    Raises:
        MetadataError: It is not a JSON object.
    """
    try:
        values = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise MetadataError(f'the {printable(key)} are not JSON: {printable(error)}') from error
    if not isinstance(values, dict):
        raise MetadataError(
            f'the {printable(key)} must be a JSON object, got {printable(repr(content), 40)}'
        )
    return values


def lost_messages(custom: Mapping[str, str]) -> dict[str, int]:
    """Return how many messages of each topic a recorder noted as lost in the custom data."""
    noted = _noted(custom, LOST).items()
    return {topic: count for topic, count in noted if isinstance(count, int) and count > 0}


def noted_losses(custom: Mapping[str, str]) -> Iterator[str]:
    """Describe what was lost according to the notes of a recorder in the custom data."""
    for topic, why in sorted(_noted(custom, LEFT_OUT).items()):
        yield f'{printable(topic)} was not recorded: {printable(why)}'
    for topic, count in sorted(_noted(custom, LOST).items()):
        if count:
            yield f'{printable(count)} messages on {printable(topic)} while it was recorded'


def _noted(custom: Mapping[str, str], key: str) -> dict[str, Any]:
    try:
        noted = json.loads(custom.get(key, '{}'))
    except (ValueError, RecursionError):
        noted = None
    return noted if isinstance(noted, dict) else {'an unknown topic': custom[key]}


def recorded_parameters(reader: Reader) -> dict[str, dict[str, Any]]:
    """Return the parameters of the nodes at the beginning of a recording, by full name of the node.

    Raises:
        BagError: They are damaged.
    """
    try:
        return {
            key.removeprefix(PARAMETERS): parse_parameters(key, text)
            for key, text in custom_data(reader).items()
            if key.startswith(PARAMETERS)
        }
    except MetadataError as error:
        raise DamagedBagError(Path(str(reader.path)), str(error)) from error


def messages(
    reader: Reader, connections: Sequence[Connection], invalid: Counter[str] | None = None
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield the messages of some topics by the time of their recording.

    Args:
        reader: An open bag.
        connections: Some of its topics.
        invalid: Counts, by topic, the messages that have an invalid time or are not bytes, which is
            possible in SQLite. They are left out.

    Yields:
        Topic, time of recording (ns) and CDR of each message.

    Raises:
        BagError: The bag is damaged.
    """
    if not connections:
        # rosbags takes an empty list for all topics.
        return
    try:
        for connection, received, data in reader.messages(connections):
            if (
                isinstance(data, (bytes, memoryview))
                and isinstance(received, int)
                and 0 <= received < 2**63
            ):
                yield connection, received, bytes(data)
            elif invalid is not None:
                invalid[connection.topic] += 1
    except Exception as error:  # as in open_bag
        raise DamagedBagError(Path(str(reader.path)), printable(repr(error), 200)) from error


def find_damage(path: Path) -> str:
    """Read a bag completely and return what is wrong with it, or '' if nothing is or it is not a bag.

    Messages that cannot be decoded are not damage: readers skip them.
    """
    try:
        with open_bag(path) as reader:
            recorded_parameters(reader)
            invalid: Counter[str] = Counter()
            found = sum(1 for _ in messages(reader, reader.connections, invalid)) + invalid.total()
            if found != reader.message_count:
                return f'it should have {reader.message_count} messages, {found} can be read'
    except BagError as error:
        return error.why if isinstance(error, DamagedBagError) else ''
    return ''
