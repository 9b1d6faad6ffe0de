"""A recorded run as NumPy arrays."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.parameter import parameter_value_to_python
from rclpy.serialization import deserialize_message
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bounded_reader import BoundedReader
from diffdrive_jacobian.bags.definitions import message_class
from diffdrive_jacobian.bags.recorder import PARAMETERS
from diffdrive_jacobian.bounded_yaml import TooLargeError
from diffdrive_jacobian.ros.messages import (
    MessageError,
    from_joint_state,
    from_pose,
    from_time,
    from_twist,
)
from diffdrive_jacobian.text import PATH_LIMIT, printable

WHEELS = ('left_wheel_joint', 'right_wheel_joint')
"""Joints that are taken for wheels where no parameters tell their names: left, right."""


class BagError(Exception):
    """A bag cannot be read, or lacks what is needed; the message says which and what.

    The message is safe to print, though names in it may come from the bag.
    """

    def __init__(self, message: str) -> None:
        """Escape control characters in the message."""
        super().__init__(printable(message, PATH_LIMIT))


@dataclass(frozen=True, kw_only=True, slots=True)
class Series:
    """What came on one topic, in the order in which it was recorded; n may be 0."""

    received: NDArray[np.int64]
    """When each message was recorded, shape (n,) (ns)."""
    stamps: NDArray[np.int64]
    """The messages' own stamps, where they have one, else as `received`, shape (n,) (ns)."""
    values: NDArray[np.float64]
    """One row for each, shape (n, k)."""

    def __len__(self) -> int:
        """Give n."""
        return len(self.stamps)


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """A run. All series are there; those whose topic was not recorded are empty."""

    path: Path
    odometry: Series
    """`[x, y, theta, v, omega]` (m, m, rad, m/s, rad/s)."""
    cmd_vel: Series
    """`[v, omega]` as commanded (m/s, rad/s); Twist or TwistStamped."""
    cmd_vel_out: Series
    """`[v, omega]` as applied, each from its stamp on."""
    start_pose: Series
    """`[x, y, theta]` where the odometry began, each at its stamp."""
    wheel_commands: Series
    """`[omega_R, omega_L]` of joint_command (rad/s)."""
    wheels: Series
    """`[omega_R, omega_L]` of joint_states (rad/s)."""
    goals: Series
    """`[x, y, theta]` of each goal and waypoint."""
    goal_status: Series
    """`[status]`, the numbers of action_msgs/GoalStatus, stamped as the goal."""
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By the full name of the node, as of the beginning of the run."""
    parameter_events: tuple[tuple[int, str, dict[str, Any]], ...] = ()
    """What changed meanwhile: when it was recorded (ns), the node, the new values."""

    def of_node(self, name: str) -> dict[str, Any]:
        """Give the parameters of the node of that base name; {} if there is none or several."""
        found = [values for node, values in self.parameters.items() if node.split('/')[-1] == name]
        return found[0] if len(found) == 1 else {}


def read_run(path: str | Path, topics: Mapping[str, str] | None = None) -> Run:
    """Read a bag that `record_run` or `ros2 bag record` has written.

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
    parameters: dict[str, dict[str, Any]] = {}
    events: list[tuple[int, str, dict[str, Any]]] = []
    with open_bag(path) as reader:
        for key, text in custom_data(reader).items():
            if key.startswith(PARAMETERS):
                parameters[key.removeprefix(PARAMETERS)] = _parameters(path, key, text)
        names = _wheel_names(parameters)
        chosen = _choose(reader, dict(topics or {}))
        connections = [one for one in reader.connections if one.id in chosen]
        for connection, received, data in messages(reader, connections):
            topic, kind = chosen[connection.id], connection.msgtype
            message = _deserialized(path, connection, data)
            if topic == _EVENTS[0]:
                changes = [*message.new_parameters, *message.changed_parameters]
                values = {one.name: parameter_value_to_python(one.value) for one in changes}
                events.append((received, message.node, values))
                continue
            try:
                read = list(_READERS[topic, kind](message, names))
            except MessageError:
                # The nodes drop it, too.
                continue
            rows[topic].extend((received, stamp or received, values) for stamp, values in read)
    series = {name: _series(_in_order(rows, of), width) for name, (of, width) in _SERIES.items()}
    return Run(path=path, parameters=parameters, parameter_events=tuple(events), **series)


@contextmanager
def open_bag(path: Path) -> Iterator[Reader]:
    """Open a bag; `messages` reads it.

    Raises:
        BagError: There is none, or it is damaged.
    """
    if not path.exists():
        raise BagError(f'there is no bag {path}')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        what = 'an empty folder' if not any(path.iterdir()) else 'a folder without metadata.yaml'
        raise BagError(f'{path} is {what}, not a bag (recover_run makes one from what a crash has left)')
    try:
        reader = BoundedReader(path)
        reader.open()
    except Exception as error:  # whatever the parsers of a damaged file raise
        raise BagError(f'{path} is not a bag that can be read: {_described(error)}') from error
    try:
        yield reader
    finally:
        reader.close()


def custom_data(reader: Reader) -> dict[str, str]:
    """Give what the recorder noted down.

    Raises:
        BagError: It is damaged.
    """
    custom = reader.storage.metadata.custom or {}
    if not isinstance(custom, dict) or not all(isinstance(text, str) for text in custom.values()):
        raise BagError(
            f'{reader.path} is damaged: its custom_data must be texts by name, '
            f'got {printable(repr(custom))}'
        )
    return custom


def messages(
    reader: Reader, connections: Sequence[Connection]
) -> Iterator[tuple[Connection, int, bytes]]:
    """Give the messages of some connections in the order of their recording.

    Raises:
        BagError: The bag is damaged.
    """
    if not connections:
        # To rosbags that would mean all of them.
        return
    try:
        for connection, received, data in reader.messages(connections):
            yield connection, received, bytes(data)
    except TooLargeError as error:
        raise BagError(f'{reader.path} cannot be read: {error}') from error
    except Exception as error:  # as above
        raise BagError(f'{reader.path} is damaged: {_described(error)}') from error


def _described(error: Exception) -> str:
    """Return an error of a parser on one line; what it quotes of the bag is cut."""
    text = str(error) if isinstance(error, TooLargeError) else repr(error)
    return printable(text, 200)


def _parameters(path: Path, key: str, text: str) -> dict[str, Any]:
    try:
        values = json.loads(text)
    except ValueError as error:
        raise BagError(f'{path} is damaged: the {key} are no JSON: {error}') from error
    if not isinstance(values, dict):
        raise BagError(f'{path} is damaged: the {key} must be names and values, got {text[:40]!r}')
    return values


def _deserialized(path: Path, connection: Connection, data: bytes) -> Any:
    try:
        return deserialize_message(data, message_class(connection.msgtype))
    except (RuntimeError, ValueError, AssertionError) as error:
        raise BagError(
            f'{path} is damaged: a message on {connection.topic} is no {connection.msgtype}'
        ) from error


# --- From messages to numbers

Rows = Iterator[tuple[int, list[float]]]
"""Stamp (ns; 0: none) and values."""


def _twist(message: Any, _: tuple[str, str]) -> Rows:
    yield 0, list(from_twist(message))


def _twist_stamped(message: Any, _: tuple[str, str]) -> Rows:
    yield from_time(message.header.stamp), list(from_twist(message.twist))


def _odometry(message: Any, _: tuple[str, str]) -> Rows:
    pose, twist = from_pose(message.pose.pose), from_twist(message.twist.twist)
    yield from_time(message.header.stamp), [*pose.tolist(), *twist]


def _pose(message: Any, _: tuple[str, str]) -> Rows:
    yield from_time(message.header.stamp), from_pose(message.pose).tolist()


def _pose_with_covariance(message: Any, _: tuple[str, str]) -> Rows:
    yield from_time(message.header.stamp), from_pose(message.pose.pose).tolist()


def _goals(message: Any, _: tuple[str, str]) -> Rows:
    stamp = from_time(message.header.stamp)
    for goal in message.goals:
        yield stamp, from_pose(goal.pose).tolist()


def _status(message: Any, _: tuple[str, str]) -> Rows:
    yield from_time(message.goal_info.stamp), [float(message.status)]


def _joints(message: Any, names: tuple[str, str]) -> Rows:
    yield from_time(message.header.stamp), list(from_joint_state(message, names))


_READERS: dict[tuple[str, str], Callable[[Any, tuple[str, str]], Rows]] = {
    ('cmd_vel', 'geometry_msgs/msg/Twist'): _twist,
    ('cmd_vel', 'geometry_msgs/msg/TwistStamped'): _twist_stamped,
    ('cmd_vel_out', 'geometry_msgs/msg/TwistStamped'): _twist_stamped,
    ('odom', 'nav_msgs/msg/Odometry'): _odometry,
    ('start_pose', 'geometry_msgs/msg/PoseWithCovarianceStamped'): _pose_with_covariance,
    ('goal_pose', 'geometry_msgs/msg/PoseStamped'): _pose,
    ('goals', 'nav_msgs/msg/Goals'): _goals,
    ('goal_status', 'action_msgs/msg/GoalStatus'): _status,
    ('joint_command', 'sensor_msgs/msg/JointState'): _joints,
    ('joint_states', 'sensor_msgs/msg/JointState'): _joints,
}
"""Topic and type to what reads it."""
_EVENTS = ('parameter_events', 'rcl_interfaces/msg/ParameterEvent')
_SERIES = {
    'odometry': (('odom',), 5),
    'cmd_vel': (('cmd_vel',), 2),
    'cmd_vel_out': (('cmd_vel_out',), 2),
    'start_pose': (('start_pose',), 3),
    'wheel_commands': (('joint_command',), 2),
    'wheels': (('joint_states',), 2),
    'goals': (('goal_pose', 'goals'), 3),
    'goal_status': (('goal_status',), 1),
}
"""Field of `Run` to its topics and how many values a row has."""


def _choose(reader: Reader, given: dict[str, str]) -> dict[int, str]:
    """Say which connections hold which of the topics of a run: connection's id to topic's usual name.

    Raises:
        BagError: A topic that was named is not there, is of another type, or has several candidates.
    """
    chosen: dict[int, str] = {}
    usual = {name for name, _ in _READERS} | {_EVENTS[0]}
    if unknown := sorted(set(given) - usual):
        raise BagError(f'topics must be among {", ".join(sorted(usual))}, got {unknown[0]!r}')
    for name in usual:
        types = {kind for topic, kind in (*_READERS, _EVENTS) if topic == name}
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
        if 'left_wheel_name' in values and 'right_wheel_name' in values:
            return values['left_wheel_name'], values['right_wheel_name']
    return WHEELS


def _in_order(rows: dict[str, list[Any]], topics: tuple[str, ...]) -> list[Any]:
    """Join the rows of several topics in the order of their recording."""
    return sorted((row for topic in topics for row in rows[topic]), key=lambda row: row[0])


def _series(rows: list[tuple[int, int, list[float]]], width: int) -> Series:
    return Series(
        received=np.array([row[0] for row in rows], dtype=np.int64),
        stamps=np.array([row[1] for row in rows], dtype=np.int64),
        values=np.array([row[2] for row in rows], dtype=np.float64).reshape(len(rows), width),
    )
