"""The numbers of messages, however these were published."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.messages.cdr import DecodingError, Reader
from diffdrive_jacobian.messages.codecs import POSE_IN, TWIST_IN, pose_fields, twist_fields
from diffdrive_jacobian.messages.structure import field_value, structure


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
    """Reads fields of messages, which are objects or serialized.

    Several properties read the same message one after the other, so the last serialized one is
    remembered.
    """

    def __init__(self, fields_of: Callable[[type], tuple[str, ...]]) -> None:
        """Start without a type. `fields_of` returns the paths of the fields of a type of messages."""
        self._fields_of = fields_of
        self._readers: dict[type, tuple[tuple[str, ...], Reader]] = {}
        self._last: tuple[type, bytes, tuple[Any, ...] | None] | None = None

    def read(self, message_type: type, message: Any) -> tuple[Any, ...] | None:
        """Return the fields. None: the bytes are not a message of this type."""
        last = self._last
        if last is not None and last[1] is message and last[0] is message_type:
            return last[2]
        if message_type not in self._readers:
            fields = self._fields_of(message_type)
            reader = Reader(message_type, fields, deserialize=deserialize_message)
            self._readers[message_type] = fields, reader
        fields, read = self._readers[message_type]
        if not isinstance(message, bytes):
            return tuple(field_value(message, field) for field in fields)
        values: tuple[Any, ...] | None = None
        with suppress(DecodingError):
            values = read(message)
        self._last = message_type, message, values
        return values


_read_twist = FieldReader(lambda kind: twist_fields(_known(kind, TWIST_IN, 'twist'))).read
_read_pose = FieldReader(lambda kind: pose_fields(_known(kind, POSE_IN, 'pose'))).read


def read_twist(message_type: type, message: Any) -> Twist | None:
    """Return the twist in a message of a type; None: the bytes are invalid.

    Raises:
        LockstepError: Messages of this type have no twist.
    """
    fields = _read_twist(message_type, message)
    return None if fields is None else Twist(float(fields[0]), float(fields[-1]))


def read_pose(message_type: type, message: Any) -> Pose | None:
    """Return the pose in a message of a type; None: the bytes are invalid.

    Raises:
        LockstepError: Messages of this type have no pose.
    """
    fields = _read_pose(message_type, message)
    return None if fields is None else planar(*fields)


def planar(x: float, y: float, qx: float, qy: float, qz: float, qw: float) -> Pose:
    """Return a pose in the plane from a position and a quaternion, which need not be valid."""
    yaw = math.atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
    return Pose(float(x), float(y), yaw)


def _known(message_type: Any, prefixes: dict[str, str], what: str) -> str:
    """Return the name of a type that has a pose or a twist."""
    name = structure(message_type).name.replace('/', '/msg/')
    if name not in prefixes:
        raise LockstepError(
            f'a property reads a {what} from messages of type {", ".join(prefixes)}, got one of type '
            f'{name}: it observes a wrong topic'
        )
    return name
