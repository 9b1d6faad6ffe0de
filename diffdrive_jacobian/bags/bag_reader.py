"""Opening of bags of unknown origin, and their messages, custom data and recorded parameters."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bounded_reader import BoundedReader
from diffdrive_jacobian.bags.files import is_recoverable, journal_of
from diffdrive_jacobian.bags.journal import PARAMETERS
from diffdrive_jacobian.bags.metadata import (
    MetadataError,
    check_connections,
    check_custom_data,
    check_metadata,
    parse_parameters,
)
from diffdrive_jacobian.bounded_yaml import TooLargeError
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.text import PATH_LIMIT, printable


class BagError(DiffdriveError):
    """A bag cannot be read, or lacks what is needed; the message says which and what.

    The message is safe to print, although names in it may come from the bag.
    """

    def __init__(self, message: str) -> None:
        """Escape control characters in the message."""
        super().__init__(printable(message, PATH_LIMIT))


class ReadingInterruptedError(DiffdriveError):
    """The user does not want the result any more."""


class DamagedBagError(BagError):
    """A bag is damaged; the message also names the command that saves what can be read."""

    def __init__(self, path: Path, why: str) -> None:
        """Set the message.

        Args:
            path: The bag.
            why: What is wrong with it.
        """
        super().__init__(f'{printable(path, PATH_LIMIT)} is damaged: {why}{_advice(path)}')
        self.why = why


def _advice(path: Path) -> str:
    """Return the command that saves the messages of a damaged bag, or '' if it has none."""
    if not is_recoverable(path):
        return ''
    return f' ({_command(path)} saves what can be read)'


def _command(path: Path) -> str:
    return f'`recover_run {printable(shlex.quote(str(path)), PATH_LIMIT)}`'


@contextmanager
def open_bag(path: Path) -> Iterator[Reader]:
    """Open a bag; `messages` reads it.

    Raises:
        BagError: There is none, or it is damaged.
    """
    if not path.exists():
        if (journal := journal_of(path)).is_file():
            raise BagError(
                f'there is no bag {printable(path, PATH_LIMIT)}, but the journal of an interrupted '
                f'recording: {_command(journal)} makes the bag of it'
            )
        raise BagError(f'there is no bag {printable(path, PATH_LIMIT)}')
    if not path.is_dir():
        _check_file(path)
    elif not (path / 'metadata.yaml').exists():
        what = 'an empty folder' if not any(path.iterdir()) else 'a folder without metadata.yaml'
        raise BagError(f'{printable(path, PATH_LIMIT)} is {what}, not a bag{_advice(path)}')
    try:
        if path.is_dir():
            check_metadata(path / 'metadata.yaml')
        reader = BoundedReader(path)
        reader.open()
    except TooLargeError as error:
        raise BagError(f'{printable(path, PATH_LIMIT)} cannot be read: {error}') from error
    except MetadataError as error:
        raise DamagedBagError(path, str(error)) from error
    except Exception as error:  # whatever the parsers of a damaged file raise
        raise DamagedBagError(path, f'it cannot be read: {printable(repr(error), 200)}') from error
    try:
        _check_open(path, reader)
        yield reader
    finally:
        reader.close()


def _check_file(path: Path) -> None:
    """Raise BagError unless a bag without a directory is a file of a known kind."""
    if not path.is_file():
        raise BagError(f'{printable(path, PATH_LIMIT)} is not a bag: it is not a regular file')
    if not is_recoverable(path):
        raise BagError(f'{printable(path, PATH_LIMIT)} is not a bag: it is neither MCAP nor SQLite')


def _check_open(path: Path, reader: Reader) -> None:
    try:
        check_custom_data(reader.storage.metadata.custom)
        check_connections(reader.connections, stored_connections(reader))
    except MetadataError as error:
        raise DamagedBagError(path, str(error)) from error


def stored_connections(reader: Reader) -> list[Connection]:
    """Return the topics of an open bag as its data files describe them."""
    storages = getattr(reader.storage, 'storages', [reader.storage])
    return [connection for storage in storages for connection in storage.connections]


def custom_data(reader: Reader) -> dict[str, str]:
    """Return the custom data of an open bag."""
    return check_custom_data(reader.storage.metadata.custom)


def recorded_parameters(reader: Reader) -> dict[str, dict[str, Any]]:
    """Return the parameters of the nodes at the beginning of a recording, by full name of the node.

    Raises:
        BagError: They are damaged.
    """
    entries = custom_data(reader).items()
    try:
        return {
            key.removeprefix(PARAMETERS): parse_parameters(key, text)
            for key, text in entries
            if key.startswith(PARAMETERS)
        }
    except MetadataError as error:
        raise DamagedBagError(Path(str(reader.path)), str(error)) from error


def messages(
    reader: Reader, connections: Sequence[Connection], invalid: Counter[str] | None = None
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield the messages of some topics in the order of their recording.

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
    except TooLargeError as error:
        raise BagError(f'{reader.path} cannot be read: {error}') from error
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
