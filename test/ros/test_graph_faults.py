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

"""What is wrong in the graph is reported by the nodes around it."""

from __future__ import annotations

import re

import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from support.domains import domain_id
from support.harness import Harness

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros import node as ros_node
from diffdrive_jacobian.ros.node import FAULT_PATIENCE
from diffdrive_jacobian.ros.runner import make_executor, ros_context


@pytest.fixture
def create():
    """Return a function that creates a node in a namespace."""
    nodes = []
    with ros_context(['test']) as context:

        def create(node_class, namespace, **named):
            nodes.append(node_class(context=context, namespace=namespace, **named))
            return nodes[-1]

        yield create
        for node in nodes:
            node.destroy_node()


def check(*nodes, times=FAULT_PATIENCE):
    """Let nodes check the graph, as their timers do once a second."""
    for _ in range(times):
        for node in nodes:
            node._check_graph()


def test_a_fault_is_reported_each_time_that_it_appears_by_each_node(create, capfd):
    robots = [create(VirtualRobot, name) for name in ('a', 'b')]
    other = create(Node, '', node_name='other')
    check(*robots, times=20)
    for _ in range(2):
        publishers = [other.create_publisher(Odometry, f'/{name}/odom', 1) for name in 'ab']
        check(*robots, times=FAULT_PATIENCE - 1)
        assert 'publish /a/odom' not in capfd.readouterr().err
        check(*robots, times=1)
        said = capfd.readouterr().err
        assert '/a/virtual_robot and /other publish /a/odom' in said
        assert '/b/virtual_robot and /other publish /b/odom' in said
        for publisher in publishers:
            other.destroy_publisher(publisher)
        check(*robots, times=20)


def test_other_types_are_reported_once_until_they_are_gone(create, capfd, monkeypatch):
    controller = create(GoToGoal, 'a')
    infos = [info for _ in range(2) for info in controller.get_publishers_info_by_topic('/a/cmd_vel')]
    for info, other in zip(infos, ('TwistStamped', 'Vector3'), strict=True):
        info.topic_type = f'geometry_msgs/msg/{other}'
    monkeypatch.setattr(controller, 'get_subscriptions_info_by_topic', lambda _: infos)

    def reported():
        check(controller)
        pattern = r'subscribes to /a/cmd_vel as geometry_msgs/msg/(\w+), but this node publishes it as'
        return sorted(re.findall(pattern, capfd.readouterr().err))

    assert reported() == ['TwistStamped', 'Vector3']
    assert reported() == []
    found = infos.pop()
    assert reported() == ['TwistStamped']
    infos.append(found)
    assert reported() == ['TwistStamped', 'Vector3']


def test_a_topic_of_another_type_in_another_process_is_reported(monkeypatch, capfd):
    """Two contexts are two participants, as two processes are."""
    monkeypatch.setattr(ros_node, 'WATCH_PERIOD', 0.1)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id()))
    with ros_context(['test']) as context, ros_context(['other']) as other:
        harness = Harness(context, make_executor(context, isolated=False))
        harness.add(VirtualRobot)
        peer = Node('mismatched', context=other)
        peer.create_publisher(TwistStamped, 'cmd_vel', 10)
        said = harness.until_said(capfd, 'enable_stamped_cmd_vel')
        harness.close()
        peer.destroy_node()
    assert '/mismatched publishes /cmd_vel as geometry_msgs/msg/TwistStamped' in said
    assert 'but this node subscribes to it as geometry_msgs/msg/Twist' in said


@pytest.mark.parametrize('node_class', [GoToGoal, WheelBridge])
def test_two_types_in_one_process_are_a_clear_error(add, node_class):
    add(VirtualRobot)
    with pytest.raises(ParameterError, match='is enable_stamped_cmd_vel the same for both'):
        add(node_class, enable_stamped_cmd_vel=True)
    add(node_class, 'elsewhere', enable_stamped_cmd_vel=True)
