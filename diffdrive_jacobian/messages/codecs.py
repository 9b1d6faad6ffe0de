"""The messages of the nodes: which fields are read, what value they make, and how it is written.

A `Codec` belongs to a type of message. It reads serialized messages field by field, see `messages.cdr`,
without their Python classes, so that bags are read where no ROS is installed, too. What it reads it
checks, and what it writes it reads again as the same value.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from typing import Any, Generic, NamedTuple, TypeVar

from diffdrive_jacobian.messages.cdr import Reader, Writer
from diffdrive_jacobian.messages.conversion import (
    MAX_PATH_POSES,
    MAX_WAYPOINTS,
    MessageError,
    from_joints,
    from_pose,
    from_time,
    from_twist,
)
from diffdrive_jacobian.time_units import NANOSECONDS

V = TypeVar('V')

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
    numbers: Callable[..., tuple[Any, ...]] = lambda *_: ()
    """Returns these numbers, given the fields of a value."""
    header: Codec[Any] | None = None
    """What is read and checked before the rest, which may be long."""

    def reader(
        self, kind: Any, deserialize: Callable[[bytes, Any], Any] | None = None
    ) -> Callable[[bytes], V]:
        """Return a function that returns the value in a serialized message; arguments as `cdr.Reader`.

        It raises MessageError: DecodingError if the bytes are not a message of the type, and others if
        the value is invalid.
        """
        read, value = Reader(kind, self.fields, deserialize=deserialize), self.value
        if self.header is None:
            return lambda data: value(*read(data))
        first = Reader(kind, self.header.fields, whole=False, deserialize=deserialize)
        check = self.header.value

        def checked(data: bytes) -> V:
            check(*first(data))
            return value(*read(data))

        return checked

    def writer(self, template: Any) -> Writer:
        """Return what serializes values from their fields, with strings and lengths of a template."""
        return Writer(template, self.written, self.numbers)


def twist_fields(type_name: str) -> tuple[str, ...]:
    """Return the fields of a twist for `from_twist` in a type of `TWIST_IN`."""
    prefix = TWIST_IN[type_name]
    return tuple(f'{prefix}{part}.{axis}' for part in ('linear', 'angular') for axis in 'xyz')


def pose_fields(type_name: str) -> tuple[str, ...]:
    """Return the fields of a pose for `from_pose` in a type of `POSE_IN`."""
    return tuple(POSE_IN[type_name] + field for field in _POSE)


_POSE = ('position.x', 'position.y', *(f'orientation.{axis}' for axis in 'xyzw'))
_PLANAR_POSE = ('position.x', 'position.y', 'orientation.z', 'orientation.w')


def _pose_numbers(pose: tuple[float, float, float]) -> tuple[float, float, float, float]:
    x, y, theta = pose
    return x, y, math.sin(theta / 2.0), math.cos(theta / 2.0)


# --- Commands: cmd_vel, cmd_vel_out


class Command(NamedTuple):
    """A body twist to follow."""

    twist: tuple[float, float]
    """`(v, omega)` (m/s, rad/s)."""
    stamp: int = 0
    """From when on (ns); 0: from when it is received."""


TWIST = Codec(
    'geometry_msgs/msg/Twist',
    twist_fields('geometry_msgs/msg/Twist'),
    lambda *twist: Command(from_twist(*twist)),
    ('linear.x', 'angular.z'),
    lambda twist, stamp=0: twist,
)
TWIST_STAMPED = Codec(
    'geometry_msgs/msg/TwistStamped',
    (*STAMP, *twist_fields('geometry_msgs/msg/TwistStamped')),
    lambda sec, nanosec, *twist: Command(from_twist(*twist), from_time(sec, nanosec)),
    (*STAMP, 'twist.linear.x', 'twist.angular.z'),
    lambda twist, stamp: (*divmod(stamp, NANOSECONDS), *twist),
)

# --- Poses: odom, ground_truth, start_pose, initialpose

_ZERO_POSE_COVARIANCE = (0.0,) * 9
_ZERO_TWIST_COVARIANCE = (0.0,) * 4


class Motion(NamedTuple):
    """Pose and twist at a time."""

    stamp: int
    """(ns)"""
    frame: str
    """Frame of the pose."""
    pose: tuple[float, float, float]
    """`(x, y, theta)` (m, m, rad)."""
    twist: tuple[float, float]
    """`(v, omega)` in the body frame (m/s, rad/s)."""
    covariance: tuple[float, ...] = _ZERO_POSE_COVARIANCE
    """Of x, y, theta, row by row; not checked, see `covariances.from_covariance`."""
    twist_covariance: tuple[float, ...] = _ZERO_TWIST_COVARIANCE
    """Of v and omega, row by row; not checked."""


class Place(NamedTuple):
    """A pose at a time."""

    stamp: int
    """(ns)"""
    frame: str
    """Frame of the pose."""
    pose: tuple[float, float, float]
    """`(x, y, theta)` (m, m, rad)."""
    covariance: tuple[float, ...] = _ZERO_POSE_COVARIANCE
    """As of a `Motion`."""


def _motion(sec: int, nanosec: int, frame: str, *values: Any) -> Motion:
    *numbers, of_pose, of_twist = values
    return Motion(
        from_time(sec, nanosec),
        frame,
        from_pose(*numbers[:6]),
        from_twist(*numbers[6:]),
        _planar(of_pose),
        _forward_and_yaw(of_twist),
    )


def _motion_numbers(
    stamp: int,
    frame: str,
    pose: tuple[float, float, float],
    twist: tuple[float, float],
    covariance: tuple[float, ...] = _ZERO_POSE_COVARIANCE,
    twist_covariance: tuple[float, ...] = _ZERO_TWIST_COVARIANCE,
) -> tuple[float, ...]:
    times = divmod(stamp, NANOSECONDS)
    return (*times, *_pose_numbers(pose), *covariance, *twist, *twist_covariance)


def _place(sec: int, nanosec: int, frame: str, *values: Any) -> Place:
    *pose, covariance = values
    return Place(from_time(sec, nanosec), frame, from_pose(*pose), _planar(covariance))


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
MOTION = Codec(
    'nav_msgs/msg/Odometry',
    ODOMETRY.fields[:-2],
    lambda sec, nanosec, frame, *values: Motion(
        from_time(sec, nanosec), frame, from_pose(*values[:6]), from_twist(*values[6:])
    ),
)
"""Odometry without its covariances."""
ODOMETRY_STATE = Codec(
    'nav_msgs/msg/Odometry',
    (
        *(FRAME, 'twist.twist.linear.x', 'twist.twist.angular.z'),
        *pose_fields('nav_msgs/msg/Odometry'),
    ),
    lambda frame, v, omega, *pose: (frame, (v, omega), from_pose(*pose)),
)
"""Frame, twist and pose of an odometry, for the controller. The twist is not checked."""
POSE_WITH_COVARIANCE = Codec(
    'geometry_msgs/msg/PoseWithCovarianceStamped',
    (
        *(*STAMP, FRAME),
        *pose_fields('geometry_msgs/msg/PoseWithCovarianceStamped'),
        'pose.covariance',
    ),
    _place,
    _WRITTEN_PLACE,
    lambda stamp, frame, pose, covariance=_ZERO_POSE_COVARIANCE: (
        *divmod(stamp, NANOSECONDS),
        *_pose_numbers(pose),
        *covariance,
    ),
)

# --- Goals: goal_pose, goals, path, goal_status


class Route(NamedTuple):
    """Goals that came in one message."""

    stamp: tuple[int, int]
    """`sec` and `nanosec`, by which goals are told apart, and which may be anything."""
    frame: str
    """Frame of those that name none."""
    poses: tuple[tuple[float, float, float], ...]
    """`(x, y, theta)` of each (m, m, rad)."""
    frames: tuple[str, ...] = ()
    """Their frames; empty: `frame`."""
    stamps: tuple[tuple[int, int], ...] = ()
    """Their stamps in a path."""

    @property
    def time(self) -> int:
        """The stamp as a time (ns), or a MessageError."""
        return from_time(*self.stamp)

    @property
    def times(self) -> tuple[float, ...] | None:
        """Time of each pose since the first (s), of a trajectory; None: all stamps are equal.

        Raises:
            MessageError: A stamp is none, or the stamps neither increase nor are all equal.
        """
        if len(set(self.stamps)) <= 1:
            return None
        stamps = [from_time(*stamp) for stamp in self.stamps]
        for index, (one, two) in enumerate(pairwise(stamps)):
            if one >= two:
                raise MessageError(
                    'stamps of the poses must increase, or all be equal for a path without times, got '
                    f'{two / NANOSECONDS:.9f} s after {one / NANOSECONDS:.9f} s at pose {index + 1}'
                )
        return tuple((stamp - stamps[0]) / NANOSECONDS for stamp in stamps)


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


def _at_most(most: int, what: str) -> Callable[[int, int, int], tuple[tuple[int, int], int]]:
    def header(sec: int, nanosec: int, count: int) -> tuple[tuple[int, int], int]:
        if count > most:
            raise MessageError(f'{what} must contain at most {most} poses, got {count}')
        return (sec, nanosec), count

    return header


def _poses(columns: Iterable[tuple[float, ...]]) -> tuple[tuple[float, float, float], ...]:
    return tuple(from_pose(*pose) for pose in zip(*columns, strict=True))


POSE = Codec(
    'geometry_msgs/msg/PoseStamped',
    (*STAMP, FRAME, *pose_fields('geometry_msgs/msg/PoseStamped')),
    lambda sec, nanosec, frame, *pose: Route((sec, nanosec), frame, (from_pose(*pose),)),
    (*STAMP, *(f'pose.{field}' for field in _PLANAR_POSE)),
    lambda stamp, frame, poses, *_: (*stamp, *_pose_numbers(poses[0])),
)
GOALS_HEADER = Codec('nav_msgs/msg/Goals', (*STAMP, 'len(goals)'), _at_most(MAX_WAYPOINTS, 'goals'))
"""Stamp and number of poses."""
GOALS = Codec(
    'nav_msgs/msg/Goals',
    (*STAMP, FRAME, 'goals[].header.frame_id', *(f'goals[].pose.{field}' for field in _POSE)),
    lambda sec, nanosec, frame, frames, *columns: Route((sec, nanosec), frame, _poses(columns), frames),
    header=GOALS_HEADER,
)
PATH_HEADER = Codec('nav_msgs/msg/Path', (*STAMP, 'len(poses)'), _at_most(MAX_PATH_POSES, 'path'))
"""Stamp and number of poses."""
PATH = Codec(
    'nav_msgs/msg/Path',
    (
        *(*STAMP, FRAME),
        *(f'poses[].header.{field}' for field in ('frame_id', 'stamp.sec', 'stamp.nanosec')),
        *(f'poses[].pose.{field}' for field in _POSE),
    ),
    lambda sec, nanosec, frame, frames, secs, nanosecs, *columns: Route(
        (sec, nanosec), frame, _poses(columns), frames, tuple(zip(secs, nanosecs, strict=True))
    ),
    header=PATH_HEADER,
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


JOINT_STATE = Codec(
    'sensor_msgs/msg/JointState',
    (*STAMP, 'name', 'position', 'velocity'),
    lambda sec, nanosec, *values: Wheels(from_time(sec, nanosec), *values),
    (*STAMP, 'position', 'velocity'),
    lambda stamp, joints, positions, velocities: (
        *divmod(stamp, NANOSECONDS),
        *positions,
        *velocities,
    ),
)
WHEEL_ARRAY = Codec(
    'std_msgs/msg/Float64MultiArray',
    ('data',),
    WheelArray,
    ('data',),
    lambda velocities, stamp=0: velocities,
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
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise MessageError('it must be a JSON object with fault and what') from error
    if not isinstance(fault, str) or not isinstance(what, str):
        raise MessageError('fault and what must be strings')
    return FaultEvent(fault, what)


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
