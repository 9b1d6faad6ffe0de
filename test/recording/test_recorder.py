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

"""The recorder on the executor of record_run: it takes queued messages and counts missing ones."""

from __future__ import annotations

import random
from unittest import mock

import pytest
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.event_handler import UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from support.domains import domain_id
from support.harness import PATIENCE

from diffdrive_jacobian.bags.journal import Channel, Message
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError
from diffdrive_jacobian.recording import overflow, reception, recorder
from diffdrive_jacobian.recording.reception import MissedMessages
from diffdrive_jacobian.recording.recorder import Recorder, Selection
from diffdrive_jacobian.ros.rclpy_internals import ReceivedMessage
from diffdrive_jacobian.ros.runner import ros_context

pytestmark = pytest.mark.slow
BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
LATCHED = {'depth': 3, 'durability': DurabilityPolicy.TRANSIENT_LOCAL}
DEPTH = 100
"""Messages that may wait: fewer than the recorder allows."""
SECOND = 10**9


class Sink:
    """Keeps what is recorded."""

    def __init__(self):
        self.data = []
        self.stamps = []
        self.channel = None
        self.missed = {}
        self.left_out = {}
        self.set_missed = self.missed.__setitem__
        self.set_left_out = self.left_out.__setitem__

    def add(self, record):
        if isinstance(record, Message):
            self.data.append(record.data)
            self.stamps.append(record.stamp)
        if isinstance(record, Channel):
            self.channel = record


class Setting:
    """A recorder of /cmd_vel, and publishers in the same context."""

    def __init__(self, harness, *profiles, with_info=True, topics=('cmd_vel',), **options):
        self.harness = harness
        self.sink = Sink()
        self.sent = []
        self.publishers = []
        selection = Selection(topics=topics, everything=not topics)
        self.recorder = harness.add(
            Recorder, selection=selection, sink=self.sink, with_info=with_info, **options
        )
        for profile in profiles:
            self.add_publisher(**profile)

    def add_publisher(self, depth=10, **profile):
        """Create a publisher and wait until all of them are recorded."""
        qos = QoSProfile(depth=depth, **profile)
        self.publishers.append(self.harness.peer.create_publisher(Twist, 'cmd_vel', qos))
        self.until(lambda: all(one.get_subscription_count() for one in self.publishers))

    def until(self, condition):
        """Serve the nodes, and let the recorder look for topics, until a condition holds."""
        self.harness.until(lambda: (self.recorder.discover(), condition())[1], patience=PATIENCE)

    def send(self, count, publisher=0):
        """Publish different messages."""
        for _ in range(count):
            message = Twist()
            message.linear.x = float(len(self.sent))
            self.sent.append(serialize_message(message))
            self.publishers[publisher].publish(self.sent[-1])

    def until_recorded(self, count):
        self.harness.until(lambda: len(self.sink.data) >= count, f'{count} are recorded')

    def until_drained(self):
        self.recorder.end()
        self.harness.until(self.recorder.drained, 'all is collected')


@pytest.fixture(autouse=True)
def executor_kind():
    """Serve the recorder as record_run does."""
    return 'single'


@pytest.fixture(autouse=True)
def limits(monkeypatch):
    monkeypatch.setattr(recorder, 'DEPTH', DEPTH)
    # Bursts lose nothing in one process.
    monkeypatch.setattr(recorder, 'HEARTBEAT', 0.0)


@pytest.fixture
def local_discovery(monkeypatch):
    """Contexts that are created after this discover each other, as processes do."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id()))


# --- What was missed


def message(number, publisher=0, sent=0, received=0):
    return ReceivedMessage(b'', bytes([publisher]), number, sent, received)


MANY = 100


@pytest.mark.parametrize('runs', [2, 3, MANY])
def test_each_message_is_new_once_and_all_gaps_add_up(monkeypatch, runs):
    """With few runs that are kept, a message in an old gap may count as known."""
    monkeypatch.setattr(reception, 'MAX_RUNS', runs)
    chance = random.Random(runs)
    for _ in range(60):
        counter, seen, largest = MissedMessages(), [set(), set(), set()], chance.randrange(5, 40)
        for _ in range(chance.randrange(40)):
            publisher, number = chance.randrange(3), chance.randrange(1, largest)
            new = counter.received(message(number, publisher))
            before = number in seen[publisher]
            assert not (new and before)
            if new:
                seen[publisher].add(number)
            elif runs == MANY:
                assert before
        assert counter.count == sum(max(one) - min(one) + 1 - len(one) for one in seen if one)


def test_a_late_message_shows_what_was_missed_before():
    counter = MissedMessages()
    counter.received(message(5))
    for number, publisher in ((9, 0), (20, 0), (7, 1), (9, 1)):
        counter.received_late(message(number, publisher))
    assert counter.count == 3
    # From another subscription.
    assert counter.received(message(7))
    assert counter.count == 2


def test_messages_without_numbers_are_told_apart_by_their_times():
    counter = MissedMessages()
    new = [counter.received(message(None, sent=time)) for time in (5, 9, 5, 3, 9)]
    assert new == [True, True, False, True, False]
    assert counter.count == 0


@pytest.mark.parametrize(('reliability', 'silent'), [(RELIABLE, False), (BEST_EFFORT, True)])
def test_what_was_overwritten_while_it_waited_is_counted(ros, reliability, silent):
    setting = Setting(ros, *[{'reliability': reliability}] * 2)
    first_of_each = [0] if silent else [0, 1]
    for publisher in first_of_each:
        setting.send(1, publisher)
    setting.until_recorded(len(first_of_each))
    for count in (DEPTH + 150, DEPTH + 55):
        # Nobody serves the recorder meanwhile.
        setting.send(count - 20)
        setting.send(20, publisher=first_of_each[-1])
        before = len(setting.sink.data)
        setting.until_recorded(before + DEPTH)
    setting.until_drained()
    assert len(setting.sink.data) == len(first_of_each) + 2 * DEPTH
    assert setting.sink.missed == {'/cmd_vel': 205}


def test_the_only_message_of_a_publisher_may_be_lost(ros):
    setting = Setting(ros, {}, {})
    setting.send(1, publisher=1)
    setting.send(DEPTH)
    setting.until_recorded(DEPTH)
    setting.until_drained()
    assert setting.sink.data == setting.sent[1:]
    assert setting.sink.missed == {}
    assert setting.sink.left_out == {'possibly part of /cmd_vel': f'its queue of {DEPTH} was full'}


def test_what_was_overwritten_at_the_end_is_counted(ros):
    setting = Setting(ros, {})
    setting.send(1)
    setting.until_recorded(1)
    setting.send(5)
    setting.recorder.end()
    setting.send(DEPTH)
    setting.harness.until(setting.recorder.drained, 'all is collected')
    assert setting.sink.data == setting.sent[:1]
    assert setting.sink.missed == {'/cmd_vel': 5}


# --- The end


@pytest.mark.parametrize('reliability', [RELIABLE, BEST_EFFORT], ids=str)
def test_bursts_are_recorded_in_order_until_the_end(ros, reliability):
    setting = Setting(ros, {'reliability': reliability})
    for count in (DEPTH - 1, 20):
        setting.send(count)
        setting.until_recorded(len(setting.sent))
    setting.send(DEPTH - 60)
    before = list(setting.sent)
    setting.recorder.end()
    # What waits is collected, what comes later is not, also if it never ceases.
    setting.send(30)

    def drained():
        setting.send(1)
        return setting.recorder.drained()

    setting.harness.until(drained, 'all is collected')
    assert setting.sink.data == before
    assert (setting.sink.missed, setting.sink.left_out) == ({}, {})


DOUBTED = {
    'possibly the end of /cmd_vel': 'a buffer overflowed, and then its publisher ended or was silent'
}


class Doubt(Setting):
    """A recording of a burst, of which a heartbeat may bring more for a long time."""

    def __init__(self, ros, monkeypatch, reliability=RELIABLE):
        monkeypatch.setattr(recorder, 'HEARTBEAT', 1e6)
        # Within a process the kernel has nothing to count.
        monkeypatch.setattr(recorder, 'receives_through_udp', lambda: False)
        monkeypatch.setattr(overflow, 'BURST_VOLUME', 10 * overflow.OVERHEAD)
        super().__init__(ros, *[{'reliability': reliability}] * 2)
        for publisher in (0, 1):
            self.send(11, publisher)
        self.until_recorded(22)

    def end(self):
        self.recorder.end()
        # So that nothing is expected, were it not for the burst.
        monotonic = recorder.time.monotonic
        self.recorder._last_added = monotonic() - 2 * recorder.IN_TRANSIT

    def until_drained_without_publishers(self):
        for publisher in self.publishers:
            self.harness.peer.destroy_publisher(publisher)
        self.until_drained()


@pytest.fixture
def doubt(ros, monkeypatch):
    return Doubt(ros, monkeypatch)


def test_after_an_overflow_late_messages_are_waited_for(doubt, monkeypatch):
    doubt.end()
    assert not doubt.recorder.drained()
    assert doubt.recorder.awaited == ['/cmd_vel']
    monkeypatch.setattr(recorder, 'HEARTBEAT', 0.0)
    assert doubt.recorder.drained()
    assert doubt.sink.left_out == DOUBTED


def test_best_effort_is_waited_for_only_if_the_recorder_was_held(ros, monkeypatch):
    doubt = Doubt(ros, monkeypatch, BEST_EFFORT)
    doubt.end()
    assert doubt.recorder.drained()
    doubt.end()
    doubt.recorder._called -= 2 * recorder.HELD
    assert not doubt.recorder.drained()
    assert doubt.sink.left_out == {}
    doubt.recorder.give_up('no time')
    assert doubt.sink.left_out == {'possibly the end of /cmd_vel': 'no time'}


def test_a_reliable_publisher_confirms_by_its_next_message(doubt):
    doubt.recorder.end()
    doubt.send(1, publisher=0)
    doubt.harness.until(lambda: doubt.recorder._receptions['/cmd_vel'].confirmed, 'one confirms')
    assert not doubt.recorder.drained()
    doubt.send(1, publisher=1)
    doubt.harness.until(doubt.recorder.drained, 'both have confirmed')
    assert (doubt.recorder.awaited, doubt.sink.left_out) == ([], {})


def test_an_ended_publisher_is_doubted_but_not_waited_for(doubt):
    doubt.until_drained_without_publishers()
    assert doubt.recorder.awaited == []
    assert doubt.sink.left_out == DOUBTED


def test_a_publisher_that_sends_on_is_not_doubted(doubt, monkeypatch):
    monkeypatch.setattr(overflow, 'BURST_VOLUME', 1e9)
    for publisher in (0, 1):
        doubt.send(1, publisher)
    doubt.until_recorded(24)
    doubt.until_drained_without_publishers()
    assert doubt.sink.left_out == {}


def test_an_overflow_long_after_the_last_message_is_no_doubt(doubt, monkeypatch):
    monkeypatch.setattr(recorder, 'ACTIVE', 0.0)
    doubt.until_drained()
    assert doubt.sink.left_out == {}


def test_a_wait_that_is_cut_short_or_too_long_leaves_a_doubt(doubt, monkeypatch):
    doubt.end()
    doubt.recorder.give_up('no time')
    assert doubt.sink.left_out == {'possibly the end of /cmd_vel': 'no time'}
    monkeypatch.setattr(recorder, 'DRAIN_PATIENCE', -1.0)
    doubt.end()
    assert doubt.recorder.drained()
    assert 'still arriving' in doubt.sink.left_out['possibly the end of /cmd_vel']


def test_a_drop_before_the_next_message_is_due_was_of_others(doubt):
    """As when a process ends that has hundreds of publishers, each of which is taken back."""
    heard = [*doubt.recorder._receptions['/cmd_vel'].heard.values()]
    assert all(one.shortest < SECOND // 10 for one in heard)
    assert list(doubt.recorder._in_doubt()) == ['/cmd_vel']
    for one in heard:
        one.shortest = SECOND
    assert doubt.recorder._in_doubt() == {}


@pytest.mark.parametrize(
    ('sent', 'received', 'last'),
    [
        (5 * SECOND - 100, 5 * SECOND, 5 * SECOND - 100),
        (SECOND, 5 * SECOND, 5 * SECOND - reception.MAX_WAIT),
        # The clock of another machine is ahead.
        (9 * SECOND, 5 * SECOND, 5 * SECOND),
    ],
)
def test_what_was_sent_again_counts_from_its_receipt(sent, received, last):
    heard = reception.Heard()
    heard.hear(message(1, 0, sent, received))
    assert (heard.last, heard.shortest) == (last, 0)
    # The last two come at the same time.
    for number, (after, shortest) in enumerate(((5, 5), (9, 4), (20, 4), (20, 0), (30, 0)), 2):
        heard.hear(message(number, 0, last + after * SECOND, last + after * SECOND))
        assert heard.shortest == shortest * SECOND


# --- Publishers of different quality of service


class Subscriptions:
    """The subscriptions of a reception, whose messages a test chooses."""

    def __init__(self, monkeypatch, lost):
        self.recorded = []
        monkeypatch.setattr(reception, 'lost_messages', lambda subscription: lost[subscription])
        self.reception = reception.CountingReception(
            *(mock.Mock(), Twist, '/cmd_vel', DEPTH, mock.Mock()),
            on_message=lambda message: self.recorded.append(message.number),
            is_late=lambda message: False,
        )
        monkeypatch.setattr(self.reception, '_subscribe', lambda reliability, durability: reliability)
        self.reception.match([QoSProfile(depth=1, reliability=one) for one in lost])
        self.queues = {reliability: queue for (reliability, _), queue in self.reception._queues.items()}

    def receive(self, reliability, *numbers):
        for number in numbers:
            self.queues[reliability]._receive(message(number))


def test_reliable_and_best_effort_subscriptions_together_lose_nothing(
    monkeypatch,
):
    for reliability in (RELIABLE, BEST_EFFORT):
        assert Subscriptions(monkeypatch, {reliability: 3}).reception.missed == 3
    both = Subscriptions(monkeypatch, {BEST_EFFORT: 3, RELIABLE: 0})
    both.receive(BEST_EFFORT, 1, 2)
    both.receive(RELIABLE, 2, 3)
    both.receive(BEST_EFFORT, 3, 7)
    both.receive(RELIABLE, 4, 5, 6, 7)
    assert both.recorded == [1, 2, 3, 4, 5, 6, 7]
    # What the middleware lost of the other one.
    assert both.reception.missed == 0


VOLATILE = {'durability': DurabilityPolicy.VOLATILE}
TRANSIENT = {'durability': DurabilityPolicy.TRANSIENT_LOCAL}


@pytest.mark.parametrize(
    ('first', 'second', 'with_info'),
    [
        (VOLATILE, {'reliability': BEST_EFFORT}, False),
        (TRANSIENT, VOLATILE, False),
        (TRANSIENT, {'reliability': BEST_EFFORT}, True),
    ],
)
def test_a_later_publisher_with_weaker_qos_is_recorded(ros, first, second, with_info):
    setting = Setting(ros, first, with_info=with_info)
    setting.send(1)
    setting.until_recorded(1)
    weak = ros.peer.create_publisher(Twist, 'cmd_vel', QoSProfile(depth=10, **second))
    setting.publishers.append(weak)
    # This message waits in the old subscription.
    setting.send(1)
    setting.until(lambda: all(one.get_subscription_count() for one in setting.publishers))
    setting.send(1, publisher=1)
    setting.send(1)
    setting.until_recorded(4)
    setting.recorder.discover()
    assert setting.sink.missed == {}
    assert len(setting.sink.channel.qos) == 2


@pytest.mark.parametrize(
    ('latched_first', 'reliability'), [(False, RELIABLE), (True, RELIABLE), (True, BEST_EFFORT)]
)
def test_a_latched_message_is_recorded_once_beside_another_publisher(ros, latched_first, reliability):
    setting = Setting(ros)
    plain = {'reliability': reliability}
    if not latched_first:
        setting.add_publisher(**plain)
    latched = ros.peer.create_publisher(Twist, 'cmd_vel', QoSProfile(**LATCHED))
    setting.publishers.append(latched)
    # Nobody who is not latched receives the first ones, at least if it is the first publisher.
    setting.send(5, publisher=len(setting.publishers) - 1)
    setting.until(latched.get_subscription_count)
    if latched_first:
        setting.add_publisher(**plain)
    expected = 3 if latched_first else 5
    setting.until(lambda: len(setting.sink.data) == expected)
    # Both of its subscriptions receive.
    setting.until(lambda: latched.get_subscription_count() == 2)
    for publisher in (0, 1, 0, 1):
        setting.send(1, publisher)
    setting.until(lambda: len(setting.sink.data) == expected + 4)
    setting.until_drained()
    # What it overwrote before it was recorded is not missed.
    assert len(setting.sink.data) == len(set(setting.sink.data)) == expected + 4
    assert (setting.sink.missed, setting.sink.left_out) == ({}, {})


# --- What is recorded, and when


def test_invalid_topic_names_are_reported_once(ros, monkeypatch, capfd):
    # No ROS node can publish such a topic.
    names = ['/foo bar', '/foo//bar', '/1', '/\x1b[2J', '/' + 'a' * 300]
    setting = Setting(ros, topics=())
    find = setting.recorder.get_topic_names_and_types
    invalid = [(name, ['geometry_msgs/msg/Twist']) for name in names]
    monkeypatch.setattr(setting.recorder, 'get_topic_names_and_types', lambda: [*invalid, *find()])
    setting.add_publisher()
    setting.send(1)
    setting.until_recorded(1)
    setting.recorder.discover()
    reports = capfd.readouterr().err
    assert reports.count('is not recorded') == len(names)
    assert '\x1b[2J' not in reports
    assert sorted(setting.sink.left_out) == sorted(names)


def test_a_topic_whose_type_is_not_installed_is_left_out(ros, monkeypatch):
    monkeypatch.setattr(recorder, 'message_class', mock.Mock(side_effect=UnknownTypeError('no Twist')))
    publisher = ros.peer.create_publisher(Twist, 'cmd_vel', 10)
    setting = Setting(ros)
    setting.until(lambda: setting.sink.left_out)
    assert setting.sink.left_out == {'/cmd_vel': 'no Twist'}
    assert publisher.get_subscription_count() == 0


def test_a_middleware_without_events_is_recorded_from(ros, monkeypatch):
    create = Recorder.create_subscription

    def without_events(*arguments, event_callbacks, **options):
        if event_callbacks.message_lost is not None:
            raise UnsupportedEventTypeError('no events')
        return create(*arguments, event_callbacks=event_callbacks, **options)

    monkeypatch.setattr(Recorder, 'create_subscription', without_events)
    setting = Setting(ros, {})
    setting.send(3)
    setting.until_recorded(3)
    assert setting.sink.data == setting.sent


@pytest.mark.parametrize('simulated', [False, True])
def test_messages_have_the_time_of_receipt_or_of_the_simulated_clock(ros, simulated):
    setting = Setting(ros, {}, parameters={'use_sim_time': simulated}, now=lambda: 5)
    setting.send(1)
    setting.until_recorded(1)
    assert (setting.sink.stamps == [5]) == simulated


def test_publishers_of_another_type_are_reported(local_discovery, ros):
    setting = Setting(ros, topics=('cmd_vel', 'x'))
    left_out = setting.sink.left_out
    # In one context a topic can have one type only.
    with ros_context(['one']) as one, ros_context(['other']) as other:
        twists, stamped = Node('one', context=one), Node('other', context=other)
        first = twists.create_publisher(Twist, 'cmd_vel', 10)
        setting.until(first.get_subscription_count)
        twists.destroy_publisher(first)
        stamped.create_publisher(TwistStamped, 'cmd_vel', 10)
        setting.until(lambda: left_out)
        # And a topic that has two types from its beginning.
        twists.create_publisher(Twist, 'x', 10)
        stamped.create_publisher(TwistStamped, 'x', 10)
        setting.until(lambda: len(left_out) == 2)
        for node in (twists, stamped):
            node.destroy_node()
    assert left_out['/cmd_vel of geometry_msgs/msg/TwistStamped'] == (
        '/cmd_vel is recorded as geometry_msgs/msg/Twist'
    )
    assert any(topic.startswith('/x') for topic in left_out)
