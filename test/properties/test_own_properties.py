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

"""Properties for any node: limits of a field, and what one of one's own can observe."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import pytest
from geometry_msgs.msg import Pose, PoseArray
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32, Header, Int64
from std_srvs.srv import Trigger

from diffdrive_jacobian.faults import Slow
from diffdrive_jacobian.properties import FieldWithin, Property
from diffdrive_jacobian.testing import LockstepError, PropertyViolation

NAN, INF = float('nan'), float('inf')


def joints(*positions):
    return JointState(name=[f'joint {number}' for number in range(len(positions))], position=positions)


@pytest.fixture
def publish(lockstep):
    """Publish a message, or its bytes."""
    publishers = {}

    def publish(topic, message, kind=None):
        kind = kind or type(message)
        if topic not in publishers:
            publishers[topic] = lockstep.node.create_publisher(kind, topic, 10)
        publishers[topic].publish(message)

    return publish


# --- Limits of a field


@pytest.mark.parametrize(
    ('field', 'positions', 'words'),
    [
        ('position', (0.0, 1.0), ''),
        ('position[1]', (9.0, 0.5), ''),
        ('position', (0.0, 1.25), r'position is 1\.25; allowed: from -1 to 1'),
        ('position', (0.0, NAN), r'position is nan; allowed: from -1 to 1'),
        ('position[1]', (0.0, -2.0), r'position\[1\] is -2; allowed'),
        # Many are compared at once.
        ('position', (*[0.5] * 99, 1.5), 'position is 1.5'),
    ],
)
@pytest.mark.parametrize('as_bytes', [False, True])
def test_a_field_within_limits(lockstep, publish, field, positions, words, as_bytes):
    lockstep.require(FieldWithin('joint_states', field, -1.0, 1.0))
    publish('joint_states', joints(0.5, -0.5))
    message = joints(*positions)
    publish('joint_states', serialize_message(message) if as_bytes else message)
    if words:
        with pytest.raises(PropertyViolation, match=rf'^FieldWithin.*/joint_states: {words}') as raised:
            lockstep.settle()
        assert f'  0 s: /joint_states: {field} is' in str(raised.value)
    else:
        lockstep.settle()


@pytest.mark.parametrize(
    ('message', 'field', 'low', 'high', 'words'),
    [
        (PoseArray(poses=[Pose()]), 'poses[0].position.x', 1.0, INF, r'x is 0; allowed: from 1 to inf'),
        (Header(), 'stamp.sec', 1, INF, 'stamp.sec is 0; allowed: from 1 to inf'),
        (Header(), 'stamp.sec', -INF, -1, 'stamp.sec is 0; allowed: from -inf to -1'),
        # Exactly, and as they arrive.
        (Int64(data=2**63 - 1), 'data', 0, 2**63 - 2, r'data is 9.22337204e\+18'),
        (Float32(data=0.1), 'data', 0.0, 0.1, 'data is 0.100000001'),
    ],
)
def test_numbers_of_all_types_are_compared(lockstep, publish, message, field, low, high, words):
    lockstep.require(FieldWithin('topic', field, low, high))
    publish('topic', message)
    with pytest.raises(PropertyViolation, match=words):
        lockstep.settle()


@pytest.mark.parametrize(
    ('field', 'words'),
    [
        ('positions', "field 'positions' does not exist: sensor_msgs/JointState has no 'positions'"),
        ('name', "field 'name' is no number but string"),
        ('header', "field 'header' is no number but std_msgs/Header"),
    ],
)
def test_a_field_that_is_no_number_is_an_error(lockstep, publish, field, words):
    lockstep.require(FieldWithin('joint_states', field, -1.0, 1.0))
    with pytest.raises(LockstepError, match=words):
        publish('joint_states', joints(0.0))
    lockstep.close()


@pytest.mark.parametrize(
    ('field', 'messages'),
    [
        ('position[2]', 3),
        ('velocity', 3),
        ('position', 0),
    ],
)
def test_a_field_that_no_message_had_is_an_error(lockstep, field, messages):
    publisher = lockstep.node.create_publisher(JointState, 'joint_states', 10)
    lockstep.require(FieldWithin('joint_states', field, -1.0, 1.0))
    for _ in range(messages):
        publisher.publish(joints(0.0, 9.0))
    lockstep.run_for(0.1)
    with pytest.raises(LockstepError, match=rf'no message on /joint_states had {re.escape(field)}, so'):
        lockstep.finish()
    lockstep.close()


# --- Properties of one's own


class Sender(Node):
    """Publishes numbers, and has a service."""

    def __init__(self):
        super().__init__('sender')
        self.sent = 0
        self.publisher = self.create_publisher(JointState, 'joint_states', 10)
        self.create_timer(0.1, self.on_timer)
        self.create_service(Trigger, 'trigger', self.on_trigger)

    def on_timer(self):
        self.sent += 1
        self.publisher.publish(joints(self.sent))

    def on_trigger(self, _, response):
        response.message = 'triggered'
        return response


@dataclass(repr=False)
class Observes(Property):
    """Notes what it sees."""

    topic: str = 'joint_states'
    received: str = 'joint_states'
    service: str = 'trigger'

    def begin(self):
        self.published, self.delivered, self.responses = [], [], []
        self.on_published(self.topic, lambda _, message: self.published.append(message))
        self.on_delivered(self.received, lambda node, kind, message: self.delivered.append(message))
        self.on_response(self.service, lambda node, response: self.responses.append(response.message))


def test_an_own_property_gets_messages_also_of_slow_nodes(lockstep):
    """A node that is slow sends bytes: its messages leave later."""
    lockstep.node.create_subscription(JointState, 'joint_states', lambda _: None, 10, raw=True)
    required = Observes()
    watch = required.watch(lockstep)
    lockstep.create(Sender)
    lockstep.inject(Slow('sender', 0.01))
    lockstep.run_for(0.25)
    assert [list(one.position) for one in watch.published] == [[1.0], [2.0], [3.0]]
    assert [list(one.position) for one in watch.delivered] == [[1.0], [2.0], [3.0]]
    assert lockstep.call(Trigger, 'trigger').message == 'triggered'
    assert watch.responses == ['triggered']
    # The value itself has observed nothing.
    assert not hasattr(required, 'published')
    assert required == Observes() == watch


def test_bytes_that_are_no_message_violate_an_own_property(lockstep, publish):
    lockstep.require(Observes())
    lockstep.create(Sender)
    publish('joint_states', b'\0', JointState)
    with pytest.raises(PropertyViolation, match=r'joint_states: bytes that are no JointState'):
        lockstep.settle()


@pytest.mark.parametrize('name', ['topic', 'received', 'service'])
def test_a_topic_or_a_service_that_nobody_has_is_an_error(lockstep, name):
    lockstep.require(Observes(), Observes(**{name: 'misspelt'}))
    lockstep.create(Sender)
    lockstep.run_for(0.1)
    with pytest.raises(LockstepError, match=r"'misspelt'\) observes /misspelt, which no node has"):
        lockstep.finish()
    lockstep.close()


@dataclass(repr=False)
class Raises(Property):
    """Raises an error in one of its methods."""

    where: str
    seen: list = field(default_factory=list)

    def begin(self):
        self.seen.append('begin')
        self.on_published('joint_states', lambda *_: self.fail('published'))
        self.on_delivered('joint_states', lambda *_: self.fail('delivered'))
        self.on_response('trigger', lambda *_: self.fail('response'))

    def fail(self, where):
        if where == self.where:
            raise ZeroDivisionError(where)

    def check(self):
        self.fail('check')
        return super().check()

    def finish(self):
        self.fail('finish')


@pytest.mark.parametrize('where', ['published', 'delivered', 'response', 'check', 'finish'])
def test_a_property_that_raises_is_violated_and_no_node_fails(lockstep, where):
    required = Raises(where)
    lockstep.require(required)
    lockstep.node.create_subscription(JointState, 'joint_states', lambda _: None, 10)

    def run():
        lockstep.create(Sender)
        lockstep.call(Trigger, 'trigger')
        lockstep.finish()

    words = rf'^Raises.* is violated at .*: it raised ZeroDivisionError: {where}, in .*\.py:\d+ \(fail\)'
    with pytest.raises(PropertyViolation, match=words):
        run()
    # What its copy has seen is not the value's.
    assert required.seen == []


@dataclass(repr=False)
class OnlyChecks(Property):
    """Has a `check` of its own, and does not ask that of the base class."""

    def begin(self):
        self.on_published('joint_states', lambda *_: self.found('seen'))

    def check(self):
        return None


def test_what_was_found_counts_whatever_check_returns(lockstep, publish):
    lockstep.require(OnlyChecks())
    publish('joint_states', joints(0.0))
    with pytest.raises(PropertyViolation, match=r'^OnlyChecks\(\) is violated at 0 s: seen'):
        lockstep.settle()


def test_a_property_is_a_dataclass_without_reserved_names(lockstep):
    class Mine(Property):
        def __init__(self, limit):
            self.limit = limit

        def begin(self):
            pass

    with pytest.raises(LockstepError, match=r'Mine must be decorated with @dataclass\(repr=False\)'):
        lockstep.require(Mine(1.0))
    for name in ('world', 'found', 'check', '_found'):
        with pytest.raises(TypeError, match=rf'Mine.{name}: each property has something of this name'):
            type('Mine', (Property,), {'__annotations__': {name: 'int'}})
