"""record_run: the bag contains the messages sent, byte for byte, however the recording ends."""

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
from support.raw_bags import read_journal, run_tool
from support.ros_messages import twist

from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import JournalWriter, Message
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.recording.recorder import Status
from diffdrive_jacobian.ros.runner import discovery_off, ros_context
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
    """Return the messages of a bag by topic, as rosbags reads them."""
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
        self.sent[topic].append(serialize_message(message))
        self.publishers[topic].publish(self.sent[topic][-1])


def arrived(bag, messages):
    """Return whether so many messages are in the journal."""
    journal = journal_of(bag)
    # To parse it in each round would take all the time that there is.
    if not journal.exists() or journal.stat().st_size < messages * 50:
        return False
    return sum(isinstance(record, Message) for record in read_journal(journal)) >= messages


def digests(messages):
    return [hashlib.sha256(message).hexdigest() for message in messages]


# --- What is recorded


@pytest.mark.process
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_bag_contains_the_messages_that_were_sent(world, bag, storage):
    goals = Goals()
    goals.header.frame_id = 'odom'
    talk = Talk(world, ('cmd_vel', Twist, 500), ('odom', Odometry, 500), ('goals', Goals, LATCHED))
    talk.say('goals', goals)
    topics = ('cmd_vel', 'odom', 'goals', 'joint_states')
    recorder = world.start('record_run', *topics, '-o', str(bag), '-s', storage)
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
    found = content(bag)
    for topic, sent in {**talk.sent, **late.sent}.items():
        assert digests(found[f'/{topic}']) == digests(sent)
    told = metadata(bag)
    assert (told['version'], told['storage_identifier'], told['message_count']) == (9, storage, 62)
    assert told['custom_data']['recorder'].startswith('diffdrive_jacobian ')
    assert not journal_of(bag).exists()
    assert recorder.last_line.startswith(f'{bag} is complete: 62 messages in ')
    with Reader(bag) as reader:
        kinds = {connection.topic: connection for connection in reader.connections}
    store = get_typestore(Stores.ROS2_JAZZY)
    assert kinds['/cmd_vel'].digest == store.hash_rihs01('geometry_msgs/msg/Twist')
    (offered,) = kinds['/goals'].ext.offered_qos_profiles
    assert offered.durability == QosDurability.TRANSIENT_LOCAL
    assert offered.reliability == QosReliability.RELIABLE
    assert (offered.deadline.sec, offered.deadline.nsec) == (9223372036, 854775807)
    assert 'MSG: geometry_msgs/PoseStamped' in kinds['/goals'].msgdef.data
    if storage == 'mcap':
        mcap = pytest.importorskip('mcap.reader')
        with open(bag / 'bag.mcap', 'rb') as file:
            read = mcap.make_reader(file).iter_messages(topics=['/cmd_vel'])
            assert digests(message.data for _, _, message in read) == digests(talk.sent['cmd_vel'])


@pytest.mark.process
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
        world.harness.until(lambda: arrived(bag, 3), 'all are in the journal', PATIENCE)
        node.destroy_node()
    recorder.signal(signal.SIGINT)
    assert (recorder.exit(), recorder.stderr) == (0, '')
    assert sorted(content(bag)['/goals']) == sorted(sent + plain.sent['goals'])


@pytest.mark.process
def test_topics_are_selected(world, bag):
    talk = Talk(world, ('cmd_vel', Twist, 10), ('other', Twist, 10), ('_hidden', Twist, 10))
    world.harness.add(VirtualRobot, parameters={'wheel_radius': 0.05})
    bags = [bag, bag.with_name('bag2'), bag.with_name('bag3')]
    arguments = (['-a'], ['-e', '/oth.*'], ['cmd_vel', 'typo'])
    recorders = [
        world.start('record_run', *selection, '-o', str(path))
        for selection, path in zip(arguments, bags, strict=True)
    ]
    for topic in ('cmd_vel', 'other'):
        publisher = talk.publishers[topic]
        # Of the robot, too.
        readers = {'cmd_vel': 3, 'other': 2}[topic]
        talk.harness.until(lambda p=publisher, n=readers: p.get_subscription_count() == n, topic)
        talk.say(topic, twist(1, 0))
    for path in bags:
        talk.harness.until(lambda path=path: arrived(path, 1), 'a message is recorded')
    noted = b'parameters of /virtual_robot'
    talk.harness.until(lambda: noted in journal_of(bag).read_bytes(), 'parameters')
    talk.harness.until(lambda: arrived(bag, 2), 'both are recorded')
    for recorder in recorders:
        recorder.signal(signal.SIGTERM)
    assert [recorder.exit() for recorder in recorders] == [0, 0, 0]
    assert recorders[1].stderr == ''
    assert recorders[2].stderr == 'record_run: warning: no publisher: /typo\n'
    assert set(content(bag)) >= {'/cmd_vel', '/other', '/odom'}
    assert '/_hidden' not in content(bag)
    assert set(content(bags[1])) == {'/other'}
    assert set(content(bags[2])) == {'/cmd_vel'}
    parameters = metadata(bag)['custom_data']['parameters of /virtual_robot']
    assert '"wheel_radius": 0.05' in parameters


# --- How it ends


@pytest.mark.process
def test_a_signal_in_a_burst_leaves_a_valid_bag(world, bag):
    talk = Talk(world, ('cmd_vel', Twist, 5000))
    recorder = world.start('record_run', '-o', str(bag))
    talk.until_heard()
    for index in range(1000):
        talk.say('cmd_vel', twist(index, 0))
        if index == 500:
            recorder.signal(signal.SIGTERM)

    def ended():
        # A further message confirms those before it.
        talk.say('cmd_vel', twist(0, 1))
        return not recorder.running

    world.harness.until(ended, 'the recorder ends')
    assert recorder.exit() == 0
    found = content(bag)['/cmd_vel']
    assert digests(found) == digests(talk.sent['cmd_vel'])[: len(found)]


@pytest.mark.process
def test_a_second_signal_that_ends_the_wait_for_late_messages_makes_the_bag_incomplete(world, bag):
    talk = Talk(world, ('text', String, 10))
    recorder = world.start('record_run', 'text', '-o', str(bag))
    talk.until_heard()
    # As large as the buffer of a socket: a further one may have been lost.
    talk.say('text', String(data=100_000 * 'x'))
    world.harness.until(lambda: arrived(bag, 1), 'it is in the journal')
    recorder.signal(signal.SIGINT)
    recorder.until_says('waiting some seconds for late messages of /text')
    recorder.signal(signal.SIGINT)
    assert recorder.exit() == 1
    assert 'possibly the end of /text was not recorded: a second signal' in recorder.stderr
    assert f'{bag} is incomplete: 1 message' in recorder.last_line
    assert content(bag)['/text'] == talk.sent['text']


@pytest.mark.process
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


def test_topics_without_a_publisher_are_named(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with discovery_off():
        code, out, err = run_tool(record_run.main, capsys, 'quick', '--max-duration', '1')
    missing = '/quick has no publisher (-o names the bag); topics with a publisher: none'
    assert (code, err) == (1, f'record_run: error: {missing}\n')
    assert f'\nwaiting: {missing}\n' in out
    assert out.endswith('is complete and empty: no message was received\n')


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


def test_wrong_arguments_are_reported_and_no_file_is_changed(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'taken').mkdir()
    JournalWriter(tmp_path / 'begun.journal.mcap').close()
    before = sorted(tmp_path.iterdir())
    for arguments, words in (
        (['-o', 'taken'], 'cannot record to taken: taken exists already'),
        (['-o', 'nowhere/bag'], 'cannot record to nowhere/bag: no such file or directory'),
        (['-o', 'begun'], 'recover_run begun.journal.mcap writes the bag'),
        (['-e', '('], "must be a regular expression, got '('"),
        (['-s', 'rosbag1'], 'invalid choice'),
        (['--max-duration', '-1'], 'must be positive'),
        (['-o', 'new', '--ros-args', '--bogus'], 'ROS arguments: '),
        (['-o', 'new', 'bad//topic'], "invalid topic name 'bad//topic': "),
    ):
        code, _, err = run_tool(record_run.main, capsys, *arguments)
        assert code == 2
        line = err.splitlines()[-1]
        assert line.startswith('record_run: error: ')
        assert words in line
        assert sorted(tmp_path.iterdir()) == before
