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

"""record_run: the bag contains the messages sent, byte for byte, however the recording ends."""

from __future__ import annotations

import errno
import os
import signal
import threading
import time

import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Goals, Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import String
from support.commands import interrupted, run
from support.harness import PATIENCE
from support.raw_bags import read_journal
from support.ros_messages import twist

from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import JournalWriter, Message
from diffdrive_jacobian.recording import recorder
from diffdrive_jacobian.recording.recorder import Selection, Status, record
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.ros.runner import discovery_off
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import record_run

pytestmark = pytest.mark.slow
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def bag(tmp_path):
    return tmp_path / 'bag'


def content(bag):
    """Return the messages of a bag by topic, as rosbags reads them."""
    found = {}
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(bytes(data))
    return found


class Talk:
    """Publishers on several topics, and what they sent."""

    def __init__(self, world, *topics):
        self.harness = world.harness
        self.publishers = {
            topic: self.harness.peer.create_publisher(kind, topic, profile)
            for topic, kind, profile in topics
        }
        self.sent = {topic: [] for topic in self.publishers}

    def until_heard(self):
        for topic, publisher in self.publishers.items():
            self.harness.until(publisher.get_subscription_count, f'{topic} is recorded', PATIENCE)

    def say(self, topic, message):
        self.sent[topic].append(serialize_message(message))
        self.publishers[topic].publish(self.sent[topic][-1])


def arrived(bag, messages):
    """Return whether so many messages are in the journal."""
    journal = journal_of(bag)
    # To parse it in each round would take all the time that there is.
    if not journal.exists() or journal.stat().st_size < messages * 50:
        return False
    return sum(isinstance(record, Message) for record in read_journal(journal)) >= messages


# --- Real processes


@pytest.mark.process
def test_the_bag_contains_the_messages_that_were_sent(world, bag):
    goals = Goals()
    goals.header.frame_id = 'odom'
    talk = Talk(world, ('cmd_vel', Twist, 500), ('odom', Odometry, 500), ('goals', Goals, LATCHED))
    talk.say('goals', goals)
    topics = ('cmd_vel', 'odom', 'goals', 'joint_states')
    recorder = world.start('record_run', *topics, '-o', str(bag))
    talk.until_heard()
    # No burst, after which late messages would be waited for.
    for index in range(30):
        talk.say('cmd_vel', twist(index, 0))
        talk.say('odom', Odometry())
    # A topic that comes later.
    late = Talk(world, ('joint_states', Twist, 10))
    recorder.until_says('recording to')
    late.until_heard()
    late.say('joint_states', twist(7, 0))
    world.harness.until(lambda: arrived(bag, 62), 'all is in the journal')
    recorder.signal(signal.SIGINT)
    assert (recorder.exit(), recorder.stderr) == (0, '')
    assert recorder.last_line.startswith(f'{bag} is complete: 62 messages in ')
    assert not journal_of(bag).exists()
    found = content(bag)
    for topic, sent in {**talk.sent, **late.sent}.items():
        assert found[f'/{topic}'] == sent
    with Reader(bag) as reader:
        kinds = {connection.topic: connection for connection in reader.connections}
        assert reader.storage.metadata.custom['recorder'].startswith('diffdrive_jacobian ')
    store = get_typestore(Stores.ROS2_JAZZY)
    assert kinds['/cmd_vel'].digest == store.hash_rihs01('geometry_msgs/msg/Twist')
    assert 'MSG: geometry_msgs/PoseStamped' in kinds['/goals'].msgdef.data
    (offered,) = kinds['/goals'].ext.offered_qos_profiles
    assert offered.durability == QosDurability.TRANSIENT_LOCAL
    assert offered.reliability == QosReliability.RELIABLE
    assert (offered.deadline.sec, offered.deadline.nsec) == (9223372036, 854775807)


# --- In this process


def record_until(bag, messages, *arguments):
    """Run record_run until so many messages are in the journal."""
    signals = Signals()

    def end():
        deadline = time.monotonic() + PATIENCE
        while not arrived(bag, messages) and time.monotonic() < deadline:
            time.sleep(0.01)
        signals.count = 1

    ending = threading.Thread(target=end)
    ending.start()
    ended = run('record_run', *arguments, '-o', bag, signals=signals)
    ending.join()
    return ended


def test_options_select_topics(world, tmp_path):
    # Latched, so that they are received whenever the recorder comes, also beside others that are not.
    world.harness.peer.create_publisher(String, 'some', 10)
    talk = Talk(world, *((topic, String, LATCHED) for topic in ('some', 'other', '_hidden')))
    for topic in talk.publishers:
        talk.say(topic, String(data=topic))
    warning = 'record_run: warning: no publisher: /typo\n'
    for name, arguments, expected, said in (
        ('all', ('-a',), {'/some', '/other'}, ''),
        ('by pattern', ('-e', '/oth.*'), {'/other'}, ''),
        ('by name', ('some', 'typo'), {'/some'}, warning),
    ):
        bag = tmp_path / name
        ended = record_until(bag, len(expected), *arguments)
        assert (ended.code, ended.err) == (0, said)
        found = content(bag)
        assert found.keys() - {'/rosout', '/parameter_events'} == expected
        assert all(found[topic] == talk.sent[topic.removeprefix('/')] for topic in expected)


def test_a_second_signal_makes_the_bag_incomplete(world, bag, monkeypatch):
    # Within a process the kernel has nothing to count.
    monkeypatch.setattr(recorder, 'receives_through_udp', lambda: False)
    talk = Talk(world, ('text', String, LATCHED))
    # As large as the buffer of a socket: a further one may have been lost.
    talk.say('text', String(data=100_000 * 'x'))
    signals = Signals()

    def on_status(status):
        signals.count = min(1, status.messages)

    def on_wait(topics):
        assert topics == ['/text']
        signals.count = 2

    with pytest.raises(RecordingError, match='a second signal ended the wait') as caught:
        record(
            Recording(bag),
            Selection(topics=('text',)),
            max_duration=None,
            ros_arguments=(),
            signals=signals,
            on_status=on_status,
            on_wait=on_wait,
            on_end=lambda: None,
        )
    assert signals.count == 2
    assert caught.value.summary.messages == 1
    assert content(bag)['/text'] == talk.sent['text']


def test_a_disk_that_becomes_full_ends_the_recording(world, bag, monkeypatch):
    talk = Talk(world, ('text', String, LATCHED))
    talk.say('text', String(data='too much'))
    write = os.write

    def write_until_full(descriptor, data):
        if b'too much' in bytes(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, data)

    monkeypatch.setattr(os, 'write', write_until_full)
    begun = time.monotonic()
    code, _, err = run('record_run', 'text', '-o', bag, '--max-duration', PATIENCE)
    assert code == 1
    assert time.monotonic() - begun < PATIENCE, 'it did not end by itself'
    assert err.startswith('record_run: error: ')
    assert 'No space left on device' in err
    assert '1 message is missing' in err


def test_a_signal_at_the_start_leaves_an_empty_bag(bag):
    code, out, _ = run('record_run', '-o', bag, signals=interrupted())
    assert code == 0
    assert out.endswith(f'{bag} is complete and empty: no message was received\n')
    assert content(bag) == {}


def test_topics_without_a_publisher_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with discovery_off():
        code, out, err = run('record_run', 'quick', '--max-duration', '1')
    missing = '/quick has no publisher (-o names the bag); topics with a publisher: none'
    assert (code, err) == (1, f'record_run: error: {missing}\n')
    assert f'\nwaiting: {missing}\n' in out
    status = Status(messages=0, topics=0, size=0, seconds=1.0, lost=0, missing=('/a', '/b'))
    described = record_run.describe_missing(status._replace(published=('/odom',)))
    assert described == '/a, /b have no publisher; topics with a publisher: /odom'
    many = status._replace(missing=(), published=tuple(f'/t{index}' for index in range(9)))
    assert record_run.describe_missing(many) == (
        'no topic that is selected has a publisher; '
        'topics with a publisher: /t0, /t1, /t2, /t3, /t4, /t5, /t6, /t7, ...'
    )


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ('-o nowhere/bag', 'cannot record to nowhere/bag: no such file or directory'),
        ('-o begun', 'recover_run begun.journal.mcap writes the bag'),
        ('-s sqlite3', "MCAP, and `ros2 bag convert` writes other formats, got 'sqlite3'"),
        ('-e (', "must be a regular expression, got '('"),
        ('-o new --ros-args --bogus', 'ROS arguments: '),
        ('-o new bad//topic', "invalid topic name 'bad//topic': "),
    ],
)
def test_wrong_arguments_change_no_file(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    JournalWriter(tmp_path / 'begun.journal.mcap').close()
    code, _, err = run('record_run', *arguments.split())
    assert code == 2
    assert words in err.splitlines()[-1]
    assert os.listdir(tmp_path) == ['begun.journal.mcap']
