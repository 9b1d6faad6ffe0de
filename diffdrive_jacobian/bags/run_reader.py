"""Reading of recorded runs."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bag_reader import (
    BagError,
    DamagedBagError,
    ReadingInterruptedError,
    messages,
    open_bag,
    recorded_parameters,
    stored_connections,
)
from diffdrive_jacobian.bags.message_definitions import (
    known_structure,
    recorded_definition_differs,
    type_hashes,
)
from diffdrive_jacobian.bags.run import Run, Series
from diffdrive_jacobian.messages.cdr import DecodingError, LongMessageError
from diffdrive_jacobian.messages.codecs import Changes, FaultEvent
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.names import base_name, namespace_of
from diffdrive_jacobian.messages.topics import READABLE, TOPICS, Topic
from diffdrive_jacobian.text import printable

__all__ = [
    'BagError',
    'DamagedBagError',
    'ReadingInterruptedError',
    'Run',
    'Series',
    'messages',
    'open_bag',
    'read_run',
]

WHEELS = ('left_wheel_joint', 'right_wheel_joint')
"""Names of the left and the right wheel joint where no parameters give them."""


def read_run(
    path: str | Path,
    topics: Mapping[str, str] | None = None,
    *,
    namespace: str | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> Run:
    """Read a bag that `record_run` or `ros2 bag record` has written.

    Messages that cannot be decoded, and those that the nodes drop, are skipped. `Run.skipped` counts
    them and `Run.notes` describes them.

    Args:
        path: The bag's directory, or an MCAP or SQLite file.
        topics: Topics with another name in the bag: from the usual name, such as `odom`, to the name in
            the bag, such as `/robot1/odom`. By default topics are found by their name without namespace.
        namespace: Namespace of the robot, such as `/robot1`, in a bag of several. Only its topics and
            nodes are read, and topics that are given. None: that of the only robot.
        interrupted: Is called for each message; once it returns True, reading ends.

    Raises:
        ReadingInterruptedError: `interrupted` returned True.
        BagError: It is not a bag, is damaged, has several topics of the same name, or none in the
            namespace.
    """
    path = Path(path)
    rows: dict[str, list[tuple[int, int, tuple[float, ...]]]] = defaultdict(list)
    events: list[tuple[int, str, dict[str, Any]]] = []
    event_stamps: list[int] = []
    fault_events: list[tuple[int, str, str]] = []
    with open_bag(path) as reader:
        parameters = {
            node: values
            for node, values in recorded_parameters(reader).items()
            if namespace in (None, namespace_of(node))
        }
        names = _wheel_names(parameters)
        chosen = _choose(reader, dict(topics or {}), namespace)
        connections = [one for one in reader.connections if one.id in chosen]
        tally = _Tally()
        stored = stored_connections(reader)
        foreign = {
            one.id
            for one in connections
            if recorded_definition_differs(one.msgtype, type_hashes(one, stored))
        }
        readers = {
            one.id: chosen[one.id].codec(one.msgtype).reader(known_structure(one.msgtype))
            for one in connections
        }
        for connection, received, data in messages(reader, connections, tally.invalid):
            if interrupted():
                raise ReadingInterruptedError
            topic = chosen[connection.id]
            tally.read[connection.topic] += 1
            if connection.id in foreign:
                tally.foreign[connection.topic] += 1
                continue
            try:
                value = readers[connection.id](data)
                if isinstance(value, Changes):
                    if namespace in (None, namespace_of(value.node)):
                        events.append((received, value.node, value.values))
                        event_stamps.append(value.stamp)
                elif isinstance(value, FaultEvent):
                    fault_events.append((received, value.fault, value.what))
                else:
                    found = [
                        (received, stamp or received, row) for stamp, row in topic.rows(value, names)
                    ]
                    rows[topic.series].extend(found)
            except LongMessageError:
                tally.refused[connection.topic] += 1
            except DecodingError:
                tally.undecodable[connection.topic] += 1
            except MessageError:
                # The nodes drop it as well.
                tally.refused[connection.topic] += 1
        notes = tally.notes(connections)
    series, covariances = {}, {}
    for topic in TOPICS.values():
        if topic.series in series or not topic.series:
            continue
        one = _series(rows[topic.series], topic.columns + topic.covariances)
        count = len(topic.columns)
        covariances[topic.series] = one.values[:, count:].copy()
        series[topic.series] = replace(one, values=one.values[:, :count].copy(), columns=topic.columns)
    return Run(
        path=path,
        odometry_covariances=covariances['odometry'],
        start_covariances=covariances['start_pose'],
        parameters=parameters,
        parameter_events=tuple(events),
        parameter_stamps=tuple(event_stamps),
        fault_events=tuple(fault_events),
        skipped=dict(tally.skipped),
        notes=notes,
        **series,
    )


@dataclass(frozen=True, slots=True)
class _Tally:
    """Counts of messages by the name of their topic in the bag."""

    read: Counter[str] = field(default_factory=Counter)
    invalid: Counter[str] = field(default_factory=Counter)
    """Messages without a valid time or bytes, which `messages` leaves out; they are not in `read`."""
    foreign: Counter[str] = field(default_factory=Counter)
    """Messages of a type that was recorded with another definition than the known one."""
    undecodable: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def skipped(self) -> Counter[str]:
        return self.invalid + self.foreign + self.undecodable + self.refused

    def notes(self, connections: Sequence[Connection]) -> tuple[str, ...]:
        """Return descriptions of messages that were skipped or are missing, by topic."""
        found = self.read + self.invalid
        expected: Counter[str] = Counter()
        types: dict[str, str] = {}
        for connection in connections:
            expected[connection.topic] += connection.msgcount
            types[connection.topic] = connection.msgtype
        lines = []
        for topic in sorted(expected):
            for count, why in (
                (self.foreign[topic], f'were recorded with another definition of {types[topic]}'),
                (self.invalid[topic] + self.undecodable[topic], 'cannot be decoded'),
                (self.refused[topic], 'hold invalid or implausible values'),
            ):
                if count:
                    of = f'{count} of {found[topic]} messages on {printable(topic)}'
                    lines.append(f'{of} {why} and were skipped')
            if found[topic] != expected[topic]:
                lines.append(
                    f'{found[topic]} messages on {printable(topic)} were found, '
                    f'the bag should have {expected[topic]}'
                )
        return tuple(lines)


def _choose(reader: Reader, given: dict[str, str], namespace: str | None) -> dict[int, Topic]:
    """Return which connections are which topics of a run, by the id of the connection.

    Raises:
        BagError: A given topic is missing or has another type, a name has several topics, or the
            namespace has none.
    """
    chosen: dict[int, Topic] = {}
    if unknown := sorted(set(given) - READABLE.keys()):
        raise BagError(f'topics must be among {", ".join(sorted(READABLE))}, got {unknown[0]!r}')
    for name, topic in sorted(READABLE.items()):
        candidates = [
            connection
            for connection in reader.connections
            if (
                connection.topic == given[name]
                if name in given
                else base_name(connection.topic) == name
                and (topic.shared or namespace in (None, namespace_of(connection.topic)))
            )
        ]
        matching = [connection for connection in candidates if connection.msgtype in topic.types]
        if name in given and not matching:
            raise BagError(
                f'{reader.path} has no topic {given[name]} of {" or ".join(sorted(topic.types))}; '
                f'it has {", ".join(sorted({one.topic for one in reader.connections})) or "none"}'
            )
        if len({connection.topic for connection in matching}) > 1:
            raise BagError(
                f'{reader.path} has several topics {name}: '
                f'{", ".join(sorted({one.topic for one in matching}))}; choose one of them, or one '
                'namespace (--namespace)'
            )
        chosen.update((connection.id, topic) for connection in matching)
    if namespace is not None and all(topic.shared for topic in chosen.values()):
        of_robots = {name for name, topic in READABLE.items() if not topic.shared}
        topics = (one.topic for one in reader.connections)
        there = {namespace_of(one) for one in topics if base_name(one) in of_robots}
        raise BagError(
            f'{reader.path} has no topics of a run in the namespace {namespace}; it has them in '
            f'{", ".join(sorted(there)) or "none"}'
        )
    return chosen


def _wheel_names(parameters: dict[str, dict[str, Any]]) -> tuple[str, str]:
    for values in parameters.values():
        left, right = values.get('left_wheel_name'), values.get('right_wheel_name')
        if isinstance(left, str) and isinstance(right, str):
            return left, right
    return WHEELS


def _series(rows: list[tuple[int, int, tuple[float, ...]]], columns: tuple[str, ...]) -> Series:
    return Series(
        received=np.array([row[0] for row in rows], dtype=np.int64),
        stamps=np.array([row[1] for row in rows], dtype=np.int64),
        values=np.array([row[2] for row in rows], dtype=np.float64).reshape(len(rows), len(columns)),
        columns=columns,
    )
