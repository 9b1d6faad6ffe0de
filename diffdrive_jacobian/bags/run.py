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

"""Recorded runs as NumPy arrays, and their reading.

`print(run)` and `print(run.odometry)` give a summary; the numbers are in `run.odometry.values`, whose
columns are named in `run.odometry.columns`.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bag_reader import (
    BagError,
    custom_data,
    lost_messages,
    noted_losses,
    open_bag,
    recorded_parameters,
)
from diffdrive_jacobian.bags.decoded import read_messages
from diffdrive_jacobian.messages.codecs import Changes, FaultEvent
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.names import base_name, namespace_of
from diffdrive_jacobian.messages.topics import READABLE, TABLES, Topic
from diffdrive_jacobian.time_units import NANOSECONDS

if TYPE_CHECKING:
    from diffdrive_jacobian.bags.timeline import Timeline

MAX_NUMBER = 1e6
"""Largest magnitude of the numeric parameters of our nodes (m, m/s, rad/s)."""
COLUMNS = {table.series: table.columns for table in TABLES}
"""Columns of the values of each series of a `Run`."""
_CONTROLLER = {'controller', 'use_goal_heading', 'xy_goal_tolerance'}
"""Parameters by which a go_to_goal of another name is known."""
WHEELS = ('left_wheel_joint', 'right_wheel_joint')
"""Names of the left and the right wheel joint where no parameters give them."""


@dataclass(frozen=True, kw_only=True, slots=True, repr=False)
class Series:
    """The messages of one topic, sorted by the time of their recording; n may be 0."""

    received: NDArray[np.int64]
    """When each message was recorded, shape (n,) (ns)."""
    stamps: NDArray[np.int64]
    """The messages' own stamps, where they have one, else as `received`, shape (n,) (ns)."""
    values: NDArray[np.float64]
    """One row for each message, shape (n, k)."""
    columns: tuple[str, ...] = ()
    """Names of the k columns of `values`, as documented at the fields of `Run`."""

    def __len__(self) -> int:
        """Return n."""
        return len(self.stamps)

    @property
    def back(self) -> NDArray[np.intp]:
        """Before which messages time goes back, by their stamps, ascending indices."""
        return np.flatnonzero(np.diff(self.stamps) < 0) + 1

    def __repr__(self) -> str:
        """Return a summary of one line."""
        columns = ', '.join(self.columns) or f'{self.values.shape[1]} columns'
        text = f'{len(self)} message{"" if len(self) == 1 else "s"} of [{columns}]'
        if len(self):
            text += f', recorded over {float(np.ptp(self.received)) / NANOSECONDS:.3f} s'
        return f'Series({text})'


@dataclass(frozen=True, kw_only=True, slots=True, repr=False)
class Run:
    """A run. All series exist; those whose topic was not recorded are empty.

    Each series has the time of recording (`received`, ns), the messages' stamps (`stamps`, ns) and
    `values` with the columns that are given below.
    """

    path: Path
    odometry: Series
    """`[x, y, theta, v, omega]` of odom (m, m, rad, m/s, rad/s)."""
    ground_truth: Series
    """`[x, y, theta, v, omega]` of ground_truth, in its own frame (m, m, rad, m/s, rad/s)."""
    cmd_vel: Series
    """`[v, omega]` as commanded (m/s, rad/s); Twist or TwistStamped."""
    cmd_vel_out: Series
    """`[v, omega]` as applied, each from its stamp on (m/s, rad/s)."""
    start_pose: Series
    """`[x, y, theta]` where the odometry began, each at its stamp (m, m, rad)."""
    wheel_commands: Series
    """`[omega_R, omega_L]` of joint_command (rad/s)."""
    wheels: Series
    """`[omega_R, omega_L]` of joint_states (rad/s)."""
    goals: Series
    """`[x, y, theta]` of each goal and waypoint (m, m, rad)."""
    planned_path: Series
    """`[x, y, theta, t]` of each pose of each path; t is the time since the first pose of a trajectory,
    NaN of a path without times (m, m, rad, s)."""
    goal_status: Series
    """`[status]`, the numbers of action_msgs/GoalStatus, stamped as the goal."""
    odometry_covariances: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 9)))
    """Covariances in each message of odom as recorded, unchecked, shape (n, 9): the entries xx, xy, xt,
    yy, yt, tt of the pose's and vv, vw, ww of the twist's."""
    start_covariances: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 6)))
    """The entries xx, xy, xt, yy, yt, tt of the covariance in each start_pose, shape (n, 6)."""
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By the full name of the node, as of the beginning of the run."""
    parameter_events: tuple[tuple[int, Changes], ...] = ()
    """Later changes of parameters, each with when it was recorded (ns)."""
    fault_events: tuple[tuple[int, FaultEvent], ...] = ()
    """What the faults of a lockstep world did, each with when it was recorded (ns)."""
    skipped: dict[str, int] = field(default_factory=dict)
    """How many messages of a topic could not be used, by the topic's name in the bag."""
    missing: dict[str, int] = field(default_factory=dict)
    """How many messages of a topic the recorder or the bag counts that are not there, by the topic's
    name in the bag."""
    notes: tuple[str, ...] = ()
    """What is wrong with the bag although it can be read, in words: messages that were skipped, and
    why, and messages that are missing."""

    def __repr__(self) -> str:
        """Return a summary of a few lines."""
        series = {one.name: getattr(self, one.name) for one in fields(self) if one.name in COLUMNS}
        lines = [f'Run({str(self.path)!r}:']
        lines += [f'  {name}: {str(one)[7:-1]}' for name, one in series.items() if len(one)]
        lines += [f'  parameters of {", ".join(self.parameters)}'] if self.parameters else []
        lines += [f'  {len(self.parameter_events)} changes of parameters'] * bool(self.parameter_events)
        lines += [f'  {len(self.fault_events)} events of faults'] * bool(self.fault_events)
        lines += [f'  {note}' for note in self.notes]
        return '\n'.join([*lines, ')'])

    def timeline(self) -> Timeline:
        """Return goals, paths and errors at each odometry message, as `bags.timeline.timeline`."""
        from diffdrive_jacobian.bags.timeline import timeline

        return timeline(self)

    def table(self) -> dict[str, NDArray[np.float64]]:
        """Return columns by name, one value for each odometry message, as `bags.table.table`."""
        from diffdrive_jacobian.bags.table import table

        return table(self)

    def lacking(self, what: str) -> BagError:
        """Return the error that something was not found in the run, with the notes that may tell why."""
        return BagError('; '.join([f'{self.path} has no {what}', *self.notes]))

    def of_node(self, name: str) -> dict[str, Any]:
        """Return the parameters of the node of that base name; {} if there is none or several.

        A go_to_goal that was renamed is known by its parameters.
        """
        found = [values for node, values in self.parameters.items() if node.split('/')[-1] == name]
        if name == 'go_to_goal' and not found:
            found = [values for values in self.parameters.values() if values.keys() >= _CONTROLLER]
        return found[0] if len(found) == 1 else {}

    def configurations(self) -> Iterator[tuple[int, Run]]:
        """Yield the run with the parameters of each time, and since when they are valid (ns), from 0."""
        run, since = self, 0
        yield since, run
        for received, change in self.parameter_events:
            since = max(since, received)
            values = {**run.parameters.get(change.node, {}), **change.values}
            run = replace(run, parameters={**run.parameters, change.node: values})
            yield since, run

    def number_of_node(self, node: str, parameter: str, default: float) -> float:
        """Return a parameter of a node; `default` if it was not recorded or is not a finite number."""
        value = number(self.of_node(node).get(parameter))
        return value if math.isfinite(value) else default


def number(value: object) -> float:
    """Return a recorded parameter as a number; NaN: it is none, or beyond what the nodes accept."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= MAX_NUMBER:
        return math.nan
    return float(value)


# --- Reading


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
        InterruptionError: `interrupted` returned True.
        BagError: It is not a bag, is damaged, has several topics of the same name, or none in the
            namespace.
    """
    path = Path(path)

    def take(connection: Connection, received: int, value: Any) -> None:
        if not isinstance(value, Changes) or namespace in (None, namespace_of(value.node)):
            gathered.take(chosen[connection.id], received, value)

    with open_bag(path) as reader:
        parameters = {
            node: values
            for node, values in recorded_parameters(reader).items()
            if namespace in (None, namespace_of(node))
        }
        gathered = _Gathered(_wheel_names(parameters))
        chosen = _choose(reader, dict(topics or {}), namespace)
        types = {one.id: one.msgtype for one in reader.connections}
        codecs = {number: topic.codec(types[number]) for number, topic in chosen.items()}
        tally = read_messages(reader, codecs, take, interrupted)
        noted = custom_data(reader)
    # Of this robot.
    lost = Counter({on: count for on, count in lost_messages(noted).items() if on in tally.expected})
    return gathered.run(
        path=path,
        parameters=parameters,
        skipped=tally.skipped,
        missing=dict(tally.missing + lost),
        notes=(*tally.notes(), *(f'lost: {one}' for one in noted_losses(noted))),
    )


def run_of(
    name: str, messages: Iterable[tuple[int, str, Any]], parameters: dict[str, dict[str, Any]]
) -> Run:
    """Return a run that was not recorded.

    Args:
        name: What its pictures call it.
        messages: Time of receipt (ns), topic without namespace, and value of each message, in order.
        parameters: As `Run.parameters`.
    """
    gathered = _Gathered(_wheel_names(parameters))
    for received, topic, value in messages:
        if topic in READABLE:
            # What the nodes drop is no part of a run.
            with suppress(MessageError):
                gathered.take(READABLE[topic], received, value)
    return gathered.run(path=Path(name), parameters=parameters)


class _Gathered:
    """The messages of a run, as rows."""

    def __init__(self, wheels: tuple[str, str]) -> None:
        self._wheels = wheels
        self._rows: dict[str, list[tuple[int, int, tuple[float, ...]]]] = defaultdict(list)
        self._changes: list[tuple[int, Changes]] = []
        self._fault_events: list[tuple[int, FaultEvent]] = []

    def take(self, topic: Topic, received: int, value: Any) -> None:
        """Take a message, or raise MessageError."""
        if isinstance(value, Changes):
            self._changes.append((received, value))
        elif isinstance(value, FaultEvent):
            self._fault_events.append((received, value))
        elif topic.table is not None:
            self._rows[topic.table.series] += [
                (received, stamp or received, row)
                for stamp, row in topic.table.rows(value, self._wheels)
            ]

    def run(self, **others: Any) -> Run:
        """Return the run. `others`: its other fields."""
        series: dict[str, Any] = {}
        covariances: dict[str, NDArray[np.float64]] = {}
        for table in TABLES:
            found, count = self._rows[table.series], len(table.columns)
            values = np.array([row for *_, row in found], dtype=np.float64)
            values = values.reshape(len(found), count + len(table.covariances))
            covariances[table.series] = values[:, count:].copy()
            series[table.series] = Series(
                received=np.array([received for received, *_ in found], dtype=np.int64),
                stamps=np.array([stamp for _, stamp, _ in found], dtype=np.int64),
                values=values[:, :count].copy(),
                columns=table.columns,
            )
        return Run(
            odometry_covariances=covariances['odometry'],
            start_covariances=covariances['start_pose'],
            parameter_events=tuple(self._changes),
            fault_events=tuple(self._fault_events),
            **others,
            **series,
        )


def _choose(reader: Reader, given: dict[str, str], namespace: str | None) -> dict[int, Topic]:
    """Return which connections are which topics of a run, by the id of the connection."""
    chosen: dict[int, Topic] = {}
    if unknown := sorted(set(given) - READABLE.keys()):
        raise BagError(f'topics must be among {", ".join(sorted(READABLE))}, got {unknown[0]!r}')
    for name, topic in sorted(READABLE.items()):
        matching = [
            one
            for one in reader.connections
            if one.msgtype in topic.types
            and (
                one.topic == given[name]
                if name in given
                else base_name(one.topic) == name
                and (topic.shared or namespace in (None, namespace_of(one.topic)))
            )
        ]
        if name in given and not matching:
            raise BagError(
                f'{reader.path} has no topic {given[name]} of {" or ".join(sorted(topic.types))}; '
                f'it has {", ".join(sorted({one.topic for one in reader.connections})) or "none"}'
            )
        if len(names := {one.topic for one in matching}) > 1:
            raise BagError(
                f'{reader.path} has several topics {name}: {", ".join(sorted(names))}; '
                'choose one of them, or one namespace (--namespace)'
            )
        chosen.update((one.id, topic) for one in matching)
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
