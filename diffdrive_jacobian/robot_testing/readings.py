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

"""Poses and twists in messages."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.messages.codecs import POSE_IN, TWIST_IN, pose_fields, twist_fields
from diffdrive_jacobian.messages.structure import structure
from diffdrive_jacobian.robot_testing.fields import field_reader


class Pose(NamedTuple):
    """A pose in the plane (m, m, rad), theta from -pi to pi."""

    x: float
    y: float
    theta: float

    def __str__(self) -> str:
        """Return the values with their units."""
        return f'x {self.x:.6g} m, y {self.y:.6g} m, theta {self.theta:.6g} rad'

    def distance(self, other: Pose) -> float:
        """Return the distance to another pose (m)."""
        return math.hypot(self.x - other.x, self.y - other.y)


class Twist(NamedTuple):
    """A body twist (m/s, rad/s)."""

    v: float
    omega: float

    def __str__(self) -> str:
        """Return the values with their units."""
        return f'v {self.v:.6g} m/s, omega {self.omega:.6g} rad/s'

    @property
    def is_zero(self) -> bool:
        """Whether both are zero."""
        return self.v == 0.0 and self.omega == 0.0

    def is_within(self, v: float, omega: float) -> bool:
        """Whether neither is larger than a limit. NaN is not."""
        return abs(self.v) <= v and abs(self.omega) <= omega


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
