"""Messages in lockstep: their order, where they come from, and how they are reported."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import Vector3
from lifecycle_msgs.msg import TransitionEvent
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from users_nodes import Blinker, Echo

from diffdrive_jacobian.testing import Lockstep, LockstepError

# --- Order


def test_messages_and_services_are_executed_in_the_order_in_which_they_were_sent(lockstep):
    order = []
    server, other = lockstep.add(Node('server')), lockstep.add(Node('other'))
    server.create_service(Trigger, 'ask', lambda _, response: order.append('request') or response)
    for topic in 'abc':
        other.create_subscription(Vector3, topic, lambda _, topic=topic: order.append(topic), 10)
    client = lockstep.node.create_client(Trigger, 'ask')
    publishers = {topic: lockstep.node.create_publisher(Vector3, topic, 10) for topic in 'abc'}
    lockstep.settle()

    def send():
        publishers['c'].publish(Vector3())
        future = client.call_async(Trigger.Request())
        future.add_done_callback(lambda _: order.append('response'))
        publishers['a'].publish(Vector3())
        publishers['b'].publish(Vector3())

    lockstep.node.create_timer(0.1, send)
    lockstep.run_for(0.2)
    assert order == ['c', 'request', 'a', 'b', 'response'] * 2


def test_subscriptions_of_a_topic_come_in_the_order_of_their_nodes(lockstep):
    order = []
    for name in ('third', 'first', 'second'):
        node = lockstep.add(Node(name))
        node.create_subscription(Vector3, 'a', lambda _, name=name: order.append(name), 10)
    lockstep.publish('a', Vector3())
    lockstep.publish('a', Vector3())
    assert order == ['third', 'first', 'second'] * 2


def test_a_short_queue_keeps_the_last_messages(lockstep):
    heard = []
    lockstep.node.create_subscription(Vector3, 'a', lambda m: heard.append(m.x), QoSProfile(depth=2))
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    lockstep.node.create_timer(0.1, lambda: [publisher.publish(Vector3(x=float(i))) for i in range(5)])
    lockstep.run_for(0.2)
    assert heard == [3.0, 4.0] * 2


def test_bytes_and_messages_reach_raw_and_typed_subscriptions(lockstep):
    typed, raw = [], []
    lockstep.node.create_subscription(Vector3, 'a', lambda m: typed.append(m.x), 10)
    lockstep.node.create_subscription(Vector3, 'a', raw.append, 10, raw=True)
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    one, two = Vector3(x=1.0), Vector3(x=2.0)
    publisher.publish(one)
    publisher.publish(serialize_message(two))
    lockstep.settle()
    assert typed == [1.0, 2.0]
    assert raw == [serialize_message(one), serialize_message(two)]


def test_messages_that_rcl_publishes_itself_are_received(lockstep):
    states = []
    node = lockstep.add(LifecycleNode('managed'))
    lockstep.node.create_subscription(
        TransitionEvent, 'managed/transition_event', lambda m: states.append(m.goal_state.label), 10
    )
    lockstep.node.create_timer(0.1, node.trigger_configure)
    lockstep.run_for(0.1)
    assert states == ['configuring', 'inactive']


def test_a_callback_that_was_replaced_is_called(lockstep):
    old, new = [], []
    subscription = lockstep.node.create_subscription(Vector3, 'a', old.append, 10)
    lockstep.publish('a', Vector3())
    subscription.callback = lambda message, info: new.append((message, info))
    lockstep.publish('a', Vector3())
    assert [len(old), len(new)] == [1, 1]


def test_a_node_that_destroys_itself_receives_nothing_more(lockstep):
    blinker, parrot = lockstep.add(Blinker(rate=10.0)), lockstep.add(Echo('parrot', 'a', 'b'))
    heard = lockstep.listen(Vector3, 'b')
    lockstep.publish('a', Vector3())
    parrot.destroy_node()
    lockstep.run_for(0.5)
    assert len(blinker.ticks) == 6
    assert len(heard) == 1
    with pytest.raises(LockstepError, match='/a has no subscription'):
        lockstep.publish('a', Vector3())


def test_a_subscription_that_its_callback_destroys_receives_nothing_more(lockstep):
    heard = []

    def once(message):
        heard.append(message.x)
        lockstep.node.destroy_subscription(subscription)

    subscription = lockstep.node.create_subscription(Vector3, 'a', once, 10)
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    lockstep.settle()
    for number in range(3):
        publisher.publish(Vector3(x=float(number)))
    lockstep.settle()
    lockstep.run_for(0.1)
    assert heard == [0.0]


def test_a_node_that_another_one_destroys_receives_nothing_more(lockstep):
    first, second = lockstep.add(Node('first')), lockstep.add(Node('second'))
    heard = []
    first.create_subscription(Vector3, 'a', lambda _: second.destroy_node(), 10)
    second.create_subscription(Vector3, 'a', heard.append, 10)
    lockstep.publish('a', Vector3())
    assert heard == []
    assert second not in lockstep.nodes


def test_a_node_processes_what_was_sent_before_it_is_removed(lockstep):
    node, executors = lockstep.add(Node('short_lived')), []
    node.create_subscription(Vector3, 'a', lambda _: executors.append(node.executor), 10)
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    lockstep.settle()
    publisher.publish(Vector3())
    lockstep.remove(node)
    assert executors != [None]
    assert len(executors) == 1


def test_a_node_that_was_destroyed_can_be_removed(lockstep):
    node = lockstep.add(Node('short_lived'))
    node.destroy_node()
    lockstep.remove(node)
    assert lockstep.nodes == [lockstep.node]


def test_what_could_not_be_published_is_not_reported(lockstep):
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    with pytest.raises(TypeError):
        publisher.publish('a')
    assert 'none' in lockstep.report()
    publisher.publish(Vector3(x=2.0))
    with pytest.raises(TypeError):
        publisher.publish('a')
    assert lockstep.last('a') == Vector3(x=2.0)
    assert 'a: 1 from' in lockstep.report()


# --- Time


def test_a_users_subscription_to_clock_receives_each_time(lockstep):
    lockstep.add(Blinker(rate=4.0))
    clocks = lockstep.listen(Clock, '/clock')
    lockstep.run_for(1.0)
    lockstep.jump(10.0)
    times = [message.clock.sec + message.clock.nanosec * 1e-9 for message in clocks]
    assert times == [1.25, 1.5, 1.75, 2.0, 12.0]


def test_all_clocks_are_set_before_a_callback_of_clock(lockstep):
    seen = []
    early, late = Node('early'), Node('late')
    early.create_subscription(
        Clock, '/clock', lambda _: seen.append(late.get_clock().now().nanoseconds - lockstep.now), 10
    )
    lockstep.add(early)
    lockstep.add(late)
    seen.clear()
    for _ in range(3):
        lockstep.step(at_most=0.5)
    assert seen == [0, 0, 0]


def test_jump_callbacks_of_a_users_clock_are_called(lockstep):
    jumps = []
    node = lockstep.add(Node('jumping'))
    publisher = node.create_publisher(Vector3, 'a', 10)

    def on_jump(jump):
        jumps.append(jump.delta.nanoseconds)
        publisher.publish(Vector3(x=1.0))

    threshold = JumpThreshold(
        min_forward=Duration(seconds=1.0), min_backward=Duration(seconds=-1.0), on_clock_change=False
    )
    handle = node.get_clock().create_jump_callback(threshold, post_callback=on_jump)
    heard = lockstep.listen(Vector3, 'a')
    lockstep.node.create_timer(0.1, lambda: None)
    lockstep.run_for(1.0)
    assert jumps == []
    lockstep.jump(5.0)
    lockstep.jump(-3.0)
    assert jumps == [5_000_000_000, -3_000_000_000]
    assert len(heard) == 2
    handle.unregister()


def test_a_jump_callback_that_blocks_is_named():
    with Lockstep(patience=0.5) as world:
        node = world.add(Node('jumping'))
        threshold = JumpThreshold(
            min_forward=Duration(seconds=1.0), min_backward=None, on_clock_change=False
        )
        handle = node.get_clock().create_jump_callback(threshold, pre_callback=forever)
        with pytest.raises(
            LockstepError, match=r'forever \(.*test_lockstep_messages.py.*has not returned'
        ):
            world.jump(5.0)
        handle.unregister()


def forever():
    while True:
        pass


@pytest.mark.lockstep(args=['--ros-args', '-r', 'other:/clock:=/other_clock'])
def test_a_node_with_another_topic_for_its_clock_follows_that(lockstep):
    other, blinker = lockstep.add(Blinker('other')), lockstep.add(Blinker())
    message = Clock()
    message.clock.sec = 77
    lockstep.publish('/other_clock', message)
    lockstep.run_for(0.1)
    assert other.get_clock().now().nanoseconds == 77_000_000_000
    assert blinker.get_clock().now().nanoseconds == lockstep.now


def test_a_node_on_wall_time_is_named_when_it_changes_within_a_run(lockstep):
    node = lockstep.add(Node('changing'))
    node.create_timer(0.1, lambda: node.set_parameters([Parameter('use_sim_time', value=False)]))
    with pytest.raises(LockstepError, match='node /changing runs on wall time'):
        lockstep.run_for(1.0)


def test_what_a_condition_creates_or_changes_takes_effect_at_once(lockstep):
    server = lockstep.add(Node('server'))
    answered, ticks = [], []
    server.create_service(
        Trigger, 'ask', lambda _, response: answered.append(lockstep.elapsed) or response
    )
    client = lockstep.node.create_client(Trigger, 'ask')
    slow = lockstep.node.create_timer(0.5, lambda: ticks.append(lockstep.elapsed))

    def condition():
        if lockstep.elapsed == 0.5:
            client.call_async(Trigger.Request())
            lockstep.node.create_timer(0.2, lambda: ticks.append(('new', lockstep.elapsed)))
        if lockstep.elapsed == 0.7:
            slow.reset()
        return lockstep.elapsed >= 1.2

    lockstep.run_until(condition, timeout=2.0)
    assert answered == [0.5]
    assert ticks == [0.5, ('new', 0.7), ('new', 0.9), ('new', 1.1), 1.2]


# --- Last messages


def test_last_is_the_last_message_of_all_publishers(lockstep):
    one, two = (lockstep.node.create_publisher(Vector3, 'a', 10) for _ in range(2))
    for publisher, x in ((one, 1.0), (two, 2.0), (one, 3.0)):
        publisher.publish(Vector3(x=x))
        assert lockstep.last('a').x == x
    two.publish(serialize_message(Vector3(x=4.0)))
    assert lockstep.last('/a') == Vector3(x=4.0)
    with pytest.raises(LockstepError, match='no message was published on /b\n'):
        lockstep.last('b')


def test_the_report_decodes_bytes(lockstep):
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    publisher.publish(serialize_message(Vector3(x=0.5)))
    assert 'last at 1 s: Vector3(x=0.5)' in lockstep.report()
    publisher.publish(b'\0\1')
    assert 'last at 1 s: 2 serialized bytes' in lockstep.report()


def test_the_report_contains_what_was_received(lockstep):
    heard = lockstep.listen(Vector3, 'a')
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    message = Vector3()
    # As `message.x = 1` without the checks of rclpy, which are on in these tests.
    message._x = 1
    publisher.publish(message)
    lockstep.settle()
    # Which one depends on the version of Python.
    assert 0.0 < heard[0].x < 1e-300
    assert lockstep.last('a').x == heard[0].x
    assert f'Vector3(x={heard[0].x})' in lockstep.report()


def test_the_report_contains_a_message_that_is_not_valid_any_more(lockstep):
    publisher = lockstep.node.create_publisher(Header, 'a', 10)
    message = Header(frame_id='odom')
    publisher.publish(message)
    message._stamp = None
    assert "frame_id='odom'" in lockstep.report()


# --- Nodes that were not added


def test_publishing_to_a_node_that_was_not_added_fails(lockstep):
    forgotten = Echo('forgotten', 'a', 'b')
    lockstep.listen(Vector3, 'a')
    words = '/a is subscribed to by /forgotten: created, but not added to lockstep$'
    with pytest.raises(LockstepError, match=words):
        lockstep.publish('a', Vector3())
    heard = lockstep.listen(Vector3, 'b')
    lockstep.add(forgotten)
    lockstep.publish('a', Vector3())
    assert len(heard) == 1
    another = Echo('another', 'a', 'c')
    with pytest.raises(LockstepError, match='by /another: created'):
        lockstep.publish('a', Vector3())
    another.destroy_node()
    lockstep.publish('a', Vector3())


def test_publishing_to_a_node_that_replaces_one_that_was_added_fails(lockstep):
    heard = lockstep.listen(Vector3, 'a')
    added = lockstep.add(Echo('added', 'a', 'b'))
    lockstep.publish('a', Vector3())
    lockstep.remove(added)
    forgotten = Echo('forgotten', 'a', 'b')
    with pytest.raises(LockstepError, match='/a is subscribed to by /forgotten: created, but not added'):
        lockstep.publish('a', Vector3())
    forgotten.destroy_node()
    lockstep.publish('a', Vector3())
    assert len(heard) == 2


def test_publishing_to_a_second_node_of_the_same_name_fails(lockstep):
    forgotten = Echo('twin', 'a', 'b')
    lockstep.add(Echo('twin', 'a', 'b'))
    words = r'/a is subscribed to by /twin \(a second node of this name\): created, but not added'
    with pytest.raises(LockstepError, match=words):
        lockstep.publish('a', Vector3())
    # The graph loses the name of both.
    forgotten.destroy_node()
    lockstep.publish('a', Vector3())


@pytest.mark.lockstep(args=['--ros-args', '-r', 'a:=/deep/a', '-r', '/deep/a:=/deeper'])
def test_publishing_to_a_node_that_was_not_added_fails_when_topics_are_remapped(lockstep):
    forgotten = Echo('forgotten', 'a', 'b')
    with pytest.raises(LockstepError, match='/deep/a is subscribed to by /forgotten: created'):
        lockstep.publish('a', Vector3())
    lockstep.add(forgotten)
    heard = lockstep.listen(Vector3, 'b')
    lockstep.publish('a', Vector3(x=2.0))
    assert heard == [Vector3(x=2.0)]
    assert lockstep.last('b') == lockstep.last('a') == Vector3(x=2.0)


@pytest.mark.parametrize(
    ('message', 'described'),
    [
        (b'', r'bytes; serialized messages: node.create_publisher\(TYPE, TOPIC, 10\).publish\(BYTES\)$'),
        (bytearray(), 'bytearray; serialized messages: '),
        (None, 'NoneType$'),
        ({'x': 1.0}, 'dict$'),
        (1.0, 'float$'),
    ],
)
def test_publishing_what_is_no_message_fails(lockstep, message, described):
    words = f"publish takes a topic and a message, got 'a' and an object of the class {described}"
    with pytest.raises(LockstepError, match=words):
        lockstep.publish('a', message)


def test_last_takes_the_name_of_a_topic(lockstep):
    with pytest.raises(LockstepError, match='last takes a topic, got the class Vector3'):
        lockstep.last(Vector3)


def test_a_service_destroyed_while_a_request_waits_is_not_called(lockstep):
    called, node = [], lockstep.node
    service = node.create_service(Trigger, 'ask', lambda _, response: called.append(1) or response)
    node.create_subscription(Vector3, 'end', lambda _: node.destroy_service(service), 10)
    publisher, client = node.create_publisher(Vector3, 'end', 10), node.create_client(Trigger, 'ask')
    lockstep.settle()
    publisher.publish(Vector3())
    future = client.call_async(Trigger.Request())
    lockstep.run_for(0.1)
    assert called == []
    assert not future.done()
