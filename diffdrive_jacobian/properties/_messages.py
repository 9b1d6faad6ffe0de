"""The numbers of messages, however these were published."""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import attrgetter
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.messages.cdr import DecodingError, Reader

_TWISTS = {
    'Twist': '',
    'TwistStamped': 'twist.',
    'Odometry': 'twist.twist.',
    'TwistWithCovarianceStamped': 'twist.twist.',
}
"""Where the twist is, by the names of the types of messages."""
_POSE = ('position.x', 'position.y', *(f'orientation.{name}' for name in 'xyzw'))
_POSES = {'PoseStamped': 'pose.', 'Odometry': 'pose.pose.', 'PoseWithCovarianceStamped': 'pose.pose.'}
"""Where the pose is, by the names of the types of messages."""


class Pose(NamedTuple):
    """A pose in the plane."""

    x: float
    """(m)"""
    y: float
    """(m)"""
    theta: float
    """(rad), from -pi to pi."""

    def __str__(self) -> str:
        return f'x {self.x:.6g} m, y {self.y:.6g} m, theta {self.theta:.6g} rad'

    def distance(self, other: Pose) -> float:
        """Return the distance to another pose (m)."""
        return math.hypot(self.x - other.x, self.y - other.y)


class Twist(NamedTuple):
    """A body twist."""

    v: float
    """(m/s)"""
    omega: float
    """(rad/s)"""

    def __str__(self) -> str:
        return f'v {self.v:.6g} m/s, omega {self.omega:.6g} rad/s'

    @property
    def is_zero(self) -> bool:
        """Whether both are zero."""
        return self.v == 0.0 and self.omega == 0.0


class FieldReader:
    """Reads fields of messages, which are objects or serialized. Compiled for the first message."""

    def __init__(self, fields_of: Callable[[type], tuple[str, ...]]) -> None:
        """Start without a type. `fields_of` returns the paths of the fields of a type of messages."""
        self._fields_of = fields_of
        self._type: type | None = None
        self._from_bytes: Callable[[bytes], tuple[Any, ...]]
        self._from_object: Callable[[Any], tuple[Any, ...]]

    def read(self, message_type: type, message: Any) -> tuple[Any, ...] | None:
        """Return the fields. None: the bytes are not a message of this type."""
        if message_type is not self._type:
            fields = self._fields_of(message_type)
            self._from_object = attrgetter(*fields)
            self._from_bytes = Reader(message_type, fields, deserialize=deserialize_message)
            self._type = message_type
        if isinstance(message, bytes):
            try:
                return self._from_bytes(message)
            except DecodingError:
                return None
        return self._from_object(message)


def twist_reader() -> Callable[[type, Any], Twist | None]:
    """Return a function that returns the twist in a message of a type; None: the bytes are invalid.

    It raises TypeError for a type without a twist.
    """
    read = FieldReader(
        lambda kind: tuple(_prefix(kind, _TWISTS, 'twist') + name for name in ('linear.x', 'angular.z'))
    ).read

    def twist(message_type: type, message: Any) -> Twist | None:
        fields = read(message_type, message)
        return None if fields is None else Twist(float(fields[0]), float(fields[1]))

    return twist


def pose_reader() -> Callable[[type, Any], Pose | None]:
    """Return a function that returns the pose in a message of a type; None: the bytes are invalid.

    It raises TypeError for a type without a pose.
    """
    read = FieldReader(lambda kind: tuple(_prefix(kind, _POSES, 'pose') + name for name in _POSE)).read

    def pose(message_type: type, message: Any) -> Pose | None:
        fields = read(message_type, message)
        return None if fields is None else planar(*fields)

    return pose


def planar(x: float, y: float, qx: float, qy: float, qz: float, qw: float) -> Pose:
    """Return a pose in the plane from a position and a quaternion, which need not be valid."""
    yaw = math.atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
    return Pose(float(x), float(y), yaw)


def _prefix(message_type: type, prefixes: dict[str, str], what: str) -> str:
    if message_type.__name__ not in prefixes:
        raise TypeError(
            f'a {what} is read from {", ".join(prefixes)}, got a message of type {message_type.__name__}'
        )
    return prefixes[message_type.__name__]
