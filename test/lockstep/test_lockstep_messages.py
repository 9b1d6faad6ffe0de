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

"""Messages and services in lockstep: who receives them, and in which order."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import Vector3
from lifecycle_msgs.msg import TransitionEvent
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger
from users_nodes import Blinker, Echo

from diffdrive_jacobian.testing import LockstepError

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


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


@pytest.mark.parametrize(('depth', 'first'), [(2, 498), (500, 0)])
def test_a_queue_keeps_as_many_messages_of_a_burst_as_it_is_deep(lockstep, depth, first):
    heard, numbers = [], [float(number) for number in range(500)]
    lockstep.node.create_subscription(Vector3, 'a', lambda m: heard.append(m.x), depth)
    publisher = lockstep.node.create_publisher(Vector3, 'a', 500)
    lockstep.node.create_timer(0.1, lambda: [publisher.publish(Vector3(x=one)) for one in numbers])
    lockstep.run_for(0.2)
    assert heard == numbers[first:] * 2


def test_latched_messages_reach_those_who_come_later_in_one_order(lockstep):
    speaker = lockstep.add(Node('speaker'))
    for topic in 'abcdefgh':
        publisher = speaker.create_publisher(Vector3, topic, LATCHED)
        for index in range(3):
            publisher.publish(Vector3(x=float(index)))
    heard = []
    late = Node('late')
    for topic in 'hgfedcba':
        late.create_subscription(
            Vector3, topic, lambda m, topic=topic: heard.append((topic, m.x)), LATCHED
        )
    lockstep.add(late)
    assert heard == [(topic, x) for topic in 'hgfedcba' for x in (0.0, 1.0, 2.0)]
    assert [message.x for message in lockstep.listen(Vector3, 'c', latched=True)] == [0.0, 1.0, 2.0]


# --- Forms


def test_bytes_and_messages_reach_raw_and_typed_subscriptions_and_those_with_info(lockstep):
    typed, raw, infos = [], [], []
    node = lockstep.node
    node.create_subscription(Vector3, 'a', lambda m: typed.append(m.x), 10)
    node.create_subscription(Vector3, 'a', raw.append, 10, raw=True)
    node.create_subscription(Vector3, 'a', lambda m, info: infos.append((m.x, info)), 10)
    publisher = node.create_publisher(Vector3, 'a', 10)
    one, two = Vector3(x=1.0), Vector3(x=2.0)
    publisher.publish(one)
    publisher.publish(serialize_message(two))
    lockstep.settle()
    assert typed == [x for x, _ in infos] == [1.0, 2.0]
    assert raw == [serialize_message(one), serialize_message(two)]
    assert infos[0][1]['source_timestamp'] > 0


def test_messages_that_rcl_publishes_itself_are_received(lockstep):
    states = []
    node = lockstep.add(LifecycleNode('managed'))
    lockstep.node.create_subscription(
        TransitionEvent, 'managed/transition_event', lambda m: states.append(m.goal_state.label), 10
    )
    lockstep.node.create_timer(0.1, node.trigger_configure)
    lockstep.run_for(0.1)
    assert states == ['configuring', 'inactive']


# --- What is created and destroyed meanwhile


def test_what_is_created_in_a_callback_is_served_from_then_on(lockstep):
    heard = []
    node = lockstep.add(Node('growing'))
    node.create_subscription(
        Vector3, 'a', lambda _: node.create_subscription(Vector3, 'b', heard.append, 10), 10
    )
    lockstep.publish('a', Vector3())
    lockstep.publish('b', Vector3(x=2.0))
    assert [message.x for message in heard] == [2.0]
    node.destroy_subscription(list(node.subscriptions)[-1])
    with pytest.raises(LockstepError, match='/b has no subscription'):
        lockstep.publish('b', Vector3())


def test_a_subscription_or_service_that_was_destroyed_receives_nothing_more(lockstep):
    heard, node = [], lockstep.node

    def once(message):
        heard.append(message.x)
        node.destroy_subscription(subscription)
        node.destroy_service(service)

    subscription = node.create_subscription(Vector3, 'a', once, 10)
    service = node.create_service(Trigger, 'ask', lambda _, response: heard.append(9) or response)
    publisher, client = node.create_publisher(Vector3, 'a', 10), node.create_client(Trigger, 'ask')
    lockstep.settle()
    for number in range(3):
        publisher.publish(Vector3(x=float(number)))
    future = client.call_async(Trigger.Request())
    lockstep.run_for(0.1)
    assert heard == [0.0]
    assert not future.done()


def test_a_node_that_was_destroyed_receives_nothing_more(lockstep):
    """By itself, or by a callback of another one."""
    blinker, parrot = lockstep.add(Blinker(rate=10.0)), lockstep.add(Echo('parrot', 'a', 'b'))
    heard = lockstep.listen(Vector3, 'b')
    lockstep.publish('a', Vector3())
    parrot.destroy_node()
    lockstep.run_for(0.5)
    assert (len(blinker.ticks), len(heard)) == (6, 1)
    with pytest.raises(LockstepError, match='/a has no subscription'):
        lockstep.publish('a', Vector3())
    # Another one may take its place at once, and it can be removed still.
    parrot = lockstep.add(Echo('parrot', 'a', 'b'))
    parrot.destroy_node()
    lockstep.remove(parrot)
    first, second = lockstep.add(Node('first')), lockstep.add(Node('second'))
    first.create_subscription(Vector3, 'a', lambda _: second.destroy_node(), 10)
    second.create_subscription(Vector3, 'a', heard.append, 10)
    lockstep.publish('a', Vector3())
    assert len(heard) == 1
    assert lockstep.nodes == [lockstep.node, blinker, first]


def test_a_node_processes_what_was_sent_before_it_is_removed(lockstep):
    node, executors = lockstep.add(Node('short_lived')), []
    node.create_subscription(Vector3, 'a', lambda _: executors.append(node.executor), 10)
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    lockstep.settle()
    publisher.publish(Vector3())
    lockstep.remove(node)
    assert len(executors) == 1
    assert executors != [None]
    publisher.publish(Vector3())
    lockstep.settle()
    assert len(executors) == 1
    with pytest.raises(LockstepError, match='was not added'):
        lockstep.remove(node)
