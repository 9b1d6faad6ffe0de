"""Properties for any node: limits of a field, and what one of one's own can observe."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import pytest
from geometry_msgs.msg import Pose, PoseArray
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32, Header, Int64
from std_srvs.srv import Trigger

from diffdrive_jacobian.faults import Corrupt, Slow
from diffdrive_jacobian.properties import FieldWithin, PoseFinite, Property
from diffdrive_jacobian.testing import LockstepError, PropertyViolation

NAN = float('nan')


def joints(*positions):
    return JointState(name=[f'joint {number}' for number in range(len(positions))], position=positions)


@pytest.fixture
def publisher(lockstep):
    return lockstep.node.create_publisher(JointState, 'joint_states', 10)


@pytest.mark.parametrize(
    ('field', 'positions', 'words'),
    [
        ('position', (0.0, 1.0), ''),
        ('position[1]', (9.0, 0.5), ''),
        ('position', (0.0, 1.25), r'position is 1\.25; allowed: from -1 to 1'),
        ('position', (0.0, NAN), r'position is nan; allowed: from -1 to 1'),
        ('position[1]', (0.0, -2.0), r'position\[1\] is -2; allowed'),
    ],
)
@pytest.mark.parametrize('as_bytes', [False, True])
def test_a_field_within_limits(lockstep, publisher, field, positions, words, as_bytes):
    lockstep.require(FieldWithin('joint_states', field, -1.0, 1.0))
    publisher.publish(joints(0.5, -0.5))
    message = joints(*positions)
    publisher.publish(serialize_message(message) if as_bytes else message)
    if words:
        with pytest.raises(PropertyViolation, match=rf'^FieldWithin.*/joint_states: {words}') as raised:
            lockstep.settle()
        assert ('  0 s: /joint_states: position is 0.5, -0.5' in str(raised.value)) == (
            field == 'position'
        )
    else:
        lockstep.settle()


def test_a_field_of_nested_messages_and_integers(lockstep):
    poses = lockstep.node.create_publisher(PoseArray, 'poses', 10)
    headers = lockstep.node.create_publisher(Header, 'header', 10)
    lockstep.require(
        FieldWithin('poses', 'poses[0].position.x', 1.0, float('inf')),
        FieldWithin('header', 'stamp.sec', float('-inf'), 5.0),
    )
    poses.publish(PoseArray())
    poses.publish(PoseArray(poses=[Pose()]))
    with pytest.raises(PropertyViolation, match=r'poses\[0\].position.x is 0; allowed: from 1 to inf'):
        lockstep.settle()
    header = Header()
    header.stamp.sec = 6
    headers.publish(header)
    with pytest.raises(PropertyViolation, match=r'stamp.sec is 6; allowed: from -inf to 5'):
        lockstep.settle()


@pytest.mark.parametrize(
    ('field', 'words'),
    [
        ('positions', "field 'positions' does not exist: sensor_msgs/JointState has no 'positions'"),
        ('name', "field 'name' is no number but string"),
        ('header', "field 'header' is no number but std_msgs/Header"),
    ],
)
def test_a_field_that_is_none_or_no_number_is_an_error(lockstep, publisher, field, words):
    lockstep.require(FieldWithin('joint_states', field, -1.0, 1.0))
    with pytest.raises(LockstepError, match=words):
        publisher.publish(joints(0.0))
    lockstep.close()


@pytest.mark.parametrize(('field', 'messages'), [('position[2]', 3), ('velocity', 3), ('position', 0)])
def test_a_field_that_no_message_had_is_an_error_because_nothing_was_checked(
    lockstep, publisher, field, messages
):
    lockstep.require(FieldWithin('joint_states', field, -1.0, 1.0))
    for _ in range(messages):
        publisher.publish(joints(0.0, 9.0))
    lockstep.run_for(0.1)
    with pytest.raises(LockstepError, match=rf'no message on /joint_states had {re.escape(field)}, so'):
        lockstep.finish()
    lockstep.close()


@pytest.mark.parametrize(('field', 'change'), [('position[2]', 'nan'), ('velocity', 'negate')])
def test_a_fault_of_a_field_that_no_message_had_has_met_nothing(lockstep, publisher, field, change):
    lockstep.node.create_subscription(JointState, 'joint_states', lambda _: None, 10)
    lockstep.create(Sender)
    lockstep.inject(Corrupt('joint_states', field, change, node='lockstep'))
    lockstep.check_faults()
    lockstep.run_for(0.25)
    with pytest.raises(LockstepError, match=rf'Corrupt.*: no message had {re.escape(field)}'):
        lockstep.check_faults()
    # One is enough.
    publisher.publish(JointState(position=[1.0, 2.0, 3.0], velocity=[1.0]))
    lockstep.run_for(0.25)
    lockstep.check_faults()


def test_bytes_that_are_no_odometry_violate_a_property_of_places(lockstep):
    lockstep.require(PoseFinite())
    lockstep.node.create_publisher(Odometry, 'odom', 10).publish(b'\0')
    with pytest.raises(PropertyViolation, match='/odom: bytes that are no Odometry'):
        lockstep.settle()


def test_limits_must_leave_something():
    for low, high, words in (
        (1.0, 0.0, 'FieldWithin: low must be at most high, got 1, 0'),
        (NAN, 0.0, 'FieldWithin: low must be a number, got nan'),
        ('a', 0.0, "FieldWithin: low must be a number, got 'a'"),
    ):
        with pytest.raises(ValueError, match=words):
            FieldWithin('joint_states', 'position', low, high)


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

    topic: str

    def begin(self):
        self.published, self.delivered, self.responses = [], [], []
        self.on_published(self.topic, lambda _, message: self.published.append(message))
        self.on_delivered(self.topic, lambda node, kind, message: self.delivered.append(message))
        self.on_response('trigger', lambda node, response: self.responses.append(response.message))


def test_a_property_of_ones_own_gets_messages_also_of_bytes_and_of_slow_nodes(lockstep):
    """A node that is slow sends bytes: its messages leave later."""
    lockstep.node.create_subscription(JointState, 'joint_states', lambda _: None, 10, raw=True)
    required = Observes('joint_states')
    watch = required.watch(lockstep)
    sender = lockstep.create(Sender)
    lockstep.inject(Slow('sender', 0.01))
    lockstep.run_for(0.25)
    assert [list(one.position) for one in watch.published] == [[1.0], [2.0], [3.0]]
    assert [list(one.position) for one in watch.delivered] == [[1.0], [2.0], [3.0]]
    assert sender.sent == 3
    assert lockstep.call(Trigger, 'trigger').message == 'triggered'
    assert watch.responses == ['triggered']
    # The value itself has observed nothing.
    assert not hasattr(required, 'published')
    assert required == Observes('joint_states') == watch


def test_bytes_that_are_no_message_violate_a_property_of_ones_own(lockstep, publisher):
    lockstep.require(Observes('joint_states'))
    lockstep.create(Sender)
    publisher.publish(b'\0')
    with pytest.raises(PropertyViolation, match=r'joint_states: bytes that are no JointState'):
        lockstep.settle()


@dataclass(repr=False)
class Hears(Property):
    """Observes what is received, or what a service responds."""

    kind: str
    name: str

    def begin(self):
        observe = {'topic': self.on_delivered, 'service': self.on_response}[self.kind]
        observe(self.name, lambda *_: None)


@pytest.mark.parametrize(('kind', 'there'), [('topic', 'joint_states'), ('service', 'trigger')])
def test_a_topic_or_a_service_that_nobody_has_is_an_error(lockstep, kind, there):
    lockstep.require(Hears(kind, there), Hears(kind, 'misspelt'))
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


def test_names_that_each_property_has_cannot_be_those_of_fields():
    for name in ('world', 'found', 'check', '_found'):
        with pytest.raises(TypeError, match=rf'Mine.{name}: each property has something of this name'):
            type('Mine', (Property,), {'__annotations__': {name: 'int'}})


def test_a_property_that_is_no_dataclass_is_refused(lockstep):
    class Mine(Property):
        def __init__(self, limit):
            self.limit = limit

        def begin(self):
            pass

    with pytest.raises(LockstepError, match=r'Mine must be decorated with @dataclass\(repr=False\)'):
        lockstep.require(Mine(1.0))


def test_numbers_are_compared_as_they_arrive_and_exactly(lockstep):
    small = lockstep.node.create_publisher(Float32, 'small', 10)
    large = lockstep.node.create_publisher(Int64, 'large', 10)
    many = lockstep.node.create_publisher(JointState, 'joint_states', 10)
    lockstep.require(
        FieldWithin('small', 'data', 0.0, 0.1),
        FieldWithin('large', 'data', 0, 2**63 - 2),
        FieldWithin('joint_states', 'position', 0.0, 1.0),
    )
    for publisher, message, words in (
        (large, Int64(data=2**63 - 1), 'data is 9.22337204e\\+18'),
        (small, Float32(data=0.1), 'data is 0.100000001'),
        (many, joints(*[0.5] * 99, 1.5), 'position is 1.5'),
    ):
        publisher.publish(message)
        with pytest.raises(PropertyViolation, match=words):
            lockstep.settle()


@dataclass(repr=False)
class OnlyChecks(Property):
    """Has a `check` of its own, and does not ask that of the base class."""

    def begin(self):
        self.on_published('joint_states', lambda *_: self.found('seen'))

    def check(self):
        return None


def test_what_was_found_counts_whatever_check_returns(lockstep, publisher):
    lockstep.require(OnlyChecks())
    publisher.publish(joints(0.0))
    with pytest.raises(PropertyViolation, match=r'^OnlyChecks\(\) is violated at 0 s: seen'):
        lockstep.settle()
