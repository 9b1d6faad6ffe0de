"""The internals of rclpy that `ros.rclpy_internals` relies on, one by one.

If a test fails with a new release of rclpy, the function that it names must change.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.service import Service
from rclpy.task import Future
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String
from std_srvs.srv import SetBool

import diffdrive_jacobian
from diffdrive_jacobian.ros import rclpy_internals as internals

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


def echo(request, response):
    return response


def clock_message(seconds):
    message = ClockMessage()
    message.clock.sec = seconds
    return message


@pytest.fixture
def single(ros):
    executor = SingleThreadedExecutor(context=ros.context)
    yield executor
    executor.shutdown()


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
    node = ros.add(Node, node_name='remapped', cli_args=['--ros-args', '-r', f'odom:={300 * "a"}'])
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
    ros.talk(ClockMessage, '/clock').publish(clock_message(7))
    ros.until(lambda: calls == [(clock_message(7),)], 'the wrapper receives the clock')
    assert node.get_clock().now().nanoseconds == 7 * SECOND


def test_service_callback_is_wrapped(ros):
    calls = []
    internals.wrap_service_callback(ros.add(Node, node_name='served'), GetParameters, recorder(calls))
    client = ros.peer.create_client(GetParameters, 'served/get_parameters')
    ros.until(client.service_is_ready, 'the service')
    future = client.call_async(GetParameters.Request(names=['use_sim_time']))
    ros.until(future.done, 'the response')
    assert [request.names for request, _ in calls] == [['use_sim_time']]
    assert future.result().values[0].bool_value is False


def test_every_response_to_a_request_is_counted(ros):
    for name in ('one', 'two'):
        ros.add(Node, node_name=name).create_service(SetBool, 'shared', echo)
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
def test_a_timer_is_restarted_or_keeps_an_earlier_expiry(lockstep, change, elapsed, period, first):
    expired = []
    timer = lockstep.node.create_timer(1.0, lambda: expired.append(lockstep.now))
    lockstep.run_for(elapsed)
    start = lockstep.now
    change(timer, round(period * SECOND))
    lockstep.run_for(0.6)
    assert expired[0] == start + round(first * SECOND)
    assert timer.timer_period_ns == round(period * SECOND)


def test_timer_handle_knows_when_the_timer_expires(ros):
    timer = ros.peer.create_timer(100.0, lambda: None, autostart=False)
    handle = internals.timer_handle(timer)
    assert handle.time_until_next_call() is None
    timer.reset()
    assert 0 < handle.time_until_next_call() <= 100 * SECOND
    handle.call_timer()
    assert handle.time_until_next_call() > 100 * SECOND
    ros.peer.destroy_timer(timer)
    with pytest.raises(internals.RCLError):
        handle.time_until_next_call()


def test_simulated_clock_is_set_as_by_a_message(ros):
    node = ros.add(Node, node_name='clocked', parameters={'use_sim_time': True})
    clock = internals.SimulatedClock(node)
    assert clock.subscription.topic_name == '/clock'
    assert clock.subscription in list(node.subscriptions)
    clock.set(Time(seconds=7, clock_type=node.get_clock().clock_type))
    assert node.get_clock().now().nanoseconds == 7 * SECOND
    assert internals.SimulatedClock(ros.peer).subscription is None


# --- Messages


def test_messages_are_taken_until_the_use_ends(ros, node):
    subscription = node.create_subscription(String, 'words', print, 10)
    take, close = internals.message_taker(subscription)
    publisher = ros.talk(String, 'words')
    publisher.publish(String(data='one'))
    message, info = take(String, False)
    assert message == String(data='one')
    assert info['source_timestamp'] > 0
    assert take(String, False) is None
    node.destroy_subscription(subscription)
    assert take(String, True) is None
    assert publisher.get_subscription_count() == 1
    close()
    ros.until(lambda: publisher.get_subscription_count() == 0, 'the subscription is destroyed')


async def wait(message):
    pass


@pytest.mark.parametrize(
    ('callback', 'with_info', 'wait_set'),
    [(lambda _: None, False, False), (lambda message, info: None, True, True), (wait, False, True)],
)
def test_kinds_of_callbacks_are_detected(node, callback, with_info, wait_set):
    subscription = node.create_subscription(String, 'words', callback, 10)
    assert internals.receives_info(subscription) == with_info
    assert internals.requires_wait_set(node) == wait_set


def test_what_nodes_send_and_create_is_noticed_until_it_is_restored(ros):
    calls, created = [], []
    restore = [
        internals.wrap_calls(recorder(calls)),
        internals.wrap_publish(recorder(calls)),
        internals.on_new_node(created.append),
    ]
    nodes = [ros.add(Node, node_name='plain'), ros.add(LifecycleNode, node_name='managed')]
    nodes[0].create_service(SetBool, 'ask', echo)
    client = ros.peer.create_client(SetBool, 'ask')
    ros.until(client.service_is_ready, 'the service')
    publisher = ros.peer.create_publisher(String, 'words', 10)
    for undo in (lambda: None, *restore):
        undo()
        publisher.publish(String(data='word'))
        ros.until(client.call_async(SetBool.Request()).done, 'the response')
    ros.add(Node, node_name='later')
    assert created == nodes
    kinds = [type(self) for self, *_ in calls if self is publisher or type(self) is not Publisher]
    assert kinds == [Publisher, Client, Service, Publisher]


def test_waiting_messages_are_taken_serialized_with_what_the_middleware_knows(ros):
    subscription = ros.peer.create_subscription(String, 'words', print, 10, raw=True)
    publishers = [ros.talk(String, 'words') for _ in range(2)]
    words = ('one', 'two', 'x' * 100_000)
    before = time.time_ns()
    for word in words:
        for publisher in publishers:
            publisher.publish(String(data=word))
    taken = list(internals.waiting_messages(subscription))
    assert [one.data for one in taken[::2]] == [serialize_message(String(data=word)) for word in words]
    assert [one.number for one in taken] == [1, 1, 2, 2, 3, 3]
    assert all(before <= one.sent <= one.received <= time.time_ns() for one in taken)
    endpoints = ros.peer.get_publishers_info_by_topic(subscription.topic_name)
    assert {bytes(one.endpoint_gid) for one in endpoints} == {one.publisher for one in taken}
    assert len({one.publisher for one in taken[::2]}) == 1
    assert list(internals.waiting_messages(subscription)) == []


def test_the_single_threaded_executor_leaves_polled_subscriptions_alone(ros, single, node):
    polled = node.create_subscription(
        String, 'words', pytest.fail, 10, raw=True, callback_group=internals.Polled()
    )
    heard = []
    node.create_subscription(String, 'words', heard.append, 10)
    single.add_node(node)
    ros.talk(String, 'words').publish(String(data='one'))
    spin(single, lambda: heard)
    assert len(list(internals.waiting_messages(polled))) == 1


@pytest.mark.parametrize('events', [{}, {'message_lost': print}], ids=['not reported', 'reported'])
def test_lost_messages_are_counted_where_the_middleware_reports_them(node, events):
    callbacks = SubscriptionEventCallbacks(use_default_callbacks=False, **events)
    group = internals.Polled()
    subscription = node.create_subscription(
        String, 'words', print, 1, callback_group=group, event_callbacks=callbacks
    )
    assert internals.lost_messages(subscription) == 0


def test_a_raw_subscription_receives_the_info_of_messages(ros, executor_kind):
    received = []

    def on_message(data, info):
        text = deserialize_message(data, String).data
        received.append((text, info['publication_sequence_number']))

    ros.peer.create_subscription(String, 'words', internals.with_message_info(on_message), 10, raw=True)
    publisher = ros.talk(String, 'words')
    for text in ('a', 'b'):
        publisher.publish(String(data=text))
    ros.until(lambda: len(received) == 2, 'all are received')
    assert received == [('a', 1), ('b', 2)]


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
    node.create_subscription(String, 'words', lambda message: order.append(message.data), 10)
    publisher = node.create_publisher(String, 'words', 10)
    events.add_node(node)
    spin(events, events.create_task(lambda: None).done)
    # Delivered within publish: the message is queued before the task.
    publisher.publish(String(data='message'))
    spin(events, events.create_task(order.append, 'task').done)
    assert order == ['message', 'task']


def test_ready_callbacks_are_executed_in_rounds(single, node):
    received, rounds = [], []
    publishers = []
    for topic in ('first', 'second'):
        node.create_subscription(String, topic, lambda message: received.append(message.data), 10)
        publishers.append(node.create_publisher(String, topic, 10))
    single.add_node(node)
    while internals.execute_ready(single):
        pass
    for number, text in ((0, 'a'), (0, 'b'), (1, 'c')):
        publishers[number].publish(String(data=text))
    while not rounds or rounds[-1]:
        before = len(received)
        while internals.execute_ready(single):
            pass
        rounds.append(sorted(received[before:]))
    assert rounds == [['a', 'c'], ['b'], []]


def test_entities_of_a_node_are_counted(node):
    before = internals.entity_count(node)
    node.create_timer(1.0, print)
    node.create_client(GetParameters, 'get')
    assert internals.entity_count(node) == before + 2
    node.create_subscription(String, 'words', [].append, 2000)
    # With its QoS events.
    assert internals.entity_count(node) > before + 2
    assert internals.longest_queue(node) == 2000
    node.create_subscription(String, 'all', [].append, QoSProfile(history=HistoryPolicy.KEEP_ALL))
    assert internals.longest_queue(node) == sys.maxsize


def test_endpoints_without_an_executor(ros, monkeypatch):
    """Nobody who wraps the methods of rclpy notices what they send."""

    def refuse(*_):
        raise AssertionError('it was noticed')

    service = ros.peer.create_service(SetBool, 'switch', refuse)
    client = ros.peer.create_client(SetBool, 'switch')
    subscription = ros.peer.create_subscription(String, 'words', refuse, 10, raw=True)
    publisher = ros.peer.create_publisher(String, 'words', 10)
    ros.until(client.service_is_ready, 'the service')
    for wrapped in ((Publisher, 'publish'), (Client, 'call_async'), (Service, 'send_response')):
        monkeypatch.setattr(*wrapped, refuse)
    data = serialize_message(String(data='spoken'))
    internals.raw_sender(publisher)(data)
    take, release = internals.message_taker(subscription)
    assert take(String, True)[0] == data
    release()
    assert internals.take_request(service) is None
    assert internals.take_response(client) is None
    number = internals.send_request(client, SetBool.Request(data=True))
    request, request_id = internals.take_request(service)
    assert request.data is True
    internals.send_response(service, SetBool.Response(message='on'), request_id)
    taken, response = internals.take_response(client)
    assert (taken, response.message) == (number, 'on')


def test_a_task_runs_to_the_next_await_when_it_is_called(ros):
    future = Future()

    async def wait_for(future):
        return await future

    task = internals.new_task(wait_for, (), {'future': future}, ros.executor)
    task()
    assert not task.done()
    future.set_result('done')
    task()
    assert task.result() == 'done'
