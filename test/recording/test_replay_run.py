"""replay_run: replay of a bag, and verification of a run."""

from __future__ import annotations

import shutil
import signal
from contextlib import suppress

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Goals
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosgraph_msgs.msg import Clock
from support.bags import count_more
from support.lockstep_nodes import make_complete
from support.processes import open_world
from support.recorded import recorded
from support.ros_messages import goal, goals

from diffdrive_jacobian.bags.message_definitions import definition
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.recording.replayer import Replayer
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.testing import Lockstep
from diffdrive_jacobian.tools import replay_run

LENGTH = 2.0


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A run of two seconds: a goal, its commands, the odometry."""
    path = tmp_path_factory.mktemp('bags') / 'run'
    with Lockstep() as world:
        world.add(make_complete(VirtualRobot, **{'linear__x__max_velocity': 0.5}))
        world.add(make_complete(GoToGoal))
        with recorded(world, path) as made:
            world.listen(Goals, 'goals')
            world.node.create_publisher(Goals, 'goals', 10)
            made.look()
            world.publish('goals', goals(goal(1.0, 0.5)))
            world.run_for(LENGTH)
        assert len(made.run.goals) == 1
    return path, made.run


@pytest.fixture
def world(tmp_path):
    with open_world(tmp_path) as made:
        yield made


def play(bag, *arguments, signals=None):
    """Run the tool in this process; return the exit code."""
    return replay_run.main([str(bag), *arguments], signals or Signals())


def twists(received):
    return [[one.linear.x, one.angular.z] for one in received]


def test_commands_come_as_recorded_and_only_they(world, bag):
    path, run = bag
    commands, told = world.harness.listen(Twist, 'cmd_vel'), world.harness.listen(Goals, 'goals')
    child = world.start('replay_run', str(path), '-r', '4', '--wait-for-all-acked', '5000')
    world.harness.until(lambda: len(commands) == len(run.cmd_vel), 'all have come')
    assert child.exit() == 0
    assert child.last_line == f'{len(run.cmd_vel)} messages played'
    assert twists(commands) == run.cmd_vel.values.tolist()
    assert told == []


def test_messages_that_the_bag_counts_and_lacks_are_reported(world, bag, tmp_path, capsys):
    path = shutil.copytree(bag[0], tmp_path / 'run')
    count_more(path, '/cmd_vel', 7)
    assert play(path, '-r', '10') == 0
    assert 'warning: 7 messages are missing in the bag' in capsys.readouterr().err
    assert play(path, '-r', '10', '--start-offset', '1') == 0
    assert 'missing' not in capsys.readouterr().err


def test_goals_drive_a_new_robot_to_the_same_place(world, bag):
    path, _ = bag
    world.start('virtual_robot')
    world.start('go_to_goal')
    told, commands = world.harness.listen(Goals, 'goals'), world.harness.listen(Twist, 'cmd_vel')
    world.until_published('odom', 'cmd_vel')
    # A reader may find the publisher later than the publisher finds the reader.
    acked = ('--wait-for-all-acked', '10000')
    child = world.start('replay_run', str(path), '--goals', '-w', '2', *acked)
    world.harness.until(lambda: commands, 'the controller drives')
    assert told[0].goals[0].pose.position.x == 1.0
    assert child.exit() == 0


def test_everything_remapped_with_a_clock_in_loops_until_interrupted(world, bag):
    path, run = bag
    harness = world.harness
    commands, clock = harness.listen(Twist, 'again'), harness.listen(Clock, '/clock')
    options = ('--all-topics', '-l', '-r', '8', '--clock', '100', '-m', '/cmd_vel:=/again')
    child = world.start('replay_run', str(path), *options)
    harness.until(lambda: len(commands) > 2 * len(run.cmd_vel), 'the second round')
    child.signal(signal.SIGINT)
    assert child.exit() == 130
    assert twists(commands)[: len(run.cmd_vel)] == run.cmd_vel.values.tolist()
    times = np.array([one.clock.sec + 1e-9 * one.clock.nanosec for one in clock])
    begin = run.odometry.received[0] / 1e9
    assert begin - 0.1 <= times.min() < times.max() <= begin + LENGTH + 0.5
    assert 'no node is subscribed to /odom' in child.stderr


def test_offset_leaves_the_beginning_out(world, bag):
    path, run = bag
    commands = world.harness.listen(Twist, 'cmd_vel')
    for _ in range(3):
        options = ('--start-offset', '1.5', '-r', '5', '--wait-for-all-acked', '20000')
        child = world.start('replay_run', str(path), *options)
        assert child.exit() == 0
        count = int(child.last_line.split()[0])
        assert 20 <= count <= 30
        with suppress(AssertionError):
            world.harness.until(lambda: len(commands) == count, 'all have come', 2.0)  # noqa: B023
        if len(commands) == count:
            break
        # On a busy machine DDS may have matched us later than it told the tool.
        commands.clear()
    assert twists(commands) == run.cmd_vel.values[-count:].tolist()


def test_fast_playback_is_acknowledged_before_the_usual_heartbeat(world, bag):
    path, run = bag
    commands = world.harness.listen(Twist, 'cmd_vel')
    child = world.start('replay_run', str(path), '-w', '1', '-r', '20', '--wait-for-all-acked', '2900')
    world.harness.until(lambda: len(commands) == len(run.cmd_vel), 'all have come')
    assert child.exit() == 0
    # On a busy machine its executor may report that it is late.
    assert not [
        line
        for line in child.stderr.splitlines()
        if 'messages and requests' not in line and 'messages or requests' not in line
    ]
    assert child.last_line == f'{len(run.cmd_vel)} messages played'


def test_subscriptions_that_do_not_acknowledge_are_reported(world, bag, capsys, monkeypatch):
    monkeypatch.setattr(replay_run, 'MATCH_PATIENCE', 0.1)
    monkeypatch.setattr(Replayer, 'unacknowledged', lambda player: ['/cmd_vel'])
    assert play(bag[0], '-r', '50', '--wait-for-all-acked', '1') == 1
    assert capsys.readouterr().err.splitlines()[-1] == (
        'replay_run: error: not all subscriptions to /cmd_vel have acknowledged all messages '
        'within 0.001 s'
    )


def test_acknowledgements_are_not_waited_for_after_a_signal(world, bag, monkeypatch):
    signals = Signals()

    def unacknowledged(_):
        signals.count = 1
        return ['/cmd_vel']

    monkeypatch.setattr(replay_run, 'MATCH_PATIENCE', 0.1)
    monkeypatch.setattr(Replayer, 'unacknowledged', unacknowledged)
    assert play(bag[0], '-r', '50', '--wait-for-all-acked', '0', signals=signals) == 130


def test_it_waits_for_the_required_number_of_subscriptions(world, bag):
    path, run = bag
    child = world.start('replay_run', str(path), '-w', '2', '-r', '4', '--wait-for-all-acked', '20000')
    received = [world.harness.listen(Twist, 'cmd_vel')]
    child.until_says('waiting: /cmd_vel has 1 of 2 subscriptions')
    received.append(world.harness.listen(Twist, 'cmd_vel'))
    world.harness.until(lambda: not child.running, 'it is played')
    assert child.exit() == 0
    world.harness.until(
        lambda: [len(one) for one in received] == [len(run.cmd_vel)] * 2, 'both have received everything'
    )


def test_nothing_is_played_to_fewer_subscriptions_than_required(world, bag, capsys):
    assert play(bag[0], '-w', '2', '--timeout', '0.2') == 1
    out = capsys.readouterr().out
    assert out == 'nothing was played: /cmd_vel has 0 of 2 subscriptions after --timeout 0.2 s\n'
    signals = Signals()
    signals.count = 1
    assert play(bag[0], '-w', '1', signals=signals) == 130
    assert (
        capsys.readouterr().out == 'interrupted: nothing was played, /cmd_vel has 0 of 1 subscriptions\n'
    )


def test_a_missing_subscription_is_reported_with_the_remedy(world, bag, capfd, monkeypatch):
    monkeypatch.setattr(replay_run, 'MATCH_PATIENCE', 0.1)
    assert play(bag[0], '-r', '50') == 0
    assert 'no node is subscribed to /cmd_vel (-w 1 waits for one)' in capfd.readouterr().err


def test_another_publisher_is_reported(world, bag):
    path, _ = bag
    world.harness.peer.create_publisher(Twist, 'cmd_vel', 10)
    child = world.start('replay_run', str(path), '-r', '50')
    world.harness.until(lambda: not child.running, 'it is played')
    assert '/peer also publishes on /cmd_vel' in child.stderr


# --- Other names


def test_relative_names_are_remapped(world, bag):
    """Playing under the recorded name instead would move the real robot."""
    path, run = bag
    recorded, commands = (
        world.harness.listen(Twist, 'cmd_vel'),
        world.harness.listen(Twist, 'sim/cmd_vel'),
    )
    options = ('-r', '4', '-w', '1', '-m', 'cmd_vel:=sim/cmd_vel', '--wait-for-all-acked', '20000')
    child = world.start('replay_run', str(path), *options)
    world.harness.until(lambda: len(commands) == len(run.cmd_vel), 'all have come')
    assert child.exit() == 0
    assert recorded == []


# --- Nothing to play


@pytest.mark.parametrize('loop', [(), ('--loop',)], ids=['once', 'loop'])
@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (('--goals', '--start-offset', '1'), 'no messages of /goals after --start-offset 1'),
        (('--topics', '/goals', '--start-offset', '1.5'), 'no messages of /goals after'),
        (('SPARSE',), 'no messages of cmd_vel, only of /goals (--all-topics plays them)'),
        (('SPARSE', '--topics', '/cmd_vel'), 'no messages of /cmd_vel, only of /goals'),
        (('EMPTY',), 'EMPTY has no messages'),
        (('EMPTY', '--all-topics'), 'EMPTY has no messages'),
    ],
    ids=lambda value: ' '.join(value) if isinstance(value, tuple) else '',
)
def test_nothing_to_play_is_an_error(world, bag, tmp_path, monkeypatch, capsys, arguments, words, loop):
    monkeypatch.chdir(tmp_path)
    build(tmp_path / 'EMPTY', {'/cmd_vel': [], '/goals': []})
    build(tmp_path / 'SPARSE', {'/cmd_vel': [], '/goals': [Goals()]})
    path = arguments[0] if arguments[0].isupper() else bag[0]
    assert play(path, *[one for one in arguments if not one.isupper()], *loop) == 1
    out, err = capsys.readouterr()
    assert out == ''
    assert err.startswith('replay_run: error: nothing to play: ')
    assert words in err
    assert err.count('\n') == 1


def build(path, topics, step=1):
    """Write a bag with the messages of each topic at 1 s, and each a step (s) after the one before."""
    types = {'/cmd_vel': 'geometry_msgs/msg/Twist', '/goals': 'nav_msgs/msg/Goals'}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, sent in topics.items():
            known = definition(types[topic])
            connection = writer.add_connection(
                topic, known.name, msgdef=known.text, rihs01=known.type_hash
            )
            for index, message in enumerate(sent):
                writer.write(connection, (1 + index * step) * 1_000_000_000, serialize_message(message))


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (('-r', '0.1'), '--rate must be at least 2'),
        (('--clock', '-r', '1e9'), 'must have less than 2147483648 s, the bag ends at 9223372036'),
    ],
    ids=['rate', 'clock'],
)
def test_times_that_are_far_apart_are_reported(tmp_path, capsys, arguments, words):
    build(tmp_path / 'FAR', {'/cmd_vel': [Twist(), Twist()]}, step=9_223_372_035)
    assert play(tmp_path / 'FAR', *arguments) == 2
    out, err = capsys.readouterr()
    assert (out, err.count('\n')) == ('', 1)
    assert words in err


def test_the_clock_does_not_pass_the_end_at_any_rate(world, bag, monkeypatch):
    signals, publish_time = Signals(), Replayer._publish_time

    def publish_time_and_interrupt(player):
        publish_time(player)
        signals.count = int(player._wall > 0)

    monkeypatch.setattr(replay_run, 'MATCH_PATIENCE', 0.1)
    monkeypatch.setattr(Replayer, '_publish_time', publish_time_and_interrupt)
    assert play(bag[0], '-r', '1e300', '-l', '--clock', '100', signals=signals) == 130


def test_every_round_takes_as_long_as_the_recording(world, bag):
    """The one message of /goals is the first of the run: it is not published without a pause."""
    path, _ = bag
    received = world.harness.listen(Goals, 'goals')
    clock = world.harness.listen(Clock, '/clock')
    child = world.start('replay_run', str(path), '--goals', '-w', '1', '-l', '-r', '8', '--clock', '200')
    world.harness.until(lambda: len(received) >= 4, 'the fourth round')
    child.signal(signal.SIGINT)
    assert child.exit() == 130
    count = len(received)
    times = np.array([one.clock.sec + 1e-9 * one.clock.nanosec for one in clock])
    rounds = np.flatnonzero(np.diff(times) < -LENGTH / 2)
    assert len(rounds) + 1 <= count <= len(rounds) + 2


# --- Verification


def verify(capsys, *arguments):
    """Run the tool; gives the exit code and what it printed."""
    code = replay_run.main([*map(str, arguments), '--verify'], Signals())
    return code, capsys.readouterr().out


def test_verified_run_is_as_recorded(capsys, bag):
    code, said = verify(capsys, bag[0])
    assert code == 0
    assert 'commands from cmd_vel_out' in said
    assert 'allowed 1e-09 m' in said
    assert said.splitlines()[-1] == 'the robot moves as recorded'


def test_bag_of_others_is_verified_with_parameters_from_a_file(capsys, request, tmp_path):
    foreign = request.path.parent / 'bags' / 'turtlebot3_fake_sqlite'
    code, said = verify(capsys, foreign)
    assert code == 0
    assert 'commands from cmd_vel,' in said
    file = tmp_path / 'slow.yaml'
    file.write_text('virtual_robot:\n  ros__parameters:\n    linear: {x: {max_velocity: 0.05}}\n')
    code, said = verify(capsys, foreign, '--params-file', file)
    assert code == 1
    assert 'position: exceeded in' in said
    assert said.splitlines()[-1] == 'the robot moves NOT as recorded'
    assert verify(capsys, foreign, '--tolerance', '1e-6')[0] == 1


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['nowhere'], 'there is no bag nowhere'),
        (['empty'], 'empty is an empty folder'),
        (['empty', '--verify'], 'empty is an empty folder'),
        (['file.txt', '--verify'], 'file.txt is not a bag'),
        (['BAG', '-r', '-1'], 'must be positive'),
        (['BAG', '--start-offset', '99'], '--start-offset must be less than the length of the bag'),
        (['BAG', '-r', '1e-12'], '--rate must be at least 4.'),
        (['BAG', '-r', '1e-320'], '--rate must be at least 4.'),
        (['BAG', '--clock', '1e-12'], '--clock must be in [1e-09, 1e+09] Hz, got 1e-12'),
        (['BAG', '--clock', '1e12'], '--clock must be in [1e-09, 1e+09] Hz, got 1e+12'),
        (['BAG', '-m', '/cmd_vel:=~/x{y}'], "cannot be played as '~/x{y}': failed to resolve name"),
        (['BAG', '-m', '/cmd_vel:=a b'], "cannot be played as 'a b': failed to resolve name"),
        (['BAG', '--start-offset', '1e300'], 'must be less than the length of the bag'),
        (['BAG', '--start-offset', '-1'], 'must be zero or positive and finite, got -1.0'),
        (['BAG', '--topics', '/nothing'], 'has no topic /nothing; it has /cmd_vel'),
        (['BAG', '-m', 'nonsense'], 'must be OLD:=NEW'),
        (['BAG', '-m', 'cmd_vell:=/sim/cmd_vel'], 'that is played, /cmd_vel, got /cmd_vell'),
        (['BAG', '--goals', '-m', 'cmd_vel:=/sim/cmd_vel'], 'that is played, /goals, got /cmd_vel'),
        (['BAG', '-m', 'cmd_vel:=/a', '/cmd_vel:=/b'], '/cmd_vel must be remapped once, got /a and /b'),
        (['BAG', '-m', '~/x{y}:=/cmd_vel'], 'remapping ~/x{y}:=/cmd_vel: '),
        (['BAG', '-w', '0'], 'must be an integer of at least 1, got 0'),
        (['BAG', '--timeout', '1'], '--timeout needs -w'),
        (
            ['BAG', '--verify', '--params-file', 'file.txt'],
            'file of ROS parameters, got file.txt',
        ),
        (['BAG', '--verify', '--tolerance', '0'], 'must be positive'),
        (['BAG', '--goals', '--verify'], 'not allowed with --verify: --goals'),
        (['--verify', 'BAG', '-r', '2'], 'not allowed with --verify: -r 2'),
        (['--verify', 'BAG', '--ros-args', '-p', 'x:=1'], 'not allowed with --verify: --ros-args'),
        (['BAG', '--tolerance', '1'], 'unrecognized arguments: --tolerance 1'),
    ],
)
def test_wrong_arguments_are_reported(capsys, bag, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'file.txt').write_text('not a bag')
    with pytest.raises(SystemExit) as caught:
        raise SystemExit(
            replay_run.main([str(bag[0]) if one == 'BAG' else one for one in arguments], Signals())
        )
    assert caught.value.code == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith('replay_run: error: ')
    assert words in line
