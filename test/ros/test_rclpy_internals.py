"""The internals of rclpy that `ros.rclpy_internals` relies on, one by one.

If a test fails with a new release of rclpy, the function that it names must change.
"""

from __future__ import annotations

import ast
import sys
import time
from pathlib import Path

import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.clock import Clock
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
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import String
from std_srvs.srv import SetBool

import diffdrive_jacobian
from diffdrive_jacobian.ros import rclpy_internals as internals
from diffdrive_jacobian.ros.runner import UserError, ros_context

SECOND = 1_000_000_000
PACKAGE = Path(diffdrive_jacobian.__file__).parent


@pytest.fixture
def rcl_error(ros):
    """An error of rcl: the new name of a topic is too long."""
    node = ros.add(Node, node_name='remapped', cli_args=['--ros-args', '-r', f'odom:={300 * "a"}'])
    with pytest.raises(internals.RCLError) as caught:
        node.create_publisher(String, 'odom', 1)
    return caught.value


def test_rcl_error_is_raised_for_a_name_that_is_too_long(rcl_error):
    assert isinstance(rcl_error, RuntimeError)


def test_unknown_ros_args_error_is_raised_by_init():
    with pytest.raises(UserError) as caught, ros_context(['test', '--ros-args', 'unknown']):
        pass
    assert isinstance(caught.value.__cause__, internals.UnknownROSArgsError)


def test_reason_removes_the_place_in_the_sources_of_rcl(rcl_error):
    assert ', at /' in str(rcl_error)
    assert internals.reason(rcl_error).endswith("topic length should not exceed '255U - 8U'")
    assert internals.reason(ValueError('no place')) == 'no place'


# --- Parameters


def test_parameter_overrides_are_known_before_the_declaration(ros):
    node = ros.add(Node, node_name='undeclared', parameters={'gain': 2.5})
    overrides = internals.parameter_overrides(node)
    assert overrides['gain'].value == 2.5
    assert not node.has_parameter('gain')


def test_parameters_that_rclpy_declares_are_known(ros):
    node = ros.add(Node, node_name='bare')
    declared = internals.declared_parameters(node)
    assert 'use_sim_time' in declared
    assert all(name.startswith(internals.PARAMETERS_OF_RCLPY) for name in declared)
    node.declare_parameter('gain', 1.0)
    assert internals.declared_parameters(node) == {*declared, 'gain'}


def test_services_that_rclpy_provides_are_known(ros):
    node = ros.add(Node, node_name='bare')
    services = node.get_service_names_and_types_by_node('bare', '/')
    assert len(services) >= 6
    assert all(types[0].startswith(internals.SERVICES_OF_RCLPY) for _, types in services)


# --- Graph


def test_each_change_of_the_graph_is_signaled_once(ros):
    node = ros.add(Node, node_name='watching')
    internals.graph_changed(node)
    assert not internals.graph_changed(node)
    publisher = ros.peer.create_publisher(String, 'word', 1)
    # For all nodes of the context together.
    assert internals.graph_changed(node)
    assert not internals.graph_changed(ros.peer)
    # Also the same publisher once more.
    ros.peer.create_publisher(String, 'word', 1)
    assert internals.graph_changed(node)
    assert not internals.graph_changed(node)
    ros.peer.destroy_publisher(publisher)
    assert node.count_publishers('word') == 1
    assert internals.graph_changed(node)


def test_without_functions_of_rcl_the_graph_counts_as_changed(ros, monkeypatch):
    internals._graph_functions.cache_clear()
    monkeypatch.setattr(internals.ctypes, 'CDLL', lambda _: object())
    assert internals._graph_functions() is None
    assert internals.graph_changed(ros.peer)
    internals._graph_functions.cache_clear()
    monkeypatch.undo()
    internals.graph_changed(ros.peer)
    assert not internals.graph_changed(ros.peer)


# --- Inputs that rclpy parses itself


@pytest.mark.parametrize('later', [False, True], ids=['at the start', 'later'])
def test_clock_callback_is_wrapped(ros, later):
    node = ros.add(Node, node_name='clocked', parameters={'use_sim_time': not later})
    received = []

    def wrap(accept):
        def on_clock(message):
            received.append(message.clock.sec)
            accept(message)

        return on_clock

    internals.wrap_clock_callback(node, wrap)
    if later:
        node.set_parameters([Parameter('use_sim_time', value=True)])
    publisher = ros.talk(ClockMessage, '/clock')
    message = ClockMessage()
    message.clock.sec = 7
    publisher.publish(message)
    ros.until(lambda: received == [7], 'the wrapper receives the clock')
    assert node.get_clock().now().nanoseconds == 7 * SECOND


def test_service_callback_is_wrapped(ros, executor_kind):
    node = ros.add(Node, node_name='served')
    requests = []

    def wrap(accept):
        def on_request(request, response):
            requests.append(list(request.names))
            return accept(request, response)

        return on_request

    internals.wrap_service_callback(node, GetParameters, wrap)
    client = ros.peer.create_client(GetParameters, 'served/get_parameters')
    ros.until(client.service_is_ready, 'the service')
    future = client.call_async(GetParameters.Request(names=['use_sim_time']))
    ros.until(future.done, 'the response')
    assert requests == [['use_sim_time']]
    assert future.result().values[0].bool_value is False


def test_every_response_to_a_request_is_counted(ros):
    for name in ('one', 'two'):
        ros.add(Node, node_name=name).create_service(
            GetParameters, 'shared', lambda request, response: response
        )
    client = ros.peer.create_client(GetParameters, 'shared')
    ros.until(lambda: ros.peer.count_services('shared') == 2, 'both servers are discovered')
    responses = []
    internals.on_response(client, responses.append)

    def both_answered():
        if not client._pending_requests:
            client.call_async(GetParameters.Request())
        return len(responses) > len(set(responses))

    ros.until(both_answered, 'two responses to one request')


# --- Time


def test_time_reader_returns_the_time_of_the_clock(lockstep):
    read = internals.time_reader(lockstep.node.get_clock())
    for _ in range(3):
        assert read() == lockstep.now == lockstep.node.get_clock().now().nanoseconds
        lockstep.run_for(0.1)
    lockstep.jump(-0.2)
    assert read() == lockstep.now


def test_sleep_is_wrapped_once(ros):
    clock, slept = Clock(), []
    for _ in range(2):
        internals.wrap_sleep(clock, lambda _: slept.append)
    clock.sleep_until(1)
    assert slept == [1]


def test_sleep_for_calls_sleep_until(ros):
    from rclpy.duration import Duration

    clock = Clock()
    internals.wrap_sleep(clock, lambda _: lambda until, *_, **__: until.nanoseconds > 0)
    assert clock.sleep_for(Duration(seconds=1e6)) is True


def test_restarted_timer_expires_one_new_period_later(lockstep):
    expired = []
    timer = lockstep.node.create_timer(1.0, lambda: expired.append(lockstep.now))
    lockstep.run_for(0.5)
    start = lockstep.now
    internals.restart_timer(timer, SECOND // 5)
    lockstep.run_for(0.45)
    assert expired == [start + SECOND // 5, start + 2 * SECOND // 5]
    timer.cancel()
    start = lockstep.now
    internals.restart_timer(timer, SECOND // 2)
    lockstep.run_for(0.6)
    assert expired[2:] == [start + SECOND // 2]


@pytest.mark.parametrize(
    ('elapsed', 'period', 'first'), [(0.5, 0.2, 0.2), (0.9, 0.2, 0.1), (0.5, 2.0, 0.5)]
)
def test_changed_period_keeps_an_earlier_expiry(lockstep, elapsed, period, first):
    expired = []
    timer = lockstep.node.create_timer(1.0, lambda: expired.append(lockstep.now))
    lockstep.run_for(elapsed)
    start = lockstep.now
    internals.change_timer_period(timer, round(period * SECOND))
    lockstep.run_for(3.0)
    assert expired[0] == start + round(first * SECOND)
    assert timer.timer_period_ns == round(period * SECOND)


def test_timer_handle_knows_when_the_timer_expires(ros):
    timer = ros.peer.create_timer(100.0, lambda: None, autostart=False)
    handle = internals.timer_handle(timer)
    assert handle.time_until_next_call() is None
    timer.reset()
    assert 0 < handle.time_until_next_call() <= 100 * SECOND
    internals.restart_timer(timer, 1)
    while handle.time_until_next_call() > 0:
        pass
    internals.restart_timer(timer, 100 * SECOND)
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
    message = ClockMessage()
    message.clock.sec = 7
    clock.set(Time.from_msg(message.clock))
    assert node.get_clock().now().nanoseconds == 7 * SECOND
    set_directly = dict(vars(node._time_source))
    node._time_source.clock_callback(message)
    assert vars(node._time_source) == set_directly
    assert internals.SimulatedClock(ros.peer).subscription is None


# --- Messages


def test_messages_are_taken_until_the_use_ends(ros):
    node = ros.add(Node, node_name='taking')
    subscription = node.create_subscription(String, 'words', lambda _: None, 10)
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


def test_callbacks_with_message_info_are_known(ros):
    subscription = ros.peer.create_subscription(String, 'words', lambda message: None, 10)
    assert not internals.receives_info(subscription)
    subscription.callback = lambda message, info: None
    assert internals.receives_info(subscription)


def test_requests_and_responses_are_wrapped_and_restored(ros):
    node = ros.add(Node, node_name='served')
    node.create_service(GetParameters, 'ask', lambda request, response: response)
    client = ros.peer.create_client(GetParameters, 'ask')
    ros.until(client.service_is_ready, 'the service')
    sent = []

    def wrap(send):
        def count(self, *args):
            sent.append(type(self).__name__)
            return send(self, *args)

        return count

    restore = internals.wrap_calls(wrap)
    try:
        future = client.call_async(GetParameters.Request())
        ros.until(future.done, 'the response')
    finally:
        restore()
    future = client.call_async(GetParameters.Request())
    ros.until(future.done, 'another response')
    assert sent == ['Client', 'Service']


def test_publish_is_wrapped_and_restored(ros):
    ros.listen(String, 'words')
    publisher = ros.talk(String, 'words')
    published = []

    def wrap(publish):
        def count(self, message):
            published.append((self.topic_name, message.data))
            publish(self, message)

        return count

    restore = internals.wrap_publish(wrap)
    try:
        publisher.publish(String(data='one'))
    finally:
        restore()
    publisher.publish(String(data='two'))
    assert published == [('/words', 'one')]


def test_new_nodes_are_told_until_it_is_restored(ros):
    created = []
    restore = internals.on_new_node(created.append)
    try:
        nodes = [
            Node('plain', context=ros.peer.context),
            LifecycleNode('managed', context=ros.peer.context),
        ]
    finally:
        restore()
    nodes.append(Node('later', context=ros.peer.context))
    assert created == nodes[:2]
    for node in nodes:
        node.destroy_node()


def test_waiting_messages_are_taken_serialized_with_what_the_middleware_knows(ros):
    subscription = ros.peer.create_subscription(
        String, 'words', lambda _: None, QoSProfile(depth=10), raw=True
    )
    publishers = [ros.talk(String, 'words') for _ in range(2)]
    before = time.time_ns()
    for word in ('one', 'two', 'x' * 100_000):
        for publisher in publishers:
            publisher.publish(String(data=word))
    taken = list(internals.waiting_messages(subscription))
    assert [one.data for one in taken[::2]] == [
        serialize_message(String(data=word)) for word in ('one', 'two', 'x' * 100_000)
    ]
    assert [one.number for one in taken] == [1, 1, 2, 2, 3, 3]
    assert all(before <= one.sent <= one.received <= time.time_ns() for one in taken)
    endpoints = ros.peer.get_publishers_info_by_topic(subscription.topic_name)
    assert {bytes(one.endpoint_gid) for one in endpoints} == {one.publisher for one in taken}
    assert len({one.publisher for one in taken[::2]}) == 1
    assert list(internals.waiting_messages(subscription)) == []


def test_the_single_threaded_executor_leaves_polled_subscriptions_alone(ros):
    polled = ros.peer.create_subscription(
        String, 'words', pytest.fail, QoSProfile(depth=10), raw=True, callback_group=internals.Polled()
    )
    heard = []
    ros.peer.create_subscription(String, 'words', heard.append, 10)
    publisher = ros.talk(String, 'words')
    ros.executor.shutdown()
    executor = SingleThreadedExecutor(context=ros.context)
    executor.add_node(ros.peer)
    publisher.publish(String(data='one'))
    while not heard:
        executor.spin_once()
    executor.shutdown()
    assert len(list(internals.waiting_messages(polled))) == 1


def test_lost_messages_are_counted_where_the_middleware_reports_them(ros):
    def subscribe(**events):
        callbacks = SubscriptionEventCallbacks(use_default_callbacks=False, **events)
        return ros.peer.create_subscription(
            String, 'words', print, 1, callback_group=internals.Polled(), event_callbacks=callbacks
        )

    assert internals.lost_messages(subscribe()) == 0
    assert internals.lost_messages(subscribe(message_lost=print)) == 0


# --- Log


def test_a_line_is_logged_with_the_place_of_the_caller(ros, monkeypatch, capfd):
    logged = []
    monkeypatch.setattr(
        internals.rclpy_implementation, 'rclpy_logging_rcutils_log', lambda *given: logged.append(given)
    )
    node = ros.add(Node, node_name='logging')
    internals.log_info(node, 'a line')
    [(severity, name, text, function, file, line)] = logged
    assert (int(severity), name, text) == (20, 'logging', 'a line')
    assert function == 'test_a_line_is_logged_with_the_place_of_the_caller'
    assert Path(file) == Path(__file__)
    assert Path(file).read_text().splitlines()[line - 1].strip() == "internals.log_info(node, 'a line')"
    node.get_logger().set_level(LoggingSeverity.ERROR)
    internals.log_info(node, 'another')
    assert len(logged) == 1
    monkeypatch.undo()
    node.get_logger().set_level(LoggingSeverity.INFO)
    internals.log_info(node, 'written {name} %s')
    assert '[INFO]' in (said := capfd.readouterr().err)
    assert said.rstrip().endswith('[logging]: written {name} %s')


# --- Executors


def test_events_executor_runs_a_task_after_the_queued_events(ros):
    executor = internals.events_executor(ros.context)
    node = Node('queued', context=ros.context)
    order = []
    node.create_subscription(String, 'words', lambda message: order.append(message.data), 10)
    publisher = node.create_publisher(String, 'words', 10)
    executor.add_node(node)
    registered = executor.create_task(lambda: None)
    while not registered.done():
        executor.spin_once(timeout_sec=1.0)
    # Delivered within publish: the message is queued before the task.
    publisher.publish(String(data='message'))
    task = executor.create_task(order.append, 'task')
    while not task.done():
        executor.spin_once(timeout_sec=1.0)
    assert order == ['message', 'task']
    executor.shutdown()
    node.destroy_node()


def test_events_executor_releases_nodes_at_shutdown_and_can_be_used_again(ros):
    executor = internals.events_executor(ros.context)
    node = Node('released', context=ros.context)
    received = []
    node.create_subscription(String, 'words', lambda message: received.append(message.data), 10)
    publisher = node.create_publisher(String, 'words', 10)
    single = SingleThreadedExecutor(context=ros.context)
    for number, current in enumerate((executor, single, executor)):
        executor.shutdown()
        publisher.publish(String(data=str(number)))
        current.add_node(node)
        while len(received) <= number:
            current.spin_once(timeout_sec=1.0)
    assert received == ['0', '1', '2']
    executor.shutdown()
    single.shutdown()
    node.destroy_node()


def test_ready_callbacks_are_executed_in_rounds(ros):
    node = Node('rounds', context=ros.context, start_parameter_services=False)
    received = []
    for topic in ('first', 'second'):
        node.create_subscription(String, topic, lambda message: received.append(message.data), 10)
    publishers = [node.create_publisher(String, topic, 10) for topic in ('first', 'second')]
    single = SingleThreadedExecutor(context=ros.context)
    single.add_node(node)
    while internals.execute_ready(single):
        pass
    for publisher, count in zip(publishers, (2, 1), strict=True):
        for number in range(count):
            publisher.publish(String(data=f'{publisher.topic_name}{number}'))
    rounds = []
    while not rounds or rounds[-1]:
        rounds.append(len(received))
        while internals.execute_ready(single):
            pass
        rounds[-1] = len(received) - rounds[-1]
    assert rounds == [2, 1, 0]
    assert received[-1] == '/first1'
    single.shutdown()
    node.destroy_node()


def test_entities_of_a_node_are_counted(ros):
    node = Node('counted', context=ros.context, start_parameter_services=False)
    before = internals.entity_count(node)
    node.create_timer(1.0, lambda: None)
    node.create_client(GetParameters, 'get')
    assert internals.entity_count(node) == before + 2
    node.create_subscription(String, 'words', [].append, 2000)
    # With its QoS events.
    assert internals.entity_count(node) > before + 2
    assert internals.longest_queue(node) == 2000
    node.create_subscription(String, 'all', [].append, QoSProfile(history=HistoryPolicy.KEEP_ALL))
    assert internals.longest_queue(node) == sys.maxsize
    node.destroy_node()


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


def test_nodes_that_require_a_wait_set_are_detected(ros):
    async def wait(message):
        pass

    def on_message(message):
        pass

    def with_info(message, info):
        pass

    for callback, required in ((on_message, False), (with_info, True), (wait, True)):
        node = Node('detected', context=ros.context)
        node.create_subscription(String, 'words', callback, 10)
        assert internals.requires_wait_set(node) == required
        node.destroy_node()


def test_tasks_that_are_not_done_are_detected(ros):
    single = SingleThreadedExecutor(context=ros.context)
    assert not internals.has_tasks(single)
    task = single.create_task(lambda: None)
    assert internals.has_tasks(single)
    while not task.done():
        single.spin_once(timeout_sec=1.0)
    assert not internals.has_tasks(single)
    single.shutdown()


def test_rclpy_without_the_events_executor_is_detected(ros, monkeypatch):
    monkeypatch.setitem(sys.modules, 'rclpy.experimental.events_executor', None)
    assert internals.events_executor(ros.context) is None


def test_new_task_runs_a_function_when_it_is_called(ros):
    task = internals.new_task(divmod, (7, 2), {}, ros.executor)
    assert not task.done()
    task()
    assert task.done()
    assert task.result() == (3, 1)


def test_new_task_continues_a_coroutine_with_each_call(ros):
    from rclpy.task import Future

    future = Future()

    async def wait():
        return await future

    task = internals.new_task(wait(), (), {}, ros.executor)
    task()
    assert not task.done()
    future.set_result('done')
    task()
    assert task.result() == 'done'


# --- Other modules


def _uses_rclpy(tree):
    return any(
        (isinstance(node, ast.ImportFrom) and (node.module or '').split('.')[0] == 'rclpy')
        or (isinstance(node, ast.Import) and any(n.name.split('.')[0] == 'rclpy' for n in node.names))
        for node in ast.walk(tree)
    )


def _internals_in(path):
    """Return the accesses to internals of rclpy in a file."""
    text = path.read_text(encoding='utf-8')
    if 'rclpy' not in text or not _uses_rclpy(tree := ast.parse(text)):
        return set()
    own = {
        *(node.name for node in ast.walk(tree) if isinstance(node, (ast.ClassDef, ast.FunctionDef))),
        *(
            target.attr
            for node in ast.walk(tree)
            if isinstance(node, (ast.Assign, ast.AnnAssign))
            for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
            if isinstance(target, ast.Attribute)
            and isinstance(target.value, ast.Name)
            and target.value.id == 'self'
        ),
        *(
            node.target.id
            for node in ast.walk(tree)
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
        ),
    }
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith(
            ('rclpy.impl', 'rclpy.experimental')
        ):
            found.add(node.module)
        elif isinstance(node, ast.Attribute) and node.attr.startswith('_'):
            private = not node.attr.startswith('__')
            of_self = isinstance(node.value, ast.Name) and node.value.id in ('self', 'cls')
            if private and not of_self and node.attr not in own:
                found.add(node.attr)
        elif isinstance(node, ast.Attribute) and (
            node.attr == 'take_message'
            or (node.attr == 'timer_period_ns' and isinstance(node.ctx, ast.Store))
        ):
            found.add(node.attr)
    return found


def test_a_raw_subscription_receives_the_info_of_messages(ros, executor_kind):
    """Two publishers count their messages separately."""
    received = []

    def on_message(data, info):
        text = deserialize_message(data, String).data
        received.append((text, info['publication_sequence_number']))

    callback = internals.with_message_info(on_message)
    ros.peer.create_subscription(String, 'words', callback, 10, raw=True)
    publishers = [ros.talk(String, 'words') for _ in range(2)]
    for text in ('a', 'b', 'c'):
        for publisher in publishers:
            publisher.publish(String(data=text))
    ros.until(lambda: len(received) == 6, 'all are received')
    assert received == [('a', 1), ('a', 1), ('b', 2), ('b', 2), ('c', 3), ('c', 3)]


def test_the_search_for_internals_finds_those_of_the_adapter():
    found = _internals_in(PACKAGE / 'ros' / 'rclpy_internals.py')
    assert {'rclpy.impl.implementation_singleton', '_parameters', '_time_source', '_clock_sub'} <= found
    assert {'rclpy.experimental.events_executor', 'timer_period_ns', 'take_message'} <= found


def test_no_other_module_uses_internals_of_rclpy():
    found = {
        str(path.relative_to(PACKAGE)): internals_found
        for path in PACKAGE.rglob('*.py')
        if path.name != 'rclpy_internals.py' and (internals_found := _internals_in(path))
    }
    assert found == {}
