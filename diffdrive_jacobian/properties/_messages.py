"""The numbers of messages, however these were published."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from functools import cache, lru_cache
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.messages.cdr import DecodingError, Reader
from diffdrive_jacobian.messages.codecs import POSE_IN, TWIST_IN, pose_fields, twist_fields
from diffdrive_jacobian.messages.structure import field_value, structure


class Pose(NamedTuple):
    """A pose in the plane (m, m, rad), theta from -pi to pi."""

    x: float
    y: float
    theta: float

    def __str__(self) -> str:
        return f'x {self.x:.6g} m, y {self.y:.6g} m, theta {self.theta:.6g} rad'

    def distance(self, other: Pose) -> float:
        """Return the distance to another pose (m)."""
        return math.hypot(self.x - other.x, self.y - other.y)


class Twist(NamedTuple):
    """A body twist (m/s, rad/s)."""

    v: float
    omega: float

    def __str__(self) -> str:
        return f'v {self.v:.6g} m/s, omega {self.omega:.6g} rad/s'

    @property
    def is_zero(self) -> bool:
        """Whether both are zero."""
        return self.v == 0.0 and self.omega == 0.0

    def is_within(self, v: float, omega: float) -> bool:
        """Whether neither is larger than a limit. NaN is not."""
        return abs(self.v) <= v and abs(self.omega) <= omega


Read = Callable[[type, Any], tuple[Any, ...] | None]


def field_reader(fields_of: Callable[[type], tuple[str, ...]]) -> Read:
    """Return a function that reads fields of a message, from its type and its object or its bytes.

    It returns None if the bytes are not a message of the type.

    Args:
        fields_of: Returns the paths of the fields of a type of messages.
    """

    @cache
    def compiled(message_type: type) -> tuple[tuple[str, ...], Reader]:
        fields = fields_of(message_type)
        return fields, Reader(message_type, fields, deserialize=deserialize_message)

    # Several properties read the same message one after the other.
    @lru_cache(1)
    def read_bytes(message_type: type, message: bytes) -> tuple[Any, ...] | None:
        with suppress(DecodingError):
            fields: tuple[Any, ...] = compiled(message_type)[1](message)
            return fields
        return None

    def read(message_type: type, message: Any) -> tuple[Any, ...] | None:
        fields, _ = compiled(message_type)
        if isinstance(message, bytes):
            return read_bytes(message_type, message)
        return tuple(field_value(message, field) for field in fields)

    return read


_read_twist = field_reader(lambda kind: twist_fields(_known(kind, TWIST_IN, 'twist')))
_read_pose = field_reader(lambda kind: pose_fields(_known(kind, POSE_IN, 'pose')))


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
