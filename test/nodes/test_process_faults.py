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

"""Nodes as processes: ended by signals, killed, flooded, and sent hostile messages."""

from __future__ import annotations

import math
import random
import signal
from contextlib import suppress

import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Goals, Odometry
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger
from support.damaged_messages import damaged
from support.processes import Drive, start_python
from support.ros_messages import at_rest, goal, goals, odometry

from diffdrive_jacobian.ros.rclpy_internals import RCLError

pytestmark = pytest.mark.process


@pytest.fixture
def driving(world):
    """Return a robot and a controller that drive to a goal far away, and the publisher of goals."""
    drive = Drive(world)
    sender = world.harness.talk(PoseStamped, 'goal_pose')
    sender.publish(goal(50, 0))
    world.harness.until(lambda: drive.drives() and drive.commands, 'the robot drives')
    return drive, sender


def test_a_controller_that_a_signal_ends_publishes_a_last_zero(world, driving):
    drive, _ = driving
    drive.controller.signal(signal.SIGTERM)
    assert drive.controller.exit() == 0
    world.harness.until(lambda: drive.commands[-1] == Twist(), 'the last command is zero')
    assert 'Traceback' not in drive.controller.stderr


def test_a_robot_stops_when_its_controller_is_killed_and_another_one_drives_on(world, driving):
    drive, sender = driving
    drive.controller.signal(signal.SIGKILL)
    drive.controller.exit()
    world.harness.until(drive.stands, 'the robot stands')
    assert drive.commands[-1] != Twist()
    world.start('go_to_goal').until_says('subscribed to')
    at = drive.odometry[-1].pose.pose.position
    drive.odometry.clear()

    def arrived():
        # The new controller may discover the sender late.
        if len(drive.odometry) > 25:
            drive.odometry.clear()
            sender.publish(goal(at.x + 0.1, at.y))
        return any(one.status == GoalStatus.STATUS_SUCCEEDED for one in drive.status)

    world.harness.until(arrived, 'the robot arrives')


def test_hostile_messages_neither_end_a_controller_nor_reach_its_commands(world):
    chance, data = random.Random(1), serialize_message(goals(goal(3, 0), goal(3, 0)))
    controller = world.start('go_to_goal')
    commands = world.harness.listen(Twist, 'cmd_vel')
    hostile = world.harness.talk(Goals, 'goals')
    seen = world.harness.talk(Odometry, 'odom')
    for _ in range(200):
        # Fast DDS publishes none that are empty, or longer than a message of the type can be.
        with suppress(RCLError):
            hostile.publish(damaged(chance, data))
        seen.publish(odometry(0, 0, 0))
        world.harness.executor.spin_once(timeout_sec=0.002)
    published = commands[:]
    commands.clear()

    def drives():
        hostile.publish(goals(goal(3, 0)))
        seen.publish(odometry(0, 0, 0))
        return commands and commands[-1].linear.x > 0.0

    world.harness.until(drives, 'it drives to a valid goal')
    assert controller.running
    assert all(math.isfinite(one.linear.x) and math.isfinite(one.angular.z) for one in published)
    lines = controller.stderr.splitlines()
    assert len(lines) < 60
    assert all(map(str.isprintable, lines))
    assert 'Traceback' not in controller.stderr


FLOOD = """
import rclpy
from geometry_msgs.msg import Twist
from rclpy.node import Node
from rclpy.serialization import serialize_message

rclpy.init()
publisher = Node('flood', start_parameter_services=False).create_publisher(Twist, 'cmd_vel', 10)
twist = Twist()
twist.linear.x = 0.2
data = serialize_message(twist)
while True:
    publisher.publish(data)
"""


def test_a_flooded_robot_answers_and_stops_when_the_flood_ends(world):
    robot = world.start('virtual_robot', '--ros-args', '-p', 'cmd_vel_timeout:=0.3')
    odometry = world.harness.listen(Odometry, 'odom')
    world.harness.until(lambda: odometry, 'the robot is heard')
    # Two processes, so that there are more messages than can be handled also on a busy machine.
    floods = [start_python(FLOOD) for _ in range(2)]
    try:
        robot.until_says('arrive faster than they are handled')
        assert world.harness.call(Trigger, 'reset_odometry').success
        odometry.clear()
        world.harness.until(lambda: odometry and not at_rest(odometry[-1]), 'the robot moves')
    finally:
        for flood in floods:
            flood.kill()
            flood.wait()
    world.harness.until(lambda: at_rest(odometry[-1]), 'the robot stops')
