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

"""The internals of rclpy that `ros.rclpy_internals` relies on.

If a test fails with a new release of rclpy, the function that it names must change. There is none for
what other tests fail without: worlds in lockstep and the recorder receive and send messages without an
executor, notice them, and run timers and tasks.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.clock import Clock
from rclpy.duration import Duration
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSProfile
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String
from std_srvs.srv import SetBool

import diffdrive_jacobian
from diffdrive_jacobian.lockstep._link import queue_depth
from diffdrive_jacobian.ros import rclpy_internals as internals
from diffdrive_jacobian.ros.guarded_executor import entity_count

SECOND = 1_000_000_000
PACKAGE = Path(diffdrive_jacobian.__file__).parent


def recorder(calls):
    """Return a wrapper of functions that appends the arguments of each call to a list."""

    def wrap(function):
        def wrapped(*args):
            calls.append(args)
            return function(*args)

        return wrapped

    return wrap


@pytest.fixture
def events(ros):
    executor = internals.events_executor(ros.context)
    yield executor
    executor.shutdown()


@pytest.fixture
def node(ros):
    """A node without services in no executor."""
    node = Node('alone', context=ros.context, start_parameter_services=False)
    yield node
    node.destroy_node()


def spin(executor, until):
    while not until():
        executor.spin_once(timeout_sec=1.0)


# --- Errors, parameters and graph


def test_rcl_errors_have_their_place_in_the_sources(ros):
    arguments = ['--ros-args', '-r', f'odom:={300 * "a"}']
    node = ros.add(Node, node_name='remapped', cli_args=arguments)
    with pytest.raises(internals.RCLError, match=', at /') as caught:
        node.create_publisher(String, 'odom', 1)
    assert isinstance(caught.value, RuntimeError)
    assert internals.reason(caught.value).endswith("topic length should not exceed '255U - 8U'")
    assert internals.reason(ValueError('no place')) == 'no place'


def test_parameters_and_their_overrides_are_known(ros):
    node = ros.add(Node, node_name='bare', parameters={'gain': 2.5})
    assert internals.parameter_overrides(node)['gain'].value == 2.5
    declared = internals.declared_parameters(node)
    assert 'use_sim_time' in declared
    assert all(name.startswith(internals.PARAMETERS_OF_RCLPY) for name in declared)
    node.declare_parameter('gain', 1.0)
    assert internals.declared_parameters(node) == {*declared, 'gain'}


def test_services_that_rclpy_provides_are_known(ros):
    services = ros.peer.get_service_names_and_types_by_node('peer', '/')
    assert len(services) >= 6
    assert all(types[0].startswith(internals.SERVICES_OF_RCLPY) for _, types in services)


def test_each_change_of_the_graph_is_signaled_once_for_all_nodes_of_a_context(ros, node):
    internals.graph_changed(node)
    assert not internals.graph_changed(node)
    publisher = ros.peer.create_publisher(String, 'word', 1)
    assert internals.graph_changed(node)
    assert not internals.graph_changed(ros.peer)
    ros.peer.destroy_publisher(publisher)
    assert internals.graph_changed(node)


# --- Inputs that rclpy parses itself


def test_clock_callback_is_wrapped_also_later(ros):
    node = ros.add(Node, node_name='clocked')
    calls = []
    internals.wrap_clock_callback(node, recorder(calls))
    node.set_parameters([Parameter('use_sim_time', value=True)])
    message = ClockMessage()
    message.clock.sec = 7
    ros.talk(ClockMessage, '/clock').publish(message)
    ros.until(lambda: calls == [(message,)], 'the wrapper receives the clock')
    assert node.get_clock().now().nanoseconds == 7 * SECOND


def test_service_callback_is_wrapped(ros):
    calls = []
    node = ros.add(Node, node_name='served')
    internals.wrap_service_callback(node, GetParameters, recorder(calls))
    client = ros.peer.create_client(GetParameters, 'served/get_parameters')
    ros.until(client.service_is_ready, 'the service')
    future = client.call_async(GetParameters.Request(names=['use_sim_time']))
    ros.until(future.done, 'the response')
    assert [request.names for request, _ in calls] == [['use_sim_time']]
    assert future.result().values[0].bool_value is False


def test_every_response_to_a_request_is_counted(ros):
    for name in ('one', 'two'):
        node = ros.add(Node, node_name=name)
        node.create_service(SetBool, 'shared', lambda _, response: response)
    client = ros.peer.create_client(SetBool, 'shared')
    ros.until(lambda: ros.peer.count_services('shared') == 2, 'both servers are discovered')
    responses = []
    internals.on_response(client, responses.append)

    def both_answered():
        if not client._pending_requests:
            client.call_async(SetBool.Request())
        return len(responses) > len(set(responses))

    ros.until(both_answered, 'two responses to one request')


# --- Time


def test_sleep_is_wrapped_once_and_called_by_sleep_for():
    clock, slept = Clock(), []
    for _ in range(2):
        internals.wrap_sleep(clock, lambda _: lambda *args, **_: slept.append(args) or True)
    assert clock.sleep_until(1)
    assert clock.sleep_for(Duration(seconds=1e6))
    assert slept[0] == (1,)
    assert len(slept) == 2


@pytest.mark.parametrize(
    ('change', 'elapsed', 'period', 'first'),
    [
        (internals.restart_timer, 0.5, 0.2, 0.2),
        (internals.change_timer_period, 0.5, 0.2, 0.2),
        (internals.change_timer_period, 0.9, 0.2, 0.1),
        (internals.change_timer_period, 0.5, 2.0, 0.5),
    ],
)
def test_a_timer_restarts_or_expires_earlier(lockstep, change, elapsed, period, first):
    expired = []
    timer = lockstep.node.create_timer(1.0, lambda: expired.append(lockstep.now))
    lockstep.run_for(elapsed)
    start = lockstep.now
    change(timer, round(period * SECOND))
    lockstep.run_for(0.6)
    assert expired[0] == start + round(first * SECOND)
    assert timer.timer_period_ns == round(period * SECOND)


# --- Messages


async def wait(message):
    pass


@pytest.mark.parametrize(
    ('callback', 'received', 'wait_set'),
    [
        (lambda message: message, 'message', False),
        (lambda message, info: (message, info), ('message', {}), True),
        (wait, None, True),
    ],
)
def test_kinds_of_callbacks_are_detected(node, callback, received, wait_set):
    subscription = node.create_subscription(String, 'words', callback, 10)
    receive = internals.message_receiver(subscription)
    if received is not None:
        assert receive(('message', {})) == received
    assert internals.requires_wait_set(node) == wait_set
    # A callback may be replaced.
    subscription.callback = lambda message: [message]
    assert receive(('message', {})) == ['message']


def test_a_line_is_logged_with_the_place_of_the_caller(node, monkeypatch, capfd):
    calls = []
    rclpy = internals.rclpy_implementation
    log = recorder(calls)(rclpy.rclpy_logging_rcutils_log)
    monkeypatch.setattr(rclpy, 'rclpy_logging_rcutils_log', log)
    internals.log_info(node, 'written {name} %s')
    [(_, _, _, function, file, line)] = calls
    assert function == 'test_a_line_is_logged_with_the_place_of_the_caller'
    assert Path(file) == Path(__file__)
    assert 'internals.log_info(node, ' in Path(file).read_text().splitlines()[line - 1]
    node.get_logger().set_level(LoggingSeverity.ERROR)
    internals.log_info(node, 'another')
    (said,) = capfd.readouterr().err.splitlines()
    assert '[INFO]' in said
    assert said.endswith('[alone]: written {name} %s')


# --- Executors


def test_events_executor_runs_a_task_after_the_queued_events(events, node):
    order = []
    node.create_subscription(String, 'words', lambda word: order.append(word.data), 10)
    publisher = node.create_publisher(String, 'words', 10)
    events.add_node(node)
    spin(events, events.create_task(lambda: None).done)
    # Delivered within publish: the message is queued before the task.
    publisher.publish(String(data='message'))
    spin(events, events.create_task(order.append, 'task').done)
    assert order == ['message', 'task']


def test_entities_of_a_node_are_counted(node):
    before = entity_count(node)
    node.create_timer(1.0, lambda: None)
    node.create_client(GetParameters, 'get')
    assert entity_count(node) == before + 2
    node.create_subscription(String, 'words', [].append, 10)
    # With its QoS events.
    assert entity_count(node) > before + 2


def test_a_queue_without_a_limit_has_the_greatest_depth():
    assert queue_depth(QoSProfile(depth=3)) == 3
    assert queue_depth(QoSProfile(history=HistoryPolicy.KEEP_ALL)) == sys.maxsize
