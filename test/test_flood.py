"""A flood from another process: the robot stops in time, and answers."""

from __future__ import annotations

import forked
import pytest
from nav_msgs.msg import Odometry
from processes import open_world
from std_srvs.srv import Trigger

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


@pytest.fixture
def world(tmp_path):
    with open_world(tmp_path) as world:
        yield world


def test_a_flooded_robot_answers_and_stops_when_the_flood_ends(world):
    robot = world.start('virtual_robot', '--ros-args', '-p', 'cmd_vel_timeout:=0.3')
    odometry = world.harness.listen(Odometry, 'odom')
    world.harness.until(lambda: odometry, 'the robot is heard')
    # Two processes, so that there are more messages than can be handled also on a busy machine.
    floods = [forked.Popen(FLOOD) for _ in range(2)]
    try:
        robot.until_says('arrive faster than they are handled')
        assert world.harness.call(Trigger, 'reset_odometry').success
        odometry.clear()
        world.harness.until(lambda: odometry and moves(odometry[-1]), 'the robot moves')
    finally:
        for flood in floods:
            flood.kill()
            flood.wait()
    world.harness.until(lambda: not moves(odometry[-1]), 'the robot stops')


def moves(message):
    return message.twist.twist.linear.x != 0.0
