"""What rclpy itself cannot parse, parameter requests and /clock, is refused and ends no node."""

from __future__ import annotations

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from support.ros_messages import odometry, receive
from type_description_interfaces.srv import GetTypeDescription

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import GoalClient
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros.runner import ros_context, running

NODES = {'virtual_robot': VirtualRobot, 'go_to_goal': GoToGoal, 'wheel_bridge': WheelBridge}
CHANGEABLE = {'virtual_robot': 'cmd_vel_timeout', 'go_to_goal': 'kp', 'wheel_bridge': 'cmd_vel_timeout'}
BAD_CLOCKS = {'negative': (-1, 0), 'lowest': (-(2**31), 0), 'misleading zero': (-1, 1_000_000_000)}


def double(name, value):
    kind = ParameterType.PARAMETER_DOUBLE
    return ParameterMessage(name=name, value=ParameterValue(type=kind, double_value=value))


def of_type(name, number):
    return ParameterMessage(name=name, value=ParameterValue(type=number))


def clock(sec, nanosec):
    message = Clock()
    message.clock.sec, message.clock.nanosec = sec, nanosec
    return message


# --- Parameter requests


@pytest.mark.parametrize('number', [10, 42, 255])
@pytest.mark.parametrize('name', NODES)
def test_value_of_an_unknown_type_is_refused_and_the_others_are_set(
    lockstep, add_complete, name, number
):
    node, changed = add_complete(NODES[name]), CHANGEABLE[name]
    parameters = [of_type(changed, number), double(changed, 2.5), of_type('no such', number)]
    request = SetParameters.Request(parameters=parameters)
    results = lockstep.call(SetParameters, f'{name}/set_parameters', request).results
    assert [one.successful for one in results] == [False, True, False]
    assert f"parameter '{changed}' must have a type in 0 to 9, got type {number}" in results[0].reason
    assert node.get_parameter(changed).value == 2.5


@pytest.mark.parametrize('name', NODES)
def test_atomic_request_with_a_value_of_an_unknown_type_is_refused_whole(lockstep, add_complete, name):
    node, changed = add_complete(NODES[name]), CHANGEABLE[name]
    before = node.parameters
    request = SetParametersAtomically.Request(
        parameters=[double(changed, 2.5), of_type('kv', 10), double(changed, 3.5)]
    )
    service = f'{name}/set_parameters_atomically'
    result = lockstep.call(SetParametersAtomically, service, request).result
    assert not result.successful
    assert "parameter 'kv' must have a type in 0 to 9, got type 10" in result.reason
    assert node.parameters is before
    request.parameters.pop(1)
    assert lockstep.call(SetParametersAtomically, service, request).result.successful
    assert node.get_parameter(changed).value == 3.5


MALFORMED_HASHES = {
    'none': '',
    'long': 'y' * 100_000,
    'digit': f'RIHS01_{"0" * 63}g',
    'version': f'RIHS02_{"0" * 64}',
    'line': f'RIHS01_{"0" * 64}\n',
}


@pytest.mark.parametrize('name', [*NODES, 'client'])
@pytest.mark.parametrize('case', MALFORMED_HASHES)
def test_malformed_type_hash_is_refused_and_not_logged(ros, capfd, name, case):
    if name == 'client':
        with running(ros.context, isolated=False) as runner:
            node = runner.add(lambda: GoalClient(name, np.zeros((1, 3)), ros.context))
            check_type_hash(ros, capfd, node, MALFORMED_HASHES[case])
    else:
        check_type_hash(ros, capfd, ros.add(NODES[name]), MALFORMED_HASHES[case])


def check_type_hash(ros, capfd, node, type_hash):
    (service,) = [one for one in node.services if one.srv_type is GetTypeDescription]
    capfd.readouterr()
    request = GetTypeDescription.Request(type_name='x', type_hash=type_hash)
    response = service.callback(request, GetTypeDescription.Response())
    assert not response.successful
    assert response.failure_reason == (
        f'type_hash must be RIHS01_ and 64 hexadecimal digits, got {len(type_hash)} other characters'
    )
    log = capfd.readouterr().err
    assert 'type description request refused' in log
    assert len(log) < 300


def test_type_description_is_still_provided(ros):
    node = ros.add(VirtualRobot)
    (info,) = node.get_publishers_info_by_topic('/odom')
    request = GetTypeDescription.Request(
        type_name='nav_msgs/msg/Odometry', type_hash=str(info.topic_type_hash)
    )
    client = ros.peer.create_client(GetTypeDescription, '/virtual_robot/get_type_description')
    ros.until(client.service_is_ready, 'the service')
    future = client.call_async(request)
    ros.until(future.done, 'the answer')
    assert future.result().successful
    assert future.result().type_description.type_description.type_name == 'nav_msgs/msg/Odometry'


def test_parameter_without_a_name_is_not_set(lockstep, add_complete):
    node = add_complete(GoToGoal)
    request = SetParameters.Request(parameters=[double('', 1.0)])
    (result,) = lockstep.call(SetParameters, 'go_to_goal/set_parameters', request).results
    assert (result.successful, result.reason) == (False, 'a parameter must have a name, got none')
    assert not node.has_parameter('')


def test_refused_name_is_quoted_in_short_and_without_control_characters(lockstep, add_complete, capfd):
    add_complete(GoToGoal)
    request = SetParameters.Request(parameters=[of_type('\x1b[2J' + 100_000 * 'n', 10)])
    (result,) = lockstep.call(SetParameters, 'go_to_goal/set_parameters', request).results
    lines = capfd.readouterr().err.splitlines()
    (written,) = (line for line in lines if 'parameter request refused: ' in line)
    for text in (result.reason, written):
        assert len(text) < 300
        assert '\x1b' not in text
        assert r'\x1b[2Jnn' in text


SERVICES = {
    'describe_parameters': DescribeParameters,
    'get_parameters': GetParameters,
    'get_parameter_types': GetParameterTypes,
    'list_parameters': ListParameters,
}
ODD_NAMES = ['', '.', '..', ' ', '\n', 'kp.', 'kp.kp', 'ü', '%s', '\x00', 1_000 * 'n']


def test_other_parameter_services_answer_odd_requests(lockstep, add_complete):
    add_complete(GoToGoal)
    for name in ODD_NAMES:
        for service, request in (
            ('describe_parameters', DescribeParameters.Request(names=[name])),
            ('get_parameters', GetParameters.Request(names=[name])),
            ('get_parameter_types', GetParameterTypes.Request(names=[name])),
            ('list_parameters', ListParameters.Request(prefixes=[name], depth=2**64 - 1)),
        ):
            assert lockstep.call(SERVICES[service], f'go_to_goal/{service}', request)
    request = SetParameters.Request(parameters=[of_type(one, 0) for one in [*ODD_NAMES, 'kp']])
    results = lockstep.call(SetParameters, 'go_to_goal/set_parameters', request).results
    assert [one.successful for one in results] == [False] * len(results)


# --- /clock


@pytest.mark.parametrize('bad', BAD_CLOCKS.values(), ids=BAD_CLOCKS)
@pytest.mark.parametrize('name', NODES)
def test_node_survives_a_clock_that_cannot_be(ros, capfd, name, bad):
    node = ros.add(NODES[name], parameters={'use_sim_time': True})
    time = ros.talk(Clock, '/clock')
    time.publish(clock(5, 0))
    ros.until(lambda: node.now() == 5_000_000_000, 'the time is known')
    time.publish(clock(*bad))
    ros.until_said(capfd, '/clock dropped: ', f'got sec {bad[0]}, nanosec {bad[1]}')
    assert node.now() == 5_000_000_000
    time.publish(clock(6, 0))
    ros.until(lambda: node.now() == 6_000_000_000, 'time goes on')


def test_clock_is_guarded_when_simulated_time_is_switched_on_later(ros, capfd, executor_kind):
    node = ros.add(GoToGoal)
    assert node.set_parameters([Parameter('use_sim_time', value=True)])[0].successful
    time = ros.talk(Clock, '/clock')
    time.publish(clock(-1, 0))
    ros.until_said(capfd, '/clock dropped: ')
    time.publish(clock(6, 0))
    ros.until(lambda: node.now() == 6_000_000_000, 'time goes on')


def client_of_drive_to(context):
    return GoalClient('drive_to', np.zeros((2, 3)), context)


def client_of_send_goal(context):
    return GoalClient(
        'send_goal', np.zeros((1, 3)), context, topic='goal_pose', start_parameter_services=False
    )


def plain(context):
    return Node('plain', context=context)


@pytest.mark.parametrize('make', [client_of_drive_to, client_of_send_goal])
def test_goal_client_drops_odometry_with_a_negative_stamp(capfd, make):
    with ros_context(['test']) as context, running(context, isolated=True) as runner:
        node = runner.add(lambda: make(context))
        message = odometry(1.0, 2.0, 0.5)
        message.header.stamp.sec = -1
        receive(node, '/odom', message)
        assert node.robot is None
        assert 'odometry dropped: its stamp must have sec of at least 0' in capfd.readouterr().err
        message.header.stamp.sec = 7
        receive(node, '/odom', message)
        assert node.robot.stamp == 7_000_000_000


@pytest.mark.parametrize('isolated', [False, True])
@pytest.mark.parametrize('make', [client_of_drive_to, client_of_send_goal, plain])
def test_runner_guards_the_nodes_of_the_tools(capfd, make, isolated):
    arguments = ['test', '--ros-args', '-p', 'use_sim_time:=true']
    with ros_context(arguments) as context, running(context, isolated=isolated) as runner:
        node = runner.add(lambda: make(context))
        peer = runner.add(lambda: Node('peer', context=context))
        time = peer.create_publisher(Clock, '/clock', 10)
        assert runner.spin(lambda: time.get_subscription_count() == 2)
        time.publish(clock(-1, 0))
        assert runner.spin(lambda: '/clock dropped: ' in capfd.readouterr().err)
        time.publish(clock(6, 0))
        assert runner.spin(lambda: node.get_clock().now().nanoseconds == 6_000_000_000)
        if make is client_of_send_goal:
            return
        client = peer.create_client(SetParameters, f'{node.get_name()}/set_parameters')
        assert runner.spin(client.service_is_ready)
        future = client.call_async(SetParameters.Request(parameters=[of_type('use_sim_time', 10)]))
        assert runner.spin(future.done)
        assert not future.result().results[0].successful


def test_exception_of_our_own_callbacks_is_not_caught(lockstep, add_complete):
    node = add_complete(GoToGoal)

    def fail(_):
        raise ZeroDivisionError('of the node itself')

    node.add_post_set_parameters_callback(fail)
    request = SetParameters.Request(parameters=[of_type('kp', 10), double('kp', 2.5)])
    with pytest.raises(ZeroDivisionError, match='of the node itself'):
        lockstep.call(SetParameters, 'go_to_goal/set_parameters', request)


def test_rclpy_still_raises_for_what_the_guard_refuses(ros):
    node = ros.add(Node, node_name='bare', parameters={'use_sim_time': True})
    source = node._time_source
    assert source._clock_sub.callback == source.clock_callback
    services = {service.srv_type: service.callback for service in node.services}
    assert services[SetParameters].__name__ == '_set_parameters_callback'
    assert services[SetParametersAtomically].__name__ == '_set_parameters_atomically_callback'
    # What it refuses is what rclpy raises for: once that ends, the guard can go.
    with pytest.raises(ValueError, match='10 is not a valid'):
        services[SetParameters](
            SetParameters.Request(parameters=[of_type('kp', 10)]), SetParameters.Response()
        )
    with pytest.raises(ValueError, match='must not be negative'):
        source.clock_callback(clock(-1, 0))
