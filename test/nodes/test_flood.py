"""A flood from another process: the robot stops in time, and answers."""

from __future__ import annotations

from pathlib import Path

import pytest
from fork_server import forked
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros.runner import ros_context

NODES = {'virtual_robot': VirtualRobot, 'wheel_bridge': WheelBridge, 'go_to_goal': GoToGoal}
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


@pytest.mark.process
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


@pytest.fixture
def benchmark(monkeypatch):
    """The module `benchmark/flood.py`."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / 'benchmark'))
    import flood

    return flood


def test_the_benchmark_floods_topics_and_services_that_exist(benchmark):
    for node_name, arguments in {(one.node, one.arguments) for one in benchmark.CASES}:
        cases = [one for one in benchmark.CASES if (one.node, one.arguments) == (node_name, arguments)]
        with ros_context(['test', '--ros-args', *arguments]) as context:
            node = NODES[node_name](context=context)
            topics = {one.topic_name for one in node.subscriptions}
            services = {one.service_name for one in node.services}
            node.destroy_node()
        for case in cases:
            name = case.flooded.removesuffix('_stamped')
            assert {f'/{name}', f'/{node_name}/{name}'} & (topics | services), case


def moves(message):
    return message.twist.twist.linear.x != 0.0
