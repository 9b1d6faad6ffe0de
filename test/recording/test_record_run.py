"""record_run as a process: the bag contains the messages sent, byte for byte, however it ends."""

from __future__ import annotations

import hashlib
import signal

import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Goals, Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from std_msgs.msg import Header, String
from support.harness import PATIENCE
from support.processes import open_world
from support.raw_bags import read_journal

from diffdrive_jacobian.bags.journal import JournalWriter, Message
from diffdrive_jacobian.recording.record import Status
from diffdrive_jacobian.ros.runner import discovery_off, ros_context
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import record_run

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def world(tmp_path):
    with open_world(tmp_path) as made:
        yield made


@pytest.fixture
def bag(tmp_path):
    return tmp_path / 'bag'


def content(bag):
    """What a bag holds: its messages by topic, as rosbags reads them."""
    found = {}
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(bytes(data))
    return found


def metadata(bag):
    return YAML(typ='safe').load(bag / 'metadata.yaml')['rosbag2_bagfile_information']


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
        data = serialize_message(message)
        self.sent[f'/{topic}' if f'/{topic}' in self.sent else topic].append(data)
        self.publishers[topic].publish(data)


def twist(index):
    message = Twist()
    message.linear.x = float(index)
    return message


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_bag_contains_the_messages_that_were_sent(world, bag, storage):
    goals = Goals()
    goals.header.frame_id = 'odom'
    talk = Talk(
        world,
        ('cmd_vel', Twist, QoSProfile(depth=500)),
        ('odom', Odometry, 500),
        ('goals', Goals, LATCHED),
    )
    talk.say('goals', goals)
    recorder = world.start('record_run', '-o', str(bag), '-s', storage)
    talk.until_heard()
    for index in range(300):
        talk.say('cmd_vel', twist(index))
        talk.say('odom', Odometry())
    late = Talk(world, ('joint_states', Twist, 10))
    recorder.until_says('recording to')
    late.until_heard()
    late.say('joint_states', twist(7))
    for publisher in (*talk.publishers.values(), *late.publishers.values()):
        publisher.wait_for_all_acked()
    world.harness.until(lambda: _arrived(bag, 602), 'all is in the journal')
    recorder.signal(signal.SIGINT)
    assert (recorder.exit(), recorder.stderr) == (0, '')
    found = content(bag)
    for topic, sent in {**talk.sent, **late.sent}.items():
        assert _digest(found[f'/{topic}']) == _digest(sent)
    told = metadata(bag)
    assert (told['version'], told['storage_identifier'], told['message_count']) == (9, storage, 602)
    assert not bag.with_name('bag.journal.mcap').exists()
    assert recorder.last_line.startswith(f'{bag} is complete: 602 messages in ')
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader:
        kinds = {connection.topic: connection for connection in reader.connections}
    assert kinds['/cmd_vel'].digest == store.hash_rihs01('geometry_msgs/msg/Twist')
    (offered,) = kinds['/goals'].ext.offered_qos_profiles
    assert offered.durability == QosDurability.TRANSIENT_LOCAL
    assert offered.reliability == QosReliability.RELIABLE
    assert (offered.deadline.sec, offered.deadline.nsec) == (9223372036, 854775807)
    assert 'MSG: geometry_msgs/PoseStamped' in kinds['/goals'].msgdef.data


def test_a_latched_message_is_recorded_beside_a_publisher_that_is_not_latched(world, bag):
    plain = Talk(world, ('goals', Goals, 10))
    recorder = world.start('record_run', 'goals', '-o', str(bag))
    plain.until_heard()
    # In another context, as in another process, a new publisher knows no subscription.
    with ros_context(['other']) as context:
        node = Node('other', context=context)
        latched = node.create_publisher(Goals, 'goals', LATCHED)
        sent = [serialize_message(Goals(header=Header(frame_id=name))) for name in ('map', 'odom')]
        latched.publish(sent[0])
        world.harness.until(latched.get_subscription_count, 'it is matched', PATIENCE)
        latched.publish(sent[1])
        plain.say('goals', Goals())
        world.harness.until(lambda: _arrived(bag, 3), 'all are in the journal', PATIENCE)
        node.destroy_node()
    recorder.signal(signal.SIGINT)
    assert (recorder.exit(), recorder.stderr) == (0, '')
    assert sorted(content(bag)['/goals']) == sorted(sent + plain.sent['goals'])


def _arrived(bag, messages):
    """Whether so many messages are in the journal."""
    journal = bag.with_name('bag.journal.mcap')
    # To parse it in each round would take all the time that there is.
    if not journal.exists() or journal.stat().st_size < messages * 50:
        return False
    return sum(isinstance(record, Message) for record in read_journal(journal)) >= messages


def _digest(messages):
    return [hashlib.sha256(message).hexdigest() for message in messages]


def test_the_mcap_library_reads_the_same(world, bag):
    reader = pytest.importorskip('mcap.reader')
    talk = Talk(world, ('cmd_vel', Twist, 500))
    recorder = world.start('record_run', '-o', str(bag))
    talk.until_heard()
    for index in range(50):
        talk.say('cmd_vel', twist(index))
    world.harness.until(lambda: _arrived(bag, 50), 'all is in the journal')
    recorder.signal(signal.SIGTERM)
    assert recorder.exit() == 0
    with open(bag / 'bag.mcap', 'rb') as file:
        read = [message.data for _, _, message in reader.make_reader(file).iter_messages()]
    assert _digest(read) == _digest(talk.sent['cmd_vel'])


def test_parameters_of_the_nodes_are_kept(world, bag):
    world.start('virtual_robot', '--ros-args', '-p', 'wheel_radius:=0.05')
    recorder = world.start('record_run', '-o', str(bag))
    world.harness.until(
        lambda: b'parameters of /virtual_robot' in _bytes(bag.with_name('bag.journal.mcap')),
        'parameters',
    )
    recorder.signal(signal.SIGINT)
    assert recorder.exit() == 0
    custom = metadata(bag)['custom_data']
    assert '"wheel_radius": 0.05' in custom['parameters of /virtual_robot']
    assert custom['recorder'].startswith('diffdrive_jacobian ')


def _bytes(path):
    return path.read_bytes() if path.exists() else b''


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_a_burst_leaves_a_valid_bag(world, bag, number):
    talk = Talk(world, ('cmd_vel', Twist, 5000))
    recorder = world.start('record_run', '-o', str(bag))
    talk.until_heard()
    for index in range(3000):
        talk.say('cmd_vel', twist(index))
        if index == 1500:
            recorder.signal(number)
    assert recorder.exit() == 0
    found = content(bag)['/cmd_vel']
    assert _digest(found) == _digest(talk.sent['cmd_vel'])[: len(found)]


def test_a_second_signal_that_ends_the_wait_for_late_messages_makes_the_bag_incomplete(world, bag):
    talk = Talk(world, ('text', String, 10))
    recorder = world.start('record_run', 'text', '-o', str(bag))
    talk.until_heard()
    # As large as the buffer of a socket: a further one may have been lost.
    talk.say('text', String(data=100_000 * 'x'))
    world.harness.until(lambda: _arrived(bag, 1), 'it is in the journal')
    recorder.signal(signal.SIGINT)
    recorder.until_says('waiting some seconds for late messages of /text')
    recorder.signal(signal.SIGINT)
    assert recorder.exit() == 1
    assert 'possibly the end of /text was not recorded: a second signal' in recorder.stderr
    assert f'{bag} is incomplete: 1 message' in recorder.last_line
    assert content(bag)['/text'] == talk.sent['text']


def test_a_signal_at_the_start_leaves_no_bag_or_an_empty_one(world, bag):
    recorder = world.start('record_run', '-o', str(bag), fresh=True)
    recorder.until_catches(signal.SIGTERM)
    recorder.signal(signal.SIGTERM)
    if recorder.exit() == 130:
        assert recorder.stderr == 'record_run: interrupted\n'
        assert list(bag.parent.glob('bag*')) == []
    else:
        assert recorder.exit() == 0
        assert recorder.last_line == f'{bag} is complete and empty: no message was received'
        assert content(bag) == {}


def test_topics_are_selected_and_time_is_limited(world, bag):
    talk = Talk(world, ('cmd_vel', Twist, 10), ('other', Twist, 10), ('_hidden', Twist, 10))
    all_of_them = world.start('record_run', '-a', '-o', str(bag), '--max-duration', '4')
    some = world.start('record_run', '-e', '/oth.*', '-o', f'{bag}2', '--max-duration', '4')
    one = world.start('record_run', 'cmd_vel', 'typo', '-o', f'{bag}3', '--max-duration', '4')
    for topic, count in (('cmd_vel', 2), ('other', 2)):
        publisher = talk.publishers[topic]
        talk.harness.until(lambda p=publisher, n=count: p.get_subscription_count() == n, topic)
        talk.say(topic, twist(1))
    assert [child.exit() for child in (all_of_them, some, one)] == [0, 0, 0]
    assert (some.stderr, one.stderr) == ('', 'record_run: warning: no publisher: /typo\n')
    assert set(content(bag)) >= {'/cmd_vel', '/other'}
    assert '/_hidden' not in content(bag)
    assert set(content(f'{bag}2')) == {'/other'}
    assert set(content(f'{bag}3')) == {'/cmd_vel'}


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['-o', 'taken'], 'cannot record to taken: taken exists already'),
        (['-o', 'nowhere/bag'], 'cannot record to nowhere/bag: no such file or directory'),
        (['-o', 'begun'], 'recover_run begun.journal.mcap writes the bag'),
        (['-e', '('], "must be a regular expression, got '('"),
        (['-s', 'rosbag1'], 'invalid choice'),
        (['--max-duration', '-1'], 'must be positive'),
        (['-o', 'new', '--ros-args', '--bogus'], 'ROS arguments: '),
        (['-o', 'new', 'bad//topic'], "invalid topic name 'bad//topic': "),
    ],
)
def test_wrong_arguments_are_reported_and_no_file_is_changed(
    capsys, tmp_path, monkeypatch, arguments, words
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'taken').mkdir()
    JournalWriter(tmp_path / 'begun.journal.mcap').close()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit) as caught:
        raise SystemExit(record_run.main(arguments, Signals()))
    assert caught.value.code == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith('record_run: error: ')
    assert words in line
    assert sorted(tmp_path.iterdir()) == before


def test_topics_without_a_publisher_are_named(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with discovery_off():
        assert record_run.main(['quick', '--max-duration', '1'], Signals()) == 1
    said = capsys.readouterr()
    missing = '/quick has no publisher (-o names the bag); topics with a publisher: none'
    assert f'\nwaiting: {missing}\n' in said.out
    assert said.out.endswith('is complete and empty: no message was received\n')
    assert said.err == f'record_run: error: {missing}\n'


def test_the_topics_with_a_publisher_are_named():
    status = Status(
        messages=0, topics=0, size=0, seconds=1.0, lost=0, missing=('/a', '/b'), published=('/odom',)
    )
    assert record_run.describe_missing(status) == (
        '/a, /b have no publisher; topics with a publisher: /odom'
    )
    many = status._replace(missing=(), published=tuple(f'/t{index}' for index in range(9)))
    assert record_run.describe_missing(many) == (
        'no topic that is selected has a publisher; '
        'topics with a publisher: /t0, /t1, /t2, /t3, /t4, /t5, /t6, /t7, ...'
    )
