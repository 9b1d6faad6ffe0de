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

"""Scenarios that the tests of the exploration run. Small: a world takes some 30 ms."""

from __future__ import annotations

import os
import sys
import uuid
from itertools import count

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Twist, Vector3
from rclpy.node import Node

from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.properties import NeverFasterThan

PERIOD = 0.1
TIMEOUT = None
"""Age at which the follower ignores the last reading (s): None, which is its defect."""


def serial(scenario, properties=(), **arguments):
    """Explore in this thread."""
    # Not for the processes of worlds, which import this module.
    from diffdrive_jacobian.testing import SerialExecutor, explore

    return explore(scenario, properties, **{'executor': SerialExecutor(), **arguments})


def nothing(world, case):
    """Do nothing."""


def failing(world, case):
    """Fail with large numbers."""
    assert case < 60


class Sensor(Node):
    """Publishes a speed ten times a second."""

    def __init__(self, speed):
        super().__init__('sensor', start_parameter_services=False)
        self.speed = float(speed)
        self.publisher = self.create_publisher(Vector3, 'speed', 10)
        self.create_timer(PERIOD, self.on_timer)

    def on_timer(self):
        self.publisher.publish(Vector3(x=self.speed))


class Follower(Node):
    """Commands the speed of the last reading plus its age: too fast when readings are lost."""

    def __init__(self):
        super().__init__('follower', start_parameter_services=False)
        self.ticks, self.speed = 0, 0.0
        self.publisher = self.create_publisher(Twist, 'cmd_vel', 10)
        self.create_subscription(Vector3, 'speed', self.on_speed, 10)
        self.create_timer(PERIOD, self.on_timer)

    def on_speed(self, message):
        self.ticks, self.speed = 0, message.x

    def on_timer(self):
        self.ticks += 1
        age = PERIOD * self.ticks
        stale = TIMEOUT is not None and age > TIMEOUT
        command = Twist()
        command.linear.x = 0.0 if stale else self.speed + age
        self.publisher.publish(command)


def follow(world, case):
    """Run both for 1.2 s."""
    case = case or {}
    world.create(lambda: Sensor(case.get('speed', 0.0)))
    world.create(Follower)
    world.run_for(1.2)


def demanding(world, case):
    """Require a property of its own, which the robot breaks."""
    world.require(NeverFasterThan(0.1, 1.0))
    follow(world, {'speed': 1.0})


class Dividing(Follower):
    """Divides by the speed that it reads."""

    def on_speed(self, message):
        self.speed = 1.0 / message.x


def divide(world, case):
    """Let a node fail that divides by the speed."""
    world.create(lambda: Sensor(case['speed']))
    world.create(Dividing)
    world.run_for(0.2)
    assert case['speed'] < 3.0, 'too fast'


_calls = count()


def changing(world, case):
    """Depend on the number of worlds that this process has run."""
    world.create(lambda: Sensor(next(_calls)))
    world.run_for(0.2)
    if case['speed'] > 1.0:
        raise ValueError('fast')


def identified(world, case):
    """Publish a random identifier, as a goal has it, and fail."""
    publisher = world.node.create_publisher(GoalStatus, 'goal_status', 10)
    status = GoalStatus()
    status.goal_info.goal_id.uuid = list(uuid.uuid4().bytes)
    publisher.publish(status)
    raise ValueError('always')


def robot(world, case):
    """Command a robot to go faster and faster."""
    world.create(VirtualRobot)
    world.create(Follower)
    world.run_for(0.5)


def deadly(world, case):
    """End the process."""
    if case['speed'] == 2.0:
        os._exit(3)


def crowded(world, case):
    """Read the standard input to its end, and fail in a process that has run a world before."""
    assert sys.stdin.read() == ''
    assert next(_calls) == 0, 'not the first'


def moving(world, case):
    """Change the working directory, and fail."""
    os.chdir('/')
    raise ValueError('moved')


def mute(world, case):
    """Let a node hear a sensor, and say nothing."""
    world.create(lambda: Sensor(1.0))
    listener = world.create(lambda: Node('listener', start_parameter_services=False))
    listener.create_subscription(Vector3, 'speed', lambda _: None, 10)
    world.run_for(0.3)
