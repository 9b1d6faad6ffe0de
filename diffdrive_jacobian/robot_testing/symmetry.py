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

"""Relations of a robot in the plane: what is right in one place is right in another, and in a mirror.

They know the messages of geometry_msgs and those that consist of them, such as those of nav_msgs and of
/tf. Messages of sensor_msgs have no image: define one in a subclass.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Annotated, Any, ClassVar

from diffdrive_jacobian.faults.fault import RosName
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.messages import structure as types
from diffdrive_jacobian.messages.structure import Structure, structure
from diffdrive_jacobian.numerics.checks import Finite, names
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.relations.worlds import Ran

FIXED = ('map', 'odom', 'world', 'earth')
"""Default names of the frames that do not move with a robot, without a prefix."""
POSES = ('geometry_msgs/Pose', 'geometry_msgs/Transform')
TWISTS = ('geometry_msgs/Twist', 'geometry_msgs/Accel', 'geometry_msgs/Wrench')
STAMPED_TWISTS = tuple(f'{name}Stamped' for name in TWISTS)
POINTS = ('geometry_msgs/Point', 'geometry_msgs/Point32')
WITHOUT = ('nav_msgs/OccupancyGrid', 'nav_msgs/MapMetaData', 'geometry_msgs/Inertia')
"""Types without an image, beside those of sensor_msgs."""


@dataclass(frozen=True, repr=False)
class PlaneRelation(Relation):
    """Poses, paths, odometry and goals are changed, and commands must be. Base class.

    Attributes:
        commands: Topic of the commands. The nodes under test are those that publish it, unless `node`
            names one.
        fixed: Frames that do not move with a robot, without a prefix. What is given in another one is
            seen from the robot. What has no frame is not.
    """

    commands: RosName = field(default='cmd_vel', kw_only=True)
    fixed: Annotated[tuple[str, ...], names] = field(default=FIXED, kw_only=True)

    @property
    def topics(self) -> tuple[str, ...]:
        """The topic of the commands."""
        return (self.commands,)

    def _at_topic(self, first: Ran) -> set[str]:
        """Return the nodes that publish commands."""
        return first.publishers(self.commands)

    def image(self, topic: str, message: Any) -> Any:
        """Return the image of a message.

        Raises:
            LockstepError: It has none.
        """
        self._change(structure(type(message)), message, topic, of_robot=False)
        return message

    def _change(self, kind: Structure, message: Any, topic: str, *, of_robot: bool) -> None:
        """Change a message, or a part of one, which is given in the frame of a robot if `of_robot`."""
        frame = getattr(getattr(message, 'header', None), 'frame_id', '')
        if frame:
            of_robot = not self._is_fixed(frame)
        match kind.name:
            case name if name in STAMPED_TWISTS and frame and not of_robot:
                # In a frame that does not move with the robot.
                self._turn_twist(*_twist_of(message))
            case 'geometry_msgs/TransformStamped':
                to_robot = not self._is_fixed(message.child_frame_id)
                if _is_finite(message.transform.translation) and _is_finite(message.transform.rotation):
                    self._transform(message.transform, of_robot=of_robot, to_robot=to_robot)
            case name if name in POSES:
                position = message.position if hasattr(message, 'position') else message.translation
                orientation = (
                    message.orientation if hasattr(message, 'orientation') else message.rotation
                )
                if _is_finite(position) and _is_finite(orientation):
                    self._point(position, of_robot=of_robot)
                    self._rotation(orientation, of_robot=of_robot)
            case 'geometry_msgs/Pose2D':
                self._pose_2d(message, of_robot=of_robot)
            case 'geometry_msgs/PoseWithCovariance':
                self._change(_type(kind, 'pose'), message.pose, topic, of_robot=of_robot)
                message.covariance = self._covariance(message.covariance, of_robot=of_robot)
            case 'geometry_msgs/TwistWithCovariance' | 'geometry_msgs/AccelWithCovariance':
                self._twist(*_twist_of(message))
                message.covariance = self._covariance(message.covariance, of_robot=True)
            case name if name in TWISTS:
                self._twist(*_vectors(message))
            case name if name in POINTS:
                self._point(message, of_robot=of_robot)
            case 'geometry_msgs/Quaternion':
                self._rotation(message, of_robot=of_robot)
            case 'geometry_msgs/Vector3':
                self._vector(message, of_robot=of_robot)
            case name if name in WITHOUT or name.startswith('sensor_msgs/'):
                raise LockstepError(
                    f'{self!r} has no image of {name} on {topic}: define image(topic, message) in a '
                    'subclass'
                )
            case _:
                for name, one in kind.fields:
                    value = getattr(message, name)
                    match one:
                        case Structure():
                            self._change(one, value, topic, of_robot=of_robot)
                        case types.Array(Structure() as element) | types.Sequence(
                            Structure() as element
                        ):
                            for part in value:
                                self._change(element, part, topic, of_robot=of_robot)

    def _is_fixed(self, frame: str) -> bool:
        return frame.rpartition('/')[2] in self.fixed

    @abstractmethod
    def _point(self, point: Any, *, of_robot: bool) -> None:
        """Change a position."""

    @abstractmethod
    def _vector(self, vector: Any, *, of_robot: bool) -> None:
        """Change a direction."""

    @abstractmethod
    def _rotation(self, quaternion: Any, *, of_robot: bool) -> None:
        """Change an orientation."""

    @abstractmethod
    def _pose_2d(self, pose: Any, *, of_robot: bool) -> None:
        """Change a pose in the plane."""

    @abstractmethod
    def _twist(self, linear: Any, angular: Any) -> None:
        """Change a twist of the robot in its own frame."""

    @abstractmethod
    def _turn_twist(self, linear: Any, angular: Any) -> None:
        """Change a twist that is given in a fixed frame."""

    @abstractmethod
    def _covariance(self, covariance: Sequence[float], *, of_robot: bool) -> list[float]:
        """Return the covariance of a pose or of a twist: x, y, z and the rotations about them."""

    @abstractmethod
    def _transform(self, transform: Any, *, of_robot: bool, to_robot: bool) -> None:
        """Change a transform from one frame to another."""


@dataclass(frozen=True, repr=False)
class Moved(PlaneRelation):
    """Elsewhere in the plane the robot is driven in the same way: the commands are equal.

    Positions and headings are turned about the origin by `theta`, then moved by `x` and `y`.

    Attributes:
        x: Displacement in x (m).
        y: Displacement in y (m).
        theta: Rotation (rad).
    """

    x: Finite = 3.0
    y: Finite = -2.0
    theta: Finite = 3.0

    def _point(self, point: Any, *, of_robot: bool) -> None:
        if not of_robot:
            self._vector(point, of_robot=False)
            point.x += self.x
            point.y += self.y

    def _vector(self, vector: Any, *, of_robot: bool) -> None:
        if not of_robot:
            c, s = math.cos(self.theta), math.sin(self.theta)
            vector.x, vector.y = c * vector.x - s * vector.y, s * vector.x + c * vector.y

    def _rotation(self, quaternion: Any, *, of_robot: bool) -> None:
        if of_robot:
            return
        c, s, q = math.cos(self.theta / 2.0), math.sin(self.theta / 2.0), quaternion
        x, y, z, w = c * q.x - s * q.y, c * q.y + s * q.x, c * q.z + s * q.w, c * q.w - s * q.z
        # Of the two that are the same rotation, that which odometry has.
        sign = -1.0 if w < 0.0 else 1.0
        q.x, q.y, q.z, q.w = sign * x, sign * y, sign * z, sign * w

    def _pose_2d(self, pose: Any, *, of_robot: bool) -> None:
        if not of_robot:
            self._point(pose, of_robot=False)
            if math.isfinite(pose.theta):
                pose.theta = math.remainder(pose.theta + self.theta, math.tau)

    def _twist(self, linear: Any, angular: Any) -> None:
        """It stays."""

    def _turn_twist(self, linear: Any, angular: Any) -> None:
        self._vector(linear, of_robot=False)
        self._vector(angular, of_robot=False)

    def _covariance(self, covariance: Sequence[float], *, of_robot: bool) -> list[float]:
        if of_robot:
            return list(covariance)
        c, s = math.cos(self.theta), math.sin(self.theta)
        turn = ((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))
        axes = range(3)
        turned = [0.0] * 36
        # Blocks of three rows and columns: positions and rotations turn alike.
        for up, left in product((0, 3), repeat=2):
            for i, j in product(axes, repeat=2):
                turned[6 * (up + i) + left + j] = sum(
                    turn[i][k] * covariance[6 * (up + k) + left + m] * turn[j][m]
                    for k, m in product(axes, repeat=2)
                    # Not 0 times infinity.
                    if turn[i][k] and turn[j][m]
                )
        return turned

    def _transform(self, transform: Any, *, of_robot: bool, to_robot: bool) -> None:
        if not to_robot:
            self._move_back(transform)
        self._point(transform.translation, of_robot=of_robot)
        self._rotation(transform.rotation, of_robot=of_robot)

    def _move_back(self, transform: Any) -> None:
        """Let a transform lead to a frame that has moved: the opposite motion comes after it."""
        shift, q = transform.translation, transform.rotation
        c, s = math.cos(-self.theta / 2.0), math.sin(-self.theta / 2.0)
        x, y, z, w = c * q.x + s * q.y, c * q.y - s * q.x, c * q.z + s * q.w, c * q.w - s * q.z
        q.x, q.y, q.z, q.w = x, y, z, w
        along_x = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)
        along_y = 2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)
        shift.x -= along_x[0] * self.x + along_y[0] * self.y
        shift.y -= along_x[1] * self.x + along_y[1] * self.y
        shift.z -= along_x[2] * self.x + along_y[2] * self.y


@dataclass(frozen=True, repr=False)
class Mirrored(PlaneRelation):
    """In the mirror the robot is driven in the mirrored way: v is the same, omega is negated.

    Left and right are exchanged: y and rotations about x and z change their signs.
    """

    signs: ClassVar[tuple[float, ...]] = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
    """Of x, y, z and the rotations about them."""

    def _point(self, point: Any, *, of_robot: bool) -> None:
        point.y = -point.y

    def _vector(self, vector: Any, *, of_robot: bool) -> None:
        vector.y = -vector.y

    def _rotation(self, quaternion: Any, *, of_robot: bool) -> None:
        quaternion.x, quaternion.z = -quaternion.x, -quaternion.z

    def _pose_2d(self, pose: Any, *, of_robot: bool) -> None:
        pose.y, pose.theta = -pose.y, -pose.theta

    def _twist(self, linear: Any, angular: Any) -> None:
        linear.y, angular.x, angular.z = -linear.y, -angular.x, -angular.z

    def _turn_twist(self, linear: Any, angular: Any) -> None:
        self._twist(linear, angular)

    def _covariance(self, covariance: Sequence[float], *, of_robot: bool) -> list[float]:
        signs = [one * other for one, other in product(self.signs, repeat=2)]
        return [sign * value for sign, value in zip(signs, covariance, strict=True)]

    def _transform(self, transform: Any, *, of_robot: bool, to_robot: bool) -> None:
        self._vector(transform.translation, of_robot=of_robot)
        self._rotation(transform.rotation, of_robot=of_robot)


def _type(kind: Structure, name: str) -> Structure:
    """Return the type of a field that is a message."""
    found = dict(kind.fields)[name]
    assert isinstance(found, Structure)
    return found


def _vectors(part: Any) -> tuple[Any, Any]:
    """Return both parts of a twist, of a pose, or of what is like one."""
    first, second = (getattr(part, name) for name, _ in structure(type(part)).fields)
    return first, second


def _twist_of(message: Any) -> tuple[Any, Any]:
    """Return both parts of the twist, or what is like one, in a message."""
    kind = structure(type(message))
    inner = next(getattr(message, name) for name, one in kind.fields if str(one) in TWISTS)
    return _vectors(inner)


def _is_finite(part: Any) -> bool:
    """Return whether all numbers of a position or an orientation are finite."""
    return all(math.isfinite(getattr(part, name)) for name, _ in structure(type(part)).fields)
