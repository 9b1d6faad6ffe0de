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

"""Small nodes and messages for the tests of properties."""

from __future__ import annotations

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from std_srvs.srv import Trigger
from support.lockstep_nodes import LEAN
from support.ros_messages import goal, odometry, twist

TOPICS = {
    Odometry: 'odom',
    Twist: 'cmd_vel',
    PoseStamped: 'goal_pose',
    Path: 'path',
    GoalStatus: 'goal_status',
}


class Scene:
    """Publishes messages on their topics, with time between them, and finishes."""

    def __init__(self, world):
        self._world, self._publishers = world, {}

    def send(self, message, topic=None):
        """Publish a message, whether or not there is a subscription."""
        key = type(message), topic or TOPICS[type(message)]
        if key not in self._publishers:
            self._publishers[key] = self._world.node.create_publisher(*key, 10)
        self._publishers[key].publish(message)

    def __call__(self, *events):
        for event in events:
            if isinstance(event, float):
                self._world.run_for(event)
            else:
                self.send(event)
                self._world.settle()
        self._world.finish()


class Student(Node):
    """A controller that answers odometry with the command that it is told."""

    def __init__(self, name='student', timeout=0.0):
        super().__init__(name, **LEAN)
        self.command = twist(0.2)
        self.commands = self.create_publisher(Twist, 'cmd_vel', 10)
        self.create_subscription(Odometry, 'odom', self.on_odometry, 10)
        self.create_subscription(PoseStamped, 'goal_pose', lambda _: None, 10)
        self.create_service(Trigger, 'cancel_goal', self.on_cancel)
        self.watchdog = self.create_timer(timeout, self.on_stale) if timeout else None

    def on_odometry(self, _):
        self.commands.publish(self.command)
        if self.watchdog:
            self.watchdog.reset()

    def on_stale(self):
        self.commands.publish(twist(0.0))

    def on_cancel(self, _, response):
        return response


def odometry_at(x, y=0.0, v=0.0, theta=0.0):
    message = odometry(x, y, theta)
    message.twist.twist = twist(v)
    return message


def goal_at(x, y=0.0, stamp=0):
    return goal(x, y, stamp=stamp)


def status(number, stamp=1, uuid=1):
    message = GoalStatus(status=number)
    message.goal_info.stamp.sec = stamp
    message.goal_info.goal_id.uuid[0] = uuid
    return message
