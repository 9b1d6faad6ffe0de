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

"""The base class of the properties of a robot's motion."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rclpy.publisher import Publisher

from diffdrive_jacobian.faults.fault import RosName
from diffdrive_jacobian.properties.base import Property
from diffdrive_jacobian.robot_testing.readings import Pose, Twist, read_pose, read_twist


@dataclass(repr=False)
class MotionProperty(Property):
    """A property of the motion in the odometry. Base class.

    Attributes:
        odom: Topic of type Odometry (default: 'odom'). 'ground_truth' for the true pose of a virtual
            robot that drifts.
    """

    odom: RosName = field(default='odom', kw_only=True)

    def begin(self) -> None:
        """Begin to observe the last pose and twist in the odometry."""
        self.pose: Pose | None = None
        self.twist: Twist | None = None
        self._odom = self.on_published(self.odom, self._on_odometry, raw=True)

    def _on_odometry(self, publisher: Publisher, message: Any) -> None:
        self.pose = read_pose(publisher.msg_type, message)
        self.twist = read_twist(publisher.msg_type, message)
        if self.pose is None or self.twist is None:
            self.on_invalid()
        else:
            self.on_motion(self.pose, self.twist)

    def on_motion(self, pose: Pose, twist: Twist) -> None:
        """Receive a message of the odometry."""

    def on_invalid(self) -> None:
        """Receive bytes that are no Odometry."""
