"""What is silent in ROS is said: a topic of another type."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from support.domains import domain_id

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros import node as ros_node
from diffdrive_jacobian.ros.runner import make_executor, ros_context


@pytest.mark.parametrize('endpoint', ['publishes', 'subscribes'])
def test_other_type_in_another_process_is_reported_once(monkeypatch, capfd, endpoint):
    from support.harness import Harness

    # Two contexts are two participants, as two processes are; they meet on this machine only.
    monkeypatch.setattr(ros_node, 'WATCH_PERIOD', 0.2)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id()))
    with ros_context(['test']) as context, ros_context(['other']) as other:
        harness = Harness(context, make_executor(context, isolated=False))
        harness.add(VirtualRobot if endpoint == 'publishes' else GoToGoal)
        peer = Node('mismatched', context=other)
        if endpoint == 'publishes':
            peer.create_publisher(TwistStamped, 'cmd_vel', 10)
        else:
            peer.create_subscription(TwistStamped, 'cmd_vel', lambda _: None, 10)
        said = harness.until_said(capfd, 'enable_stamped_cmd_vel')
        looks = []
        harness.peer.create_timer(0.05, lambda: looks.append(capfd.readouterr().err))
        harness.until(lambda: len(looks) == 5, 'more looks')
        harness.close()
        peer.destroy_node()
    theirs, ours = (
        ('publishes', 'subscribes to') if endpoint == 'publishes' else ('subscribes to', 'publishes')
    )
    assert (
        f'/mismatched {theirs} /cmd_vel as geometry_msgs/msg/TwistStamped, but this node {ours} it as '
        'geometry_msgs/msg/Twist: no message will arrive' in said
    )
    assert 'no message will arrive' not in ''.join(looks)


@pytest.mark.parametrize('node_class', [GoToGoal, WheelBridge])
def test_two_types_in_one_process_are_a_clear_error(add, node_class):
    add(VirtualRobot)
    with pytest.raises(ParameterError, match='is enable_stamped_cmd_vel the same for both'):
        add(node_class, enable_stamped_cmd_vel=True)
    add(node_class, 'elsewhere', enable_stamped_cmd_vel=True)
