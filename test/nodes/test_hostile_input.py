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

"""What rclpy itself cannot parse, floods and huge texts: refused, logged in short, ending no node."""

from __future__ import annotations

import numpy as np
import pytest
from nav_msgs.msg import Goals
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger
from support.lockstep_nodes import Controller, change
from support.ros_messages import goal, goals, odometry, placement, twist, value_of
from type_description_interfaces.srv import GetTypeDescription

from diffdrive_jacobian.messages.codecs import GOALS
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import GoalClient
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros import node as ros_node
from diffdrive_jacobian.ros import serialization
from diffdrive_jacobian.ros.runner import ros_context, running
from diffdrive_jacobian.ros.serialization import ignoring_invalid

MEGABYTE = 1_000_000 * 'f'
CONTROL_CHARACTERS = 5_000 * '\x1b[31m\n\u202e'


@pytest.fixture
def controller(lockstep):
    return Controller(lockstep)


# --- Parameter requests


def double(name, value):
    kind = ParameterType.PARAMETER_DOUBLE
    return ParameterMessage(name=name, value=ParameterValue(type=kind, double_value=value))


def of_type(name, number):
    return ParameterMessage(name=name, value=ParameterValue(type=number))


@pytest.fixture
def set_parameters(lockstep):
    """Send a request to go_to_goal; return the results."""

    def call(*parameters):
        request = SetParameters.Request(parameters=parameters)
        return lockstep.call(SetParameters, 'go_to_goal/set_parameters', request).results

    return call


def test_a_value_of_an_unknown_type_is_refused_and_the_others_are_set(
    lockstep, add_complete, set_parameters
):
    node = add_complete(GoToGoal)
    results = set_parameters(of_type('kp', 10), double('kp', 2.0), of_type('no such', 255))
    assert [one.successful for one in results] == [False, True, False]
    assert "parameter 'kp' must have a type in 0 to 9, got type 10" in results[0].reason
    assert node.parameters.kp == 2.0
    assert set_parameters(double('kp', 3.0))[0].successful
    # Of an atomic request nothing is set.
    for others, expected in (([of_type('kv', 10)], 3.0), ([], 4.0)):
        request = SetParametersAtomically.Request(parameters=[double('kp', 4.0), *others])
        service = 'go_to_goal/set_parameters_atomically'
        result = lockstep.call(SetParametersAtomically, service, request).result
        assert (result.successful, node.parameters.kp) == (not others, expected)


def test_odd_names_are_refused_and_quoted_in_short(add_complete, set_parameters, capfd):
    node = add_complete(GoToGoal)
    (result,) = set_parameters(of_type('\x1b[2J' + 100_000 * 'n', 10))
    lines = [one for one in capfd.readouterr().err.splitlines() if 'request refused: ' in one]
    for text in (result.reason, lines[-1]):
        assert len(text) < 300
        assert r'\x1b[2Jnn' in text
    (result,) = set_parameters(double('', 1.0))
    assert result.reason == 'a parameter must have a name, got none'
    assert not node.has_parameter('')


def test_an_exception_of_our_own_callbacks_is_not_caught(add_complete, set_parameters):
    def fail(_):
        raise ZeroDivisionError

    add_complete(GoToGoal).add_post_set_parameters_callback(fail)
    with pytest.raises(ZeroDivisionError):
        set_parameters(of_type('kp', 10), double('kp', 2.5))


def test_a_malformed_type_hash_is_refused_and_not_logged_and_others_are_described(ros, capfd):
    node = ros.add(VirtualRobot)
    (service,) = [one for one in node.services if one.srv_type is GetTypeDescription]
    request = GetTypeDescription.Request(type_name='nav_msgs/msg/Odometry')
    for malformed in ('', 'y' * 100_000, f'RIHS01_{"0" * 63}g', f'RIHS01_{"0" * 64}\n'):
        capfd.readouterr()
        request.type_hash = malformed
        response = service.callback(request, GetTypeDescription.Response())
        assert not response.successful
        assert f'got {len(malformed)} other characters' in response.failure_reason
        assert len(capfd.readouterr().err) < 300
    (info,) = ros.peer.get_publishers_info_by_topic('/odom')
    request.type_hash = str(info.topic_type_hash)
    assert service.callback(request, GetTypeDescription.Response()).successful


# --- /clock


def clock(sec, nanosec=0):
    message = Clock()
    message.clock.sec, message.clock.nanosec = sec, nanosec
    return message


@pytest.mark.parametrize('later', [False, True])
def test_a_node_survives_an_invalid_clock(ros, capfd, executor_kind, later):
    """Also when simulated time is switched on later."""
    node = ros.add(GoToGoal, parameters={'use_sim_time': not later})
    if later:
        assert node.set_parameters([Parameter('use_sim_time', value=True)])[0].successful
    time = ros.talk(Clock, '/clock')
    time.publish(clock(5))
    ros.until(lambda: node.now() == 5_000_000_000, 'the time is known')
    time.publish(clock(-1, 10**9))
    ros.until_said(capfd, '/clock dropped: ', 'got sec -1, nanosec 1000000000')
    assert node.now() == 5_000_000_000
    time.publish(clock(6))
    ros.until(lambda: node.now() == 6_000_000_000, 'time goes on')


def client(context):
    return GoalClient('client', np.zeros((2, 3)), context)


def plain(context):
    return Node('plain', context=context)


@pytest.mark.parametrize(('make', 'isolated'), [(client, True), (plain, False)])
def test_a_runner_guards_the_nodes_of_the_tools(capfd, make, isolated):
    arguments = ['test', '--ros-args', '-p', 'use_sim_time:=true']
    with ros_context(arguments) as context, running(context, isolated=isolated) as runner:
        node = runner.add(lambda: make(context))
        peer = runner.add(lambda: Node('peer', context=context))
        time = peer.create_publisher(Clock, '/clock', 10)
        assert runner.spin(lambda: time.get_subscription_count() == 2)
        time.publish(clock(-1))
        assert runner.spin(lambda: '/clock dropped: ' in capfd.readouterr().err)
        time.publish(clock(6))
        assert runner.spin(lambda: node.get_clock().now().nanoseconds == 6_000_000_000)
        parameters = peer.create_client(SetParameters, f'{node.get_name()}/set_parameters')
        assert runner.spin(parameters.service_is_ready)
        future = parameters.call_async(SetParameters.Request(parameters=[of_type('use_sim_time', 10)]))
        assert runner.spin(future.done)
        assert not future.result().results[0].successful


# --- Floods

FLOOD = 40
MOST_LINES = 30
"""More than EVENT_BURST lines, and what EVENT_PERIOD adds on a slow machine."""


def assert_a_few(capfd, *words):
    written = capfd.readouterr().err
    for one in words:
        assert ros_node.EVENT_BURST <= written.count(one) <= MOST_LINES, one


def test_events_of_the_nodes_are_logged_a_few_times(lockstep, add, controller, capfd):
    change(controller.node, odom_timeout=0.001)
    for _ in range(FLOOD):
        controller.send(goal(1, 0))
        controller.send(goal(9e9, 0))
        lockstep.run_for(0.002)
        assert lockstep.call(Trigger, 'cancel_goal').success
    assert_a_few(capfd, 'goal accepted: ', 'goal refused: ', 'goal canceled', 'the goal waits')
    controller.send(goal(1, 0))
    for number in range(FLOOD):
        controller.sees(odometry(0, 0, 0))
        lockstep.run_for(0.002)
        change(controller.node, kp=0.1 + 0.001 * number)
    assert_a_few(capfd, 'no valid odometry', 'odometry is received again', 'is not larger than kv')
    lockstep.remove(controller.node)
    add(VirtualRobot)
    add(WheelBridge, cmd_vel_timeout=0.001)
    for number in range(FLOOD):
        lockstep.publish('initialpose', placement(number))
        lockstep.publish('cmd_vel', twist(1, 0))
        lockstep.run_for(0.002)
        lockstep.jump(-0.003)
    assert_a_few(capfd, 'pose set to', 'the wheels are stopped', 'time went back')


# --- Long and malformed messages


@pytest.mark.parametrize('text', [MEGABYTE, CONTROL_CHARACTERS])
def test_long_frames_are_quoted_in_short(lockstep, controller, capfd, text):
    lockstep.add(VirtualRobot())
    controller.sees(odometry(0, 0, 0, frame=text))
    controller.send(goal(1, 0, frame=text[1:]))
    controller.send(goals(goal(1, 0, frame=text), goal(1, 0, frame='b'), frame=text[1:]))
    controller.send(goal(1, 0))
    controller.sees(odometry(0, 0, 0, frame=text))
    controller.sees(odometry(0, 0, 0, frame='other'))
    lockstep.publish('initialpose', placement(0, frame=text))
    written = capfd.readouterr().err
    for words in ('in the frame of the', 'in one frame, got', 'it must stay in frame', 'frame must be'):
        assert words in written
    assert max(map(len, written.splitlines())) < 600
    assert '\x1b' not in written
    assert '\u202e' not in written


def test_goals_with_too_many_bytes_to_convert_are_dropped(lockstep, controller, capfd):
    publisher = lockstep.node.create_publisher(Goals, 'goals', 10)
    publisher.publish(serialize_message(goals(*[goal(1, 0)] * 30_000)))
    lockstep.settle()
    assert 'goals dropped: it must have at most 2097152 bytes, got 21600' in capfd.readouterr().err
    assert controller.statuses == []
    controller.send(goal(1, 0))
    assert controller.at(0, 0) == (0.5, 0.0)


def test_clients_ignore_what_is_no_message_without_a_word_and_report_invalid_values(capfd):
    """The code that rclpy generates for a type writes a line for each."""
    received, refused = [], []
    callback = ignoring_invalid(GOALS, Goals, received.append, refused.append)
    message = goals(goal(1, 0), goal(2, 0))
    data = serialize_message(message)
    # rclpy adds bytes at the end.
    for invalid in (b'\0\1', b'\xff' * len(data), *(data[:end] for end in range(len(data) // 2))):
        callback(invalid)
    callback(serialize_message(goals(frame='a' * serialization.MAX_SIZE)))
    assert received == refused == []
    callback(data)
    assert received == [value_of(GOALS, message)]
    callback(serialize_message(goals(goal(1e7, 0))))
    assert 'got x 1e+07, y 0' in str(*refused)
    assert capfd.readouterr() == ('', '')
