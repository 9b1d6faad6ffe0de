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

"""The messages of the nodes: which fields are read, what value they make, and how it is written.

A `Codec` belongs to a type of message. It reads serialized messages field by field, see `messages.cdr`,
without their Python classes, so that bags are read where no ROS is installed, too. It checks what it
reads, unless the value says otherwise. What it writes it reads again as the same value, but for what
the message has not, the rounding of a heading, and strings, which are those of a template.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter, itemgetter
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar

from diffdrive_jacobian.messages.cdr import Reader, Writer
from diffdrive_jacobian.messages.conversion import (
    MAX_PATH_POSES,
    MAX_SPEED,
    MAX_WAYPOINTS,
    MessageError,
    from_joints,
    from_pose,
    from_time,
    from_twist,
    plausible_twist,
    quoted,
)
from diffdrive_jacobian.messages.structure import Structure
from diffdrive_jacobian.time_units import NANOSECONDS

V = TypeVar('V')
Texts = tuple[str, ...]
Column = tuple[Any, ...]
"""A field of each element of a sequence."""

STAMP = ('header.stamp.sec', 'header.stamp.nanosec')
FRAME = 'header.frame_id'
TWIST_IN = {
    'geometry_msgs/msg/Twist': '',
    'geometry_msgs/msg/TwistStamped': 'twist.',
    'geometry_msgs/msg/TwistWithCovarianceStamped': 'twist.twist.',
    'nav_msgs/msg/Odometry': 'twist.twist.',
}
"""Where messages have a twist."""
POSE_IN = {
    'nav_msgs/msg/Odometry': 'pose.pose.',
    'geometry_msgs/msg/PoseStamped': 'pose.',
    'geometry_msgs/msg/PoseWithCovarianceStamped': 'pose.pose.',
}
"""Where messages have a pose."""

# (x, y, yaw) and (v, omega) in the row-major 6x6 covariances of ROS.
_PLANAR = [6 * row + column for row in (0, 1, 5) for column in (0, 1, 5)]
_FORWARD_AND_YAW = [6 * row + column for row in (0, 5) for column in (0, 5)]
_planar, _forward_and_yaw = itemgetter(*_PLANAR), itemgetter(*_FORWARD_AND_YAW)


class GoalError(MessageError):
    """Goals that are invalid, in a message whose stamp was read."""

    def __init__(self, why: str, stamp: tuple[int, int]) -> None:
        """Say why, and by which stamp the goals are known."""
        super().__init__(why)
        self.stamp = stamp


@dataclass(frozen=True, eq=False, slots=True)
class Codec(Generic[V]):
    """How one type of message becomes a value, and back."""

    type_name: str
    """`package/msg/Name`."""
    fields: tuple[str, ...]
    """Paths of the fields that are read, as `cdr.Reader` takes them."""
    value: Callable[..., V]
    """Returns the value of these fields. It raises MessageError if they are invalid."""
    written: tuple[str, ...] = ()
    """Paths of the numbers that are written, as `cdr.Writer` takes them."""
    numbers: Callable[[V], tuple[Any, ...]] = lambda _: ()
    """Returns these numbers of a value."""

    def reader(
        self, kind: Any, deserialize: Callable[[bytes, Any], Any] | None = None
    ) -> Callable[[bytes], V]:
        """Return a function that returns the value in a serialized message; arguments as `cdr.Reader`.

        It raises MessageError: DecodingError if the bytes are not a message of the type, and others if
        the value is invalid.
        """
        return Reader(kind, self.fields, self.value, deserialize=deserialize)

    def writer(self, template: Any, kind: Structure | None = None) -> Writer:
        """Return what serializes values, with the strings and the lengths of a template.

        `kind` is its type; None: that of its class.

        ValueError: it is only read.
        """
        if not self.written:
            raise ValueError(
                f'a codec that writes must be given, got one that only reads {self.type_name}'
            )
        return Writer(template, self.written, self.numbers, kind)


def twist_fields(type_name: str) -> tuple[str, ...]:
    """Return the fields of a twist for `from_twist` in a type of `TWIST_IN`."""
    prefix = TWIST_IN[type_name]
    return tuple(f'{prefix}{part}.{axis}' for part in ('linear', 'angular') for axis in 'xyz')


def pose_fields(type_name: str) -> tuple[str, ...]:
    """Return the fields of a pose for `from_pose` in a type of `POSE_IN`."""
    return tuple(POSE_IN[type_name] + field for field in _POSE)


_POSE = ('position.x', 'position.y', *(f'orientation.{axis}' for axis in 'xyzw'))
_PLANAR_POSE = ('position.x', 'position.y', 'orientation.z', 'orientation.w')


# --- Commands: cmd_vel, cmd_vel_out


class Command(NamedTuple):
    """A body twist to follow."""

    twist: tuple[float, float]
    """`(v, omega)` (m/s, rad/s)."""
    stamp: int = 0
    """From when on (ns); 0: from when it is received."""


def _command(*twist: float) -> Command:
    return Command(from_twist(*twist))


def _stamped_command(sec: int, nanosec: int, *twist: float) -> Command:
    return Command(from_twist(*twist), from_time(sec, nanosec))


def _stamped_numbers(command: Command) -> tuple[float, ...]:
    twist, stamp = command
    return (*divmod(stamp, NANOSECONDS), *twist)


TWIST = Codec(
    'geometry_msgs/msg/Twist',
    twist_fields('geometry_msgs/msg/Twist'),
    _command,
    ('linear.x', 'angular.z'),
    attrgetter('twist'),
)
TWIST_STAMPED = Codec(
    'geometry_msgs/msg/TwistStamped',
    (*STAMP, *twist_fields('geometry_msgs/msg/TwistStamped')),
    _stamped_command,
    (*STAMP, 'twist.linear.x', 'twist.angular.z'),
    _stamped_numbers,
)

# --- Poses: odom, ground_truth, start_pose, initialpose

_ZERO_POSE_COVARIANCE = (0.0,) * 9
_ZERO_TWIST_COVARIANCE = (0.0,) * 4


class Motion(NamedTuple):
    """Pose and twist at a time."""

    stamp: int
    """(ns)"""
    pose: tuple[float, float, float]
    """`(x, y, theta)` (m, m, rad)."""
    twist: tuple[float, float]
    """`(v, omega)` in the body frame (m/s, rad/s)."""
    covariance: tuple[float, ...] = _ZERO_POSE_COVARIANCE
    """Of x, y, theta, row by row; not checked, see `conversion.from_covariance`."""
    twist_covariance: tuple[float, ...] = _ZERO_TWIST_COVARIANCE
    """Of v and omega, row by row; not checked."""
    frame: str = ''
    """Frame of the pose, as it was read."""


class State(NamedTuple):
    """Pose and twist of a robot, as those who drive it need them."""

    stamp: tuple[int, int]
    """`sec` and `nanosec`; not checked."""
    frame: str
    """Frame of the pose."""
    pose: tuple[float, float, float]
    """`(x, y, theta)` (m, m, rad)."""
    twist: tuple[float, float]
    """`(v, omega)` in the body frame (m/s, rad/s), plausible."""


class Place(NamedTuple):
    """A pose at a time."""

    stamp: int
    """(ns)"""
    pose: tuple[float, float, float]
    """`(x, y, theta)` (m, m, rad)."""
    covariance: tuple[float, ...] = _ZERO_POSE_COVARIANCE
    """As of a `Motion`."""
    frame: str = ''
    """Frame of the pose, as it was read."""


def _motion(sec: int, nanosec: int, frame: str, *values: Any) -> Motion:
    *pose_and_twist, of_pose, of_twist = values
    return Motion(
        from_time(sec, nanosec),
        from_pose(*pose_and_twist[:6]),
        from_twist(*pose_and_twist[6:]),
        _planar(of_pose),
        _forward_and_yaw(of_twist),
        frame,
    )


def _motion_numbers(motion: Motion) -> tuple[float, ...]:
    stamp, (x, y, theta), twist, covariance, twist_covariance, _ = motion
    orientation = math.sin(theta / 2.0), math.cos(theta / 2.0)
    return (*divmod(stamp, NANOSECONDS), x, y, *orientation, *covariance, *twist, *twist_covariance)


def _place_numbers(place: Place) -> tuple[float, ...]:
    stamp, (x, y, theta), covariance, _ = place
    orientation = math.sin(theta / 2.0), math.cos(theta / 2.0)
    return (*divmod(stamp, NANOSECONDS), x, y, *orientation, *covariance)


def _state(frame: str, sec: int, nanosec: int, v: float, omega: float, *pose: float) -> State:
    # Not a call for each message.
    if not (abs(v) <= MAX_SPEED and abs(omega) <= MAX_SPEED):
        plausible_twist(v, omega)
    return State((sec, nanosec), frame, from_pose(*pose), (v, omega))


def _place(sec: int, nanosec: int, frame: str, *values: Any) -> Place:
    *pose, covariance = values
    return Place(from_time(sec, nanosec), from_pose(*pose), _planar(covariance), frame)


_WRITTEN_PLACE = (
    *STAMP,
    *(f'pose.pose.{field}' for field in _PLANAR_POSE),
    *(f'pose.covariance[{index}]' for index in _PLANAR),
)
ODOMETRY = Codec(
    'nav_msgs/msg/Odometry',
    (
        *(*STAMP, FRAME),
        *pose_fields('nav_msgs/msg/Odometry'),
        *twist_fields('nav_msgs/msg/Odometry'),
        *('pose.covariance', 'twist.covariance'),
    ),
    _motion,
    (
        *_WRITTEN_PLACE,
        *('twist.twist.linear.x', 'twist.twist.angular.z'),
        *(f'twist.covariance[{index}]' for index in _FORWARD_AND_YAW),
    ),
    _motion_numbers,
)
ODOMETRY_STATE = Codec(
    'nav_msgs/msg/Odometry',
    (
        *(FRAME, *STAMP, 'twist.twist.linear.x', 'twist.twist.angular.z'),
        *pose_fields('nav_msgs/msg/Odometry'),
    ),
    _state,
)
"""Odometry as those who drive need it."""
POSE_WITH_COVARIANCE = Codec(
    'geometry_msgs/msg/PoseWithCovarianceStamped',
    (
        *(*STAMP, FRAME),
        *pose_fields('geometry_msgs/msg/PoseWithCovarianceStamped'),
        'pose.covariance',
    ),
    _place,
    _WRITTEN_PLACE,
    _place_numbers,
)

# --- Goals: goal_pose, goals, path, goal_status


class Route(NamedTuple):
    """Goals that came in one message."""

    stamp: tuple[int, int]
    """`sec` and `nanosec`, by which goals are told apart, and which may be anything."""
    frame: str
    """Frame of all of them."""
    poses: tuple[tuple[float, float, float], ...]
    """`(x, y, theta)` of each (m, m, rad)."""
    times: tuple[float, ...] | None = None
    """Time of each since the first (s), of a trajectory."""

    @property
    def time(self) -> int:
        """The stamp as a time (ns), or a MessageError."""
        return from_time(*self.stamp)


class Status(NamedTuple):
    """What a controller reports of a goal."""

    status: int
    """As in action_msgs/GoalStatus."""
    stamp: tuple[int, int]
    """Stamp of the message with the goal, as of a `Route`."""

    @property
    def time(self) -> int:
        """The stamp as a time (ns), or a MessageError."""
        return from_time(*self.stamp)


def _pose(sec: int, nanosec: int, frame: str, *pose: float) -> Route:
    return _route((sec, nanosec), frame, (frame,), [pose])


def _goals(sec: int, nanosec: int, frame: str, frames: Texts, *columns: Column) -> Route:
    count = len(frames)
    if not 1 <= count <= MAX_WAYPOINTS:
        raise GoalError(
            f'goals must contain 1 to {MAX_WAYPOINTS} poses, got {count} ({TO_STOP})',
            (sec, nanosec),
        )
    return _route((sec, nanosec), frame, frames, zip(*columns, strict=True))


def _path(
    sec: int, nanosec: int, frame: str, frames: Texts, secs: Column, nanosecs: Column, *columns: Column
) -> Route:
    count = len(frames)
    if not 2 <= count <= MAX_PATH_POSES:
        raise GoalError(
            f'path must contain 2 to {MAX_PATH_POSES} poses, got {count} ({TO_STOP}; to drive to one '
            'pose, publish goal_pose)',
            (sec, nanosec),
        )
    stamps = zip(secs, nanosecs, strict=True)
    return _route((sec, nanosec), frame, frames, zip(*columns, strict=True), stamps)


def _route(
    stamp: tuple[int, int],
    frame: str,
    frames: Texts,
    poses: Iterable[Column],
    stamps: Iterable[tuple[int, int]] = (),
) -> Route:
    """Return goals, or raise a GoalError.

    Args:
        stamp: Stamp of the message.
        frame: Frame of those that name none.
        frames: Their frames.
        poses: Their poses, as `from_pose` takes them.
        stamps: Their stamps in a path.
    """
    distinct = {one or frame for one in frames}
    try:
        if len(distinct) > 1:
            raise MessageError(f'all poses must be given in one frame, got {quoted(sorted(distinct))}')
        return Route(stamp, distinct.pop(), tuple(from_pose(*pose) for pose in poses), _times([*stamps]))
    except MessageError as error:
        raise GoalError(str(error), stamp) from error


def _times(stamps: list[tuple[int, int]]) -> tuple[float, ...] | None:
    """Return the time of each pose since the first (s), of a trajectory; None: all stamps are equal."""
    if len(set(stamps)) <= 1:
        return None
    times = [from_time(*stamp) for stamp in stamps]
    for index, (one, two) in enumerate(pairwise(times)):
        if one >= two:
            raise MessageError(
                'stamps of the poses must increase, or all be equal for a path without times, got '
                f'{two / NANOSECONDS:.9f} s after {one / NANOSECONDS:.9f} s at pose {index + 1}'
            )
    return tuple((time - times[0]) / NANOSECONDS for time in times)


TO_STOP = 'to stop, call cancel_goal'
POSE = Codec(
    'geometry_msgs/msg/PoseStamped',
    (*STAMP, FRAME, *pose_fields('geometry_msgs/msg/PoseStamped')),
    _pose,
)
GOALS = Codec(
    'nav_msgs/msg/Goals',
    (*STAMP, FRAME, 'goals[].header.frame_id', *(f'goals[].pose.{field}' for field in _POSE)),
    _goals,
)
PATH = Codec(
    'nav_msgs/msg/Path',
    (
        *(*STAMP, FRAME),
        *(f'poses[].header.{field}' for field in ('frame_id', 'stamp.sec', 'stamp.nanosec')),
        *(f'poses[].pose.{field}' for field in _POSE),
    ),
    _path,
)
GOAL_STATUS = Codec(
    'action_msgs/msg/GoalStatus',
    ('status', 'goal_info.stamp.sec', 'goal_info.stamp.nanosec'),
    lambda status, sec, nanosec: Status(status, (sec, nanosec)),
)

# --- Wheels: joint_command, joint_states


class Wheels(NamedTuple):
    """Joints in the order of their message: left, right in those of this package."""

    stamp: int
    """(ns)"""
    joints: tuple[str, ...]
    """Their names."""
    positions: tuple[float, ...]
    """(rad); empty: unknown."""
    velocities: tuple[float, ...]
    """(rad/s); empty: unknown."""

    @classmethod
    def of(
        cls,
        stamp: int,
        joints: tuple[str, ...],
        speeds: tuple[float, float],
        angles: tuple[float, float] | None = None,
    ) -> Wheels:
        """Return both joints, from `(omega_R, omega_L)` (rad/s) and angles (rad) in that order."""
        # Without the cost of the constructor: this runs for each odometry.
        positions = () if angles is None else angles[::-1]
        return tuple.__new__(cls, (stamp, joints, positions, speeds[::-1]))

    def speeds(self, names: tuple[str, str]) -> tuple[float, float]:
        """Return `(omega_R, omega_L)` (rad/s) of the left and the right wheel joint of these names.

        Raises:
            MessageError: A joint is missing, or its velocity is.
        """
        return from_joints(self.joints, self.velocities, names)


class WheelArray(NamedTuple):
    """Speeds of the left and the right wheel (rad/s), without their names and a stamp."""

    velocities: tuple[float, ...]
    stamp: int = 0

    @classmethod
    def of(cls, speeds: tuple[float, float]) -> WheelArray:
        """Return the wheels with the speeds `(omega_R, omega_L)` (rad/s)."""
        return cls(speeds[::-1])

    def speeds(self, names: tuple[str, str]) -> tuple[float, float]:
        """As `Wheels.speeds`."""
        return from_joints(names, self.velocities, names)


def _wheel_numbers(wheels: Wheels) -> tuple[float, ...]:
    stamp, _, positions, velocities = wheels
    return (*divmod(stamp, NANOSECONDS), *positions, *velocities)


JOINT_STATE = Codec(
    'sensor_msgs/msg/JointState',
    (*STAMP, 'name', 'position', 'velocity'),
    lambda sec, nanosec, *values: Wheels(from_time(sec, nanosec), *values),
    (*STAMP, 'position', 'velocity'),
    _wheel_numbers,
)
WHEEL_ARRAY = Codec(
    'std_msgs/msg/Float64MultiArray',
    ('data',),
    WheelArray,
    ('data',),
    attrgetter('velocities'),
)

# --- Events: parameter_events, fault_events


class Changes(NamedTuple):
    """New values of the parameters of a node."""

    node: str
    """Full name of the node."""
    values: dict[str, Any]
    """New values by name; None: the parameter was not set."""
    stamp: int
    """When they changed (ns)."""


class FaultEvent(NamedTuple):
    """What a fault of a lockstep world did."""

    fault: str
    """The fault, as Python source."""
    what: str
    """What it did."""
    kind: str = ''
    """Its class; empty: not recorded."""
    arguments: Mapping[str, Any] = MappingProxyType({})
    """The fields of the class that are numbers or text."""


_VALUES = (
    None,
    *('bool_value', 'integer_value', 'double_value', 'string_value', 'byte_array_value'),
    *('bool_array_value', 'integer_array_value', 'double_array_value', 'string_array_value'),
)
"""Fields of a ParameterValue by its type, the constants of rcl_interfaces/msg/ParameterType."""
_PARAMETER = ('name', 'value.type', *(f'value.{field}' for field in _VALUES if field))


def _parameter_value(kind: int, *values: Any) -> Any:
    if not 0 <= kind < len(_VALUES):
        raise MessageError(f'the type of a parameter must be 0 to {len(_VALUES) - 1}, got {kind}')
    value = values[kind - 1] if kind else None
    return list(value) if isinstance(value, tuple) else value


def _changes(sec: int, nanosec: int, node: str, *columns: tuple[Any, ...]) -> Changes:
    count = len(_PARAMETER)
    parameters = (
        parameter for part in (columns[:count], columns[count:]) for parameter in zip(*part, strict=True)
    )
    values = {name: _parameter_value(*value) for name, *value in parameters}
    return Changes(node, values, from_time(sec, nanosec))


def _fault_event(text: str) -> FaultEvent:
    try:
        fields = json.loads(text)
        fault, what = fields['fault'], fields['what']
        kind, arguments = fields.get('kind', ''), fields.get('arguments', {})
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise MessageError('it must be a JSON object with fault and what') from error
    if not all(isinstance(text, str) for text in (fault, what, kind)):
        raise MessageError('fault, what and kind must be strings')
    if not isinstance(arguments, dict):
        raise MessageError('arguments must be a JSON object')
    return FaultEvent(fault, what, kind, arguments)


PARAMETER_EVENT = Codec(
    'rcl_interfaces/msg/ParameterEvent',
    (
        *('stamp.sec', 'stamp.nanosec', 'node'),
        *(f'new_parameters[].{field}' for field in _PARAMETER),
        *(f'changed_parameters[].{field}' for field in _PARAMETER),
    ),
    _changes,
)
FAULT_EVENT = Codec('std_msgs/msg/String', ('data',), _fault_event)
CLOCK = Codec('rosgraph_msgs/msg/Clock', ('clock.sec', 'clock.nanosec'), from_time)
