"""What rclpy itself cannot parse, parameter requests and /clock, is refused and ends no node."""

from __future__ import annotations

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import (
    SetParameters,
    SetParametersAtomically,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from type_description_interfaces.srv import GetTypeDescription

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import GoalClient
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros.runner import ros_context, running

NODES = {'virtual_robot': VirtualRobot, 'go_to_goal': GoToGoal, 'wheel_bridge': WheelBridge}
CHANGEABLE = {'virtual_robot': 'cmd_vel_timeout', 'go_to_goal': 'kp', 'wheel_bridge': 'cmd_vel_timeout'}


def double(name, value):
    kind = ParameterType.PARAMETER_DOUBLE
    return ParameterMessage(name=name, value=ParameterValue(type=kind, double_value=value))


def of_type(name, number):
    return ParameterMessage(name=name, value=ParameterValue(type=number))


def clock(sec, nanosec=0):
    message = Clock()
    message.clock.sec, message.clock.nanosec = sec, nanosec
    return message


# --- Parameter requests


@pytest.mark.parametrize('name', NODES)
def test_value_of_an_unknown_type_is_refused(lockstep, add_complete, name):
    node, changed = add_complete(NODES[name]), CHANGEABLE[name]

    def results(*parameters):
        request = SetParameters.Request(parameters=parameters)
        return lockstep.call(SetParameters, f'{name}/set_parameters', request).results

    def result(*parameters):
        request = SetParametersAtomically.Request(parameters=parameters)
        return lockstep.call(
            SetParametersAtomically, f'{name}/set_parameters_atomically', request
        ).result

    for number in (10, 255):
        # The others are set.
        value = 1.0 + number / 10.0
        first, *others = results(
            of_type(changed, number), double(changed, value), of_type('no such', number)
        )
        assert [one.successful for one in (first, *others)] == [False, True, False]
        assert f"parameter '{changed}' must have a type in 0 to 9, got type {number}" in first.reason
        assert node.get_parameter(changed).value == value
    # But not of an atomic request.
    before = node.parameters
    refused = result(double(changed, 2.5), of_type('kv', 10), double(changed, 3.5))
    assert not refused.successful
    assert node.parameters == before
    assert result(double(changed, 2.5), double(changed, 3.5)).successful
    assert node.get_parameter(changed).value == 3.5


ODD_NAMES = ['', '.', '\n', 'kp.', 'kp.kp', '%s', '\x00', 1_000 * 'n']


def test_odd_names_are_refused_quoted_in_short_and_without_control_characters(
    lockstep, add_complete, capfd
):
    node = add_complete(GoToGoal)

    def results(*parameters):
        request = SetParameters.Request(parameters=parameters)
        return lockstep.call(SetParameters, 'go_to_goal/set_parameters', request).results

    (result,) = results(of_type('\x1b[2J' + 100_000 * 'n', 10))
    lines = [one for one in capfd.readouterr().err.splitlines() if 'request refused: ' in one]
    for text in (result.reason, lines[-1]):
        assert len(text) < 300
        assert '\x1b' not in text
        assert r'\x1b[2Jnn' in text
    (result,) = results(double('', 1.0))
    assert (result.successful, result.reason) == (False, 'a parameter must have a name, got none')
    assert not node.has_parameter('')
    assert not any(one.successful for one in results(*(of_type(one, 0) for one in [*ODD_NAMES, 'kp'])))


# --- Type descriptions

MALFORMED_HASHES = ('', 'y' * 100_000, f'RIHS01_{"0" * 63}g', f'RIHS01_{"0" * 64}\n')


def test_exception_of_our_own_callbacks_is_not_caught(lockstep, add_complete):
    node = add_complete(GoToGoal)

    def fail(_):
        raise ZeroDivisionError('of the node itself')

    node.add_post_set_parameters_callback(fail)
    request = SetParameters.Request(parameters=[of_type('kp', 10), double('kp', 2.5)])
    with pytest.raises(ZeroDivisionError, match='of the node itself'):
        lockstep.call(SetParameters, 'go_to_goal/set_parameters', request)


def test_malformed_type_hash_is_refused_and_not_logged_and_others_are_described(ros, capfd):
    with running(ros.context, isolated=False) as runner:
        node = runner.add(lambda: GoalClient('client', np.zeros((1, 3)), ros.context))
        for one in (node, ros.add(VirtualRobot)):
            (info,) = ros.peer.get_publishers_info_by_topic('/odom') or [None]
            (service,) = [found for found in one.services if found.srv_type is GetTypeDescription]
            for type_hash in MALFORMED_HASHES:
                capfd.readouterr()
                request = GetTypeDescription.Request(type_name='x', type_hash=type_hash)
                response = service.callback(request, GetTypeDescription.Response())
                assert not response.successful
                assert f'got {len(type_hash)} other characters' in response.failure_reason
                assert len(capfd.readouterr().err) < 300
        request.type_name, request.type_hash = 'nav_msgs/msg/Odometry', str(info.topic_type_hash)
        assert service.callback(request, GetTypeDescription.Response()).successful


# --- /clock


@pytest.mark.parametrize(('name', 'nanosec'), [('virtual_robot', 0), ('go_to_goal', 10**9)])
def test_node_survives_an_invalid_clock(ros, capfd, name, nanosec):
    node = ros.add(NODES[name], parameters={'use_sim_time': True})
    time = ros.talk(Clock, '/clock')
    time.publish(clock(5))
    ros.until(lambda: node.now() == 5_000_000_000, 'the time is known')
    time.publish(clock(-1, nanosec))
    ros.until_said(capfd, '/clock dropped: ', f'got sec -1, nanosec {nanosec}')
    assert node.now() == 5_000_000_000
    time.publish(clock(6))
    ros.until(lambda: node.now() == 6_000_000_000, 'time goes on')


def test_clock_is_guarded_when_simulated_time_is_switched_on_later(ros, capfd, executor_kind):
    node = ros.add(GoToGoal)
    assert node.set_parameters([Parameter('use_sim_time', value=True)])[0].successful
    time = ros.talk(Clock, '/clock')
    time.publish(clock(-1))
    ros.until_said(capfd, '/clock dropped: ')
    time.publish(clock(6))
    ros.until(lambda: node.now() == 6_000_000_000, 'time goes on')


def client(context):
    return GoalClient('client', np.zeros((2, 3)), context)


def plain(context):
    return Node('plain', context=context)


@pytest.mark.parametrize(('make', 'isolated'), [(client, True), (plain, False)])
def test_runner_guards_the_nodes_of_the_tools(capfd, make, isolated):
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
