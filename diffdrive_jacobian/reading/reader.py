"""Reading of recorded runs."""

from __future__ import annotations

import shlex
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.parameter import parameter_value_to_python
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bounded_reader import BoundedReader
from diffdrive_jacobian.bags.decoding import UndecodableError, decode
from diffdrive_jacobian.bags.journal import PARAMETERS, journal_of
from diffdrive_jacobian.bags.message_definitions import message_class
from diffdrive_jacobian.bags.metadata import (
    DamagedError,
    check_connections,
    check_custom_data,
    check_metadata,
    parse_parameters,
)
from diffdrive_jacobian.bounded_yaml import TooLargeError
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.reading.rows import PARAMETER_EVENTS, ROW_READERS, SERIES_TOPICS
from diffdrive_jacobian.reading.run import COLUMNS, Run, Series
from diffdrive_jacobian.recovery.damaged_bag import is_recoverable
from diffdrive_jacobian.text import PATH_LIMIT, printable

__all__ = ['BagError', 'DamagedBagError', 'Run', 'Series', 'read_run']

WHEELS = ('left_wheel_joint', 'right_wheel_joint')
"""Joints that are taken for wheels where no parameters tell their names: left, right."""


class BagError(Exception):
    """A bag cannot be read, or lacks what is needed; the message says which and what.

    The message is safe to print, though names in it may come from the bag.
    """

    def __init__(self, message: str) -> None:
        """Escape control characters in the message."""
        super().__init__(printable(message, PATH_LIMIT))


class DamagedBagError(BagError):
    """A bag is damaged; the message also says how to save what can be read."""

    def __init__(self, path: Path, why: str) -> None:
        """Set the message.

        Args:
            path: The bag.
            why: What is wrong with it.
        """
        super().__init__(f'{printable(path, PATH_LIMIT)} is damaged: {why}{_advice(path)}')
        self.why = why


def _advice(path: Path) -> str:
    """Return the command that saves what is left of a bag; '': there is nothing."""
    if not is_recoverable(path):
        return ''
    return f' ({_command(path)} saves what can be read)'


def _command(path: Path) -> str:
    return f'`recover_run {printable(shlex.quote(str(path)), PATH_LIMIT)}`'


def read_run(path: str | Path, topics: Mapping[str, str] | None = None) -> Run:
    """Read a bag that `record_run` or `ros2 bag record` has written.

    Messages that cannot be decoded, and those that the nodes drop, are skipped: `Run.skipped` counts
    them and `Run.notes` describes them.

    Args:
        path: The bag's directory (or, of MCAP, its file).
        topics: Names that differ: from the usual name, as `odom`, to the one in the bag, as
            `/robot1/odom`. Without it, and if there is just one topic of a name, namespaces do
            not matter.

    Raises:
        BagError: It is no bag, or damaged, or has several topics of one name.
    """
    path = Path(path)
    rows: dict[str, list[tuple[int, int, list[float]]]] = defaultdict(list)
    events: list[tuple[int, str, dict[str, Any]]] = []
    with open_bag(path) as reader:
        parameters = recorded_parameters(reader)
        names = _wheel_names(parameters)
        chosen = _choose(reader, dict(topics or {}))
        connections = [one for one in reader.connections if one.id in chosen]
        tally = _Tally()
        for connection, received, data in messages(reader, connections, tally.invalid):
            topic, kind = chosen[connection.id], connection.msgtype
            tally.read[connection.topic] += 1
            try:
                message = decode(data, message_class(kind))
                if topic == PARAMETER_EVENTS[0]:
                    events.append((received, message.node, _changes(message)))
                    continue
                read = list(ROW_READERS[topic, kind](message, names))
            except UndecodableError:
                tally.undecodable[connection.topic] += 1
            except MessageError:
                # The nodes drop it, too.
                tally.refused[connection.topic] += 1
            else:
                rows[topic].extend((received, stamp or received, values) for stamp, values in read)
        notes = tally.notes(connections)
    series = {
        name: _series(_in_order(rows, SERIES_TOPICS[name]), columns) for name, columns in COLUMNS.items()
    }
    return Run(
        path=path,
        parameters=parameters,
        parameter_events=tuple(events),
        skipped=dict(tally.skipped),
        notes=notes,
        **series,
    )


@dataclass(frozen=True, slots=True)
class _Tally:
    """Counts of messages by the name of their topic in the bag."""

    read: Counter[str] = field(default_factory=Counter)
    invalid: Counter[str] = field(default_factory=Counter)
    """Not even a time and bytes: counted by `messages`, not in `read`."""
    undecodable: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def skipped(self) -> Counter[str]:
        return self.invalid + self.undecodable + self.refused

    def notes(self, connections: Sequence[Connection]) -> tuple[str, ...]:
        """Describe what was skipped, and what is missing of what the bag says that it holds."""
        found = self.read + self.invalid
        promised: Counter[str] = Counter()
        for connection in connections:
            promised[connection.topic] += connection.msgcount
        lines = []
        for topic in sorted(promised):
            for count, why in (
                (self.invalid[topic] + self.undecodable[topic], 'cannot be decoded'),
                (self.refused[topic], 'hold invalid or implausible values'),
            ):
                if count:
                    of = f'{count} of {found[topic]} messages on {printable(topic)}'
                    lines.append(f'{of} {why} and were skipped')
            if found[topic] != promised[topic]:
                lines.append(
                    f'{found[topic]} messages on {printable(topic)} were found, '
                    f'the bag should have {promised[topic]}'
                )
        return tuple(lines)


def damage(path: Path) -> str:
    """Read a bag completely; return what is wrong with it, '' if nothing is or it is no bag.

    Messages that cannot be decoded are no damage: readers skip them.
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
    if path.is_file() and not is_recoverable(path):
        raise BagError(f'{printable(path, PATH_LIMIT)} is not a bag: it is neither MCAP nor SQLite')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        what = 'an empty folder' if not any(path.iterdir()) else 'a folder without metadata.yaml'
        raise BagError(f'{printable(path, PATH_LIMIT)} is {what}, not a bag{_advice(path)}')
    try:
        if path.is_dir():
            check_metadata(path / 'metadata.yaml')
        reader = BoundedReader(path)
        reader.open()
    except TooLargeError as error:
        raise BagError(f'{printable(path, PATH_LIMIT)} cannot be read: {error}') from error
    except DamagedError as error:
        raise DamagedBagError(path, str(error)) from error
    except Exception as error:  # whatever the parsers of a damaged file raise
        raise DamagedBagError(path, f'it cannot be read: {printable(repr(error), 200)}') from error
    try:
        _check_open(path, reader)
        yield reader
    finally:
        reader.close()


def custom_data(reader: Reader) -> dict[str, str]:
    """Return what the recorder noted down."""
    return check_custom_data(reader.storage.metadata.custom)


def recorded_parameters(reader: Reader) -> dict[str, dict[str, Any]]:
    """Return the parameters of the nodes at the beginning of a recording, by the nodes' full names.

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
    except DamagedError as error:
        raise DamagedBagError(Path(str(reader.path)), str(error)) from error


def messages(
    reader: Reader, connections: Sequence[Connection], invalid: Counter[str] | None = None
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield the messages of some connections in the order of their recording.

    Args:
        reader: An open bag.
        connections: Which of its topics.
        invalid: Is told, by topic, how many messages have no possible time or are not bytes, as they
            may be in an SQLite file. They are left out.

    Raises:
        BagError: The bag is damaged.
    """
    if not connections:
        # To rosbags that would mean all of them.
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
    except Exception as error:  # as above
        raise DamagedBagError(Path(str(reader.path)), printable(repr(error), 200)) from error


def _check_open(path: Path, reader: Reader) -> None:
    storages = getattr(reader.storage, 'storages', [reader.storage])
    stored = [connection for storage in storages for connection in storage.connections]
    try:
        check_custom_data(reader.storage.metadata.custom)
        check_connections(reader.connections, stored)
    except DamagedError as error:
        raise DamagedBagError(path, str(error)) from error


def _changes(event: Any) -> dict[str, Any]:
    """Return the new values of a parameter event.

    Raises:
        UndecodableError: A value is of an unknown type.
    """
    changes = [*event.new_parameters, *event.changed_parameters]
    try:
        return {one.name: parameter_value_to_python(one.value) for one in changes}
    except RuntimeError as error:
        raise UndecodableError(str(error)) from error


def _choose(reader: Reader, given: dict[str, str]) -> dict[int, str]:
    """Say which connections hold which of the topics of a run: connection's id to topic's usual name.

    Raises:
        BagError: A topic that was named is not there, is of another type, or has several candidates.
    """
    chosen: dict[int, str] = {}
    usual = {name for name, _ in ROW_READERS} | {PARAMETER_EVENTS[0]}
    if unknown := sorted(set(given) - usual):
        raise BagError(f'topics must be among {", ".join(sorted(usual))}, got {unknown[0]!r}')
    for name in usual:
        types = {kind for topic, kind in (*ROW_READERS, PARAMETER_EVENTS) if topic == name}
        candidates = [
            connection
            for connection in reader.connections
            if (
                connection.topic == given[name] if name in given else base_name(connection.topic) == name
            )
        ]
        matching = [connection for connection in candidates if connection.msgtype in types]
        if name in given and not matching:
            raise BagError(
                f'{reader.path} has no topic {given[name]} of {" or ".join(sorted(types))}; it has '
                f'{", ".join(sorted({one.topic for one in reader.connections})) or "none"}'
            )
        if len({connection.topic for connection in matching}) > 1:
            raise BagError(
                f'{reader.path} has several topics {name}: '
                f'{", ".join(sorted({one.topic for one in matching}))}; say which one is meant'
            )
        chosen.update((connection.id, name) for connection in matching)
    return chosen


def base_name(topic: str) -> str:
    """Give a topic's name without its namespace."""
    return topic.rsplit('/', 1)[-1]


def _wheel_names(parameters: dict[str, dict[str, Any]]) -> tuple[str, str]:
    for values in parameters.values():
        left, right = values.get('left_wheel_name'), values.get('right_wheel_name')
        if isinstance(left, str) and isinstance(right, str):
            return left, right
    return WHEELS


def _in_order(rows: dict[str, list[Any]], topics: tuple[str, ...]) -> list[Any]:
    """Join the rows of several topics in the order of their recording."""
    return sorted((row for topic in topics for row in rows[topic]), key=lambda row: row[0])


def _series(rows: list[tuple[int, int, list[float]]], columns: tuple[str, ...]) -> Series:
    return Series(
        received=np.array([row[0] for row in rows], dtype=np.int64),
        stamps=np.array([row[1] for row in rows], dtype=np.int64),
        values=np.array([row[2] for row in rows], dtype=np.float64).reshape(len(rows), len(columns)),
        columns=columns,
    )
