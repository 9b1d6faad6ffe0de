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

"""The world of exercise 10: a node with the function of a hand-in, and a robot. Needs rclpy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node

from diffdrive_jacobian import faults
from diffdrive_jacobian.grading import HandIn
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.properties import StopsAfterLostOdometry
from diffdrive_jacobian.testing import Lockstep, PropertyViolation

PERIOD = 0.05
"""Time between two commands (s)."""


class Commander(Node):  # type: ignore[misc]
    """Asks the hand-in for a command, again and again."""

    def __init__(self, hand_in: HandIn, goal: NDArray[np.float64], **kwargs: Any) -> None:
        """Start without odometry."""
        super().__init__('commander', **kwargs)
        self._hand_in, self._goal = hand_in, goal
        self._pose: NDArray[np.float64] | None = None
        self._received = 0
        self._cmd_vel = self.create_publisher(Twist, 'cmd_vel', 10)
        self.create_subscription(Odometry, 'odom', self._on_odometry, 10)
        self.create_timer(PERIOD, self._on_timer)

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _on_odometry(self, message: Odometry) -> None:
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        theta = 2.0 * math.atan2(turn.z, turn.w)
        self._pose, self._received = np.array([place.x, place.y, theta]), self._now()

    def _on_timer(self) -> None:
        age = None if self._pose is None else (self._now() - self._received) * 1e-9
        v, omega = self._hand_in.array('command', self._pose, age, self._goal, shape=(2,)).tolist()
        message = Twist()
        message.linear.x, message.angular.z = v, omega
        self._cmd_vel.publish(message)


def world_of(hand_in: HandIn, goal: NDArray[np.float64]) -> tuple[float, str]:
    """Return the distance to the goal after 30 s (m), and what was violated; '': nothing."""
    with Lockstep() as world:
        context = world.node.context
        robot = world.add(VirtualRobot(context=context))
        world.add(Commander(hand_in, goal, context=context))
        world.inject(faults.Loss('odom', start=1.0, duration=2.0))
        world.require(StopsAfterLostOdometry(within=0.5))
        try:
            world.run_for(30.0)
        except PropertyViolation as violation:
            return math.inf, str(violation).partition('\n')[0]
        x, y, _ = robot.truth
        return math.dist((x, y), goal.tolist()), ''
