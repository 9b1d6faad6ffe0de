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

"""What is silent in ROS is reported: forgotten nodes, several publishers, driving by hand, integers."""

from __future__ import annotations

import struct

import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from support.lockstep_nodes import ACCEPTED, CANCELED, EXECUTING, SUCCEEDED, Controller, Topics
from support.ros_messages import goal, goals, joint_command, placement, twist, twists

from diffdrive_jacobian.nodes import other_drivers
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros.node import FAULT_PATIENCE

WHEELS = {'command_interface': 'wheels'}


def check(node, times=FAULT_PATIENCE):
    """Let a node check the graph, as its timer does once a second."""
    for _ in range(times):
        node._check_graph()


def said(capfd):
    return capfd.readouterr().err


@pytest.fixture
def node(lockstep):
    """Another node, and a way to create publishers and subscriptions of it."""
    return lockstep.node


# --- Forgotten nodes

TOPICS = ('odom', 'cmd_vel', 'joint_command', 'goal_pose', 'goals', 'goal_status')
REMAPPED = [argument for name in TOPICS for argument in ('-r', f'{name}:=my_{name}')]
CASES = [
    (GoToGoal, {}, [], 'no node is subscribed to /my_cmd_vel: start virtual_robot'),
    (GoToGoal, {}, [(Odometry, 'my_odom')] * 2, '(2 times) publish /my_odom: their poses alternate'),
    (GoToGoal, {}, [(GoalStatus, 'my_goal_status')], 'publish /my_goal_status: two controllers'),
    (WheelBridge, {}, [], 'no node is subscribed to /my_joint_command: start virtual_robot with'),
    (VirtualRobot, WHEELS, [], 'no node publishes /my_joint_command: start wheel_bridge'),
    (VirtualRobot, {}, [(PoseStamped, 'my_goal_pose')], 'but no controller is subscribed to it'),
    (VirtualRobot, {}, [(Odometry, 'my_odom')], 'publish /my_odom: their poses alternate'),
]


@pytest.mark.parametrize(('node_class', 'parameters', 'publishers', 'expected'), CASES, ids=range(7))
def test_a_missing_or_second_node_is_reported_once(
    lockstep, node, capfd, node_class, parameters, publishers, expected
):
    """By the names of topics after remapping."""
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    one = lockstep.add(node_class(cli_args=['--ros-args', *REMAPPED], parameter_overrides=overrides))
    for kind, name in publishers:
        node.create_publisher(kind, name, 10)
    check(one, FAULT_PATIENCE - 1)
    assert expected not in said(capfd)
    check(one, 3 * FAULT_PATIENCE)
    assert said(capfd).count(expected) == 1


def test_nothing_is_reported_of_a_complete_team(lockstep, team, capfd):
    lockstep.publish('goals', goals(goal(0.2, 0.0)))
    lockstep.run_until(lambda: team.statuses[-1:] == [SUCCEEDED], 30.0, 'arrival')
    for one in (team.robot, team.bridge, team.controller):
        check(one, 2 * FAULT_PATIENCE)
    assert '[WARN]' not in said(capfd)


# --- Several drivers


@pytest.mark.parametrize(('node_class', 'stamped'), [(VirtualRobot, False), (WheelBridge, True)])
def test_alternating_commands_are_reported_and_zeros_are_not(
    lockstep, add, node, capfd, node_class, stamped
):
    driven = add(node_class, enable_stamped_cmd_vel=stamped)
    lockstep.listen(JointState, 'joint_command')
    kind = TwistStamped if stamped else Twist
    drivers = [node.create_publisher(kind, 'cmd_vel', 10) for _ in range(2)]

    def drive(*speeds):
        for _ in range(4):
            for publisher, speed in zip(drivers, speeds, strict=True):
                message = twist(speed, 0.0)
                publisher.publish(TwistStamped(twist=message) if stamped else message)
        lockstep.run_for(0.1)
        check(driven, 1)

    for _ in range(5):
        drive(0.5, 0.0)
    assert 'alternate' not in said(capfd)
    for _ in range(5):
        drive(0.5, 0.3)
    text = said(capfd)
    assert text.count('publish /cmd_vel, and their commands alternate: stop one of them') == 1
    assert '/lockstep (2 times)' in text


def test_driving_by_hand_cancels_the_goal(lockstep, add, node, capfd):
    team = Topics(lockstep)
    add(VirtualRobot)
    add(GoToGoal, linear__x__max_velocity=0.5)
    lockstep.publish('goals', goals(goal(50.0, 0.0)))
    lockstep.run_for(0.2)
    # As of a joystick that nobody touches.
    joystick = node.create_publisher(Twist, 'cmd_vel', 10)
    lockstep.run_for(1.1)
    joystick.publish(Twist())
    lockstep.run_for(0.1)
    assert team.statuses[-1] == EXECUTING
    joystick.publish(twist(0.25, 0.0))
    lockstep.run_for(0.1)
    assert team.statuses[-1] == CANCELED
    text = said(capfd)
    assert '/lockstep drives the robot by /cmd_vel, so the goal' in text
    assert '/go_to_goal or' not in text
    # Which of both commands came last is unknown, so the robot is stopped, once.
    assert twists(team.commands)[-1] == (0.0, 0.0)
    before = len(team.commands)
    lockstep.run_for(0.2)
    assert len(team.commands) == before
    # Without a goal the hand drives.
    joystick.publish(twist(0.1, 0.0))
    lockstep.run_for(0.1)
    assert team.odom[-1].twist.twist.linear.x == 0.1
    assert 'drives the robot' not in said(capfd)


@pytest.mark.parametrize('name', ['/go_to_goal', '/robot2/go_to_goal'])
def test_a_controller_of_the_same_name_is_perhaps_that_of_somebody_else(
    lockstep, node, capfd, monkeypatch, name
):
    """Two people in one domain. Within a world names are different."""
    node.create_publisher(Twist, 'cmd_vel', 10)
    mine = Controller(lockstep)
    mine.send(goal(1.0, 0.0))
    monkeypatch.setattr(other_drivers, 'publishers_of', lambda *_, **__: [name])
    lockstep.publish('cmd_vel', twist(0.25, 0.0))
    assert mine.node.waypoint is None
    text, same = said(capfd), name == '/go_to_goal'
    assert f'{name} drives the robot by /cmd_vel' in text
    for words in (f'another {name}', 'ROS_DOMAIN_ID of your own', 'DISCOVERY_RANGE=LOCALHOST'):
        assert (words in text) == same


@pytest.mark.parametrize('command', [Twist, TwistStamped])
def test_beside_an_idle_driver_own_commands_are_known(lockstep, node, command):
    node.create_publisher(command, 'cmd_vel', 10)
    controller = Controller(lockstep, command, enable_stamped_cmd_vel=command is TwistStamped)
    controller.send(goal(1.0, 0.3))
    for step in range(10):
        controller.at(0.001 * step, 0.0)
        lockstep.run_for(0.02)
    assert [status for _, status in controller.statuses] == [ACCEPTED, EXECUTING]


def test_its_own_subscription_is_no_reader_of_a_controller(lockstep, node, add, capfd):
    node.create_publisher(Twist, 'cmd_vel', 10)
    controller = add(GoToGoal)
    lockstep.publish('goals', goals(goal(1.0, 0.0)))
    assert node.count_subscribers('/cmd_vel') == 1
    check(controller)
    assert 'no node is subscribed to /cmd_vel' in said(capfd)


# --- Integers

INTEGER = 5e-324
"""What an integer 1 in a float field is on the wire."""


@pytest.mark.parametrize(
    ('node_class', 'parameters', 'topic', 'message', 'expected'),
    [
        (VirtualRobot, {}, 'cmd_vel', twist(0.7, 0.0), 'a command'),
        (WheelBridge, {}, 'cmd_vel', twist(0.7, 0.0), 'a command on cmd_vel'),
        (VirtualRobot, WHEELS, 'joint_command', joint_command(0.7, 0.7), 'a command on joint_command'),
        (VirtualRobot, {}, 'initialpose', placement(0.7), 'initialpose'),
        (GoToGoal, {}, 'goals', goals(goal(0.7, 0.0)), 'a pose on goals'),
    ],
    ids=lambda one: one if isinstance(one, str) else '',
)
def test_an_integer_in_a_message_is_reported_once_and_taken_as_it_is(
    lockstep, add, node, capfd, node_class, parameters, topic, message, expected
):
    add(node_class, **parameters)
    answers = lockstep.listen(GoalStatus, 'goal_status')
    publisher = node.create_publisher(type(message), topic, 10)
    publisher.publish(message)
    lockstep.settle()
    assert 'was an int' not in said(capfd)
    integer = serialize_message(message).replace(struct.pack('<d', 0.7), struct.pack('<d', INTEGER))
    for _ in range(2):
        publisher.publish(integer)
        lockstep.settle()
    words = f'{expected} has the value 4.94e-324: was an int assigned to a float field?'
    assert said(capfd).count(words) == 1
    assert node_class is not GoToGoal or answers[-1].status == ACCEPTED
