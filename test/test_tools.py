"""The tool drive_to as a process, and how the tools read their arguments."""

from __future__ import annotations

import os
import re
import signal
import time
from pathlib import Path

import pytest
from processes import open_world

from diffdrive_jacobian.tools import _cli

CONFIGS = sorted((Path(__file__).parents[1] / 'config').glob('*.yaml'))
QUICK = ('--ros-args', '-p', 'go_to_goal:kp:=8.0', '-p', 'go_to_goal:kv:=4.0')
FAR = ('50', '0')


@pytest.fixture
def world(tmp_path):
    with open_world(tmp_path) as made:
        yield made


def assert_arrived(child, x, y, tolerance=0.02):
    """It ended well, and says truly where."""
    assert (child.exit(), child.stderr) == (0, '')
    numbers = re.fullmatch(
        r'arrived: the robot stopped at x (\S+) m, y (\S+) m, heading \S+ rad, '
        r'(\S+) m from the goal, after \S+ s',
        child.last_line,
    )
    at_x, at_y, distance = map(float, numbers.groups())
    assert distance <= tolerance
    assert (at_x - x) ** 2 + (at_y - y) ** 2 <= (tolerance + 0.001) ** 2


@pytest.fixture(scope='module', autouse=True)
def usual(tmp_path_factory):
    """A drive of six seconds with nothing but defaults; it goes on behind the other tests."""
    with open_world(tmp_path_factory.mktemp('usual')) as world:
        yield world.start('drive_to', '0.3', '0.2')


# --- Driving


def test_drive_to_arrives(world):
    waypoints = world.start('drive_to', '0.3', '0', '0.3', '0.3', *QUICK)
    behind = world.start('drive_to', '-1e-1', '-.1', '--tolerance', '0.01', *QUICK)
    assert_arrived(behind, -0.1, -0.1, 0.01)
    assert_arrived(waypoints, 0.3, 0.3)
    assert 'goal 1/2 (0.3, 0)' in waypoints.stdout
    assert 'goal 2/2 (0.3, 0.3)' in waypoints.stdout


@pytest.mark.skipif(not CONFIGS, reason='config/ is empty')
def test_drive_to_takes_the_files_in_config(world):
    arguments = ('0.2', '0.1', '--tolerance', '0.1', '--params-file')
    for child in [world.start('drive_to', *arguments, str(config)) for config in CONFIGS]:
        assert_arrived(child, 0.2, 0.1, 0.1)


def test_drive_to_gives_up_after_the_timeout(world):
    child = world.run('drive_to', *FAR, '--timeout', '0.5')
    assert (child.exit(), child.stderr) == (1, '')
    assert child.last_line.startswith(
        'not arrived (--timeout 0.5 s was too short): the robot stopped at'
    )


@pytest.mark.parametrize('older', [{}, {'ROS_LOCALHOST_ONLY': '1'}], ids=['usual', 'localhost only'])
def test_drive_to_is_not_seen(world, monkeypatch, older):
    peer = world.harness.peer
    for name, value in older.items():
        monkeypatch.setenv(name, value)
    child = world.start('drive_to', '0.05', '0', *QUICK)
    seen = set()
    while child.running:
        world.harness.executor.spin_once(timeout_sec=0.01)
        seen |= set(peer.get_node_names()) | {name for name, _ in peer.get_topic_names_and_types()}
    assert_arrived(child, 0.05, 0.0)
    assert seen == {'peer', '/parameter_events', '/rosout'}


def test_drive_to_open_is_seen_and_tells_truly_where_the_robot_stopped(world):
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry

    odometry, commands = world.harness.listen(Odometry, 'odom'), world.harness.listen(Twist, 'cmd_vel')
    # So slow that the robot drives already when the last odometry still says that it stands.
    child = world.start(
        'drive_to', *FAR, '--open', '--ros-args', '-p', 'virtual_robot:publish_rate:=4.0'
    )
    world.harness.until(lambda: commands and odometry, 'it drives')
    child.signal(signal.SIGINT)
    assert child.exit(5.0) == 130
    reported = float(re.search(r'stopped at x (\S+) m', child.last_line)[1])
    world.harness.until(
        lambda: (
            odometry[-1].twist.twist.linear.x == 0.0
            and abs(odometry[-1].pose.pose.position.x - reported) < 0.001
        ),
        'it stands where it was said to',
        patience=3.0,
    )
    assert reported > 0.0


def test_drive_to_open_survives_what_strangers_publish(world):
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import JointState

    child = world.start('drive_to', '0.2', '0', '--open', *QUICK)
    bad = Odometry()
    bad.pose.pose.position.x = float('nan')
    odom = world.harness.talk(Odometry, 'odom')
    states = world.harness.talk(JointState, 'joint_states')
    while child.running:
        odom.publish(bad)
        states.publish(JointState(name=['a', 'b', 'c']))
        world.harness.executor.spin_once(timeout_sec=0.02)
    assert child.exit() == 0
    assert child.last_line.startswith('arrived: ')
    assert 'odometry dropped: position must be finite' in child.stderr
    assert 'Traceback' not in child.stderr


# --- Signals


def test_drive_to_exits_130_on_a_signal(world):
    signals = [(signal.SIGINT,), (signal.SIGINT, signal.SIGINT), (signal.SIGTERM,)]
    children = [world.start('drive_to', *FAR) for _ in signals]
    for child, numbers in zip(children, signals, strict=True):
        child.until_says(r'goal 1/1 \(50, 0\)')
        for number in numbers:
            child.signal(number)
        assert child.exit(5.0) == 130
        assert child.last_line.startswith('interrupted: the robot stopped at')
        assert child.stderr == ''


def test_drive_to_exits_130_on_signals_that_do_not_cease(world):
    children = [world.start('drive_to', *FAR), world.start('drive_to', *FAR)]
    children[0].until_catches(signal.SIGHUP)
    children[1].until_says('m to go')
    for child in children:
        deadline = time.monotonic() + 5.0
        while child.running:
            assert time.monotonic() < deadline
            child.signal(signal.SIGINT)
            time.sleep(0.002)
    assert [child.exit() for child in children] == [130, 130]
    for child in children:
        assert child.last_line.startswith('interrupted: the robot')
        assert 'Traceback' not in child.stderr


def test_drive_to_arrives_with_nothing_but_defaults(usual):
    assert_arrived(usual, 0.3, 0.2)
    assert re.match(r'goal 1/1 \(0.3, 0.2\) +0.361 m to go, wheels left +0.00, right', usual.stdout)


def test_drive_to_survives_a_reader_that_goes_away(world):
    # As in `drive_to 1 1 | head -1`.
    read, write = os.pipe()
    os.close(read)
    child = world.start('drive_to', *FAR, '--timeout', '0.2', stdout=write)
    os.close(write)
    child.exit()
    assert 'Traceback' not in child.stderr
    assert 'BrokenPipeError' not in child.stderr


def test_a_parameter_of_one_of_its_nodes_is_not_unknown_to_drive_to(world):
    child = world.run('drive_to', '0', '0', '--ros-args', '-p', 'kp:=6.0', '-p', 'wheel_radius:=0.05')
    assert_arrived(child, 0.0, 0.0)


# --- Arguments


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ((), 'X Y'),
        (('1',), 'got 1 of them'),
        (('1', '2', '3'), 'got 3 of them'),
        (('one', 'two'), "'one'"),
        (('', '0'), "''"),
        (('nan', '0'), "'nan'"),
        (('0', '-inf'), "'-inf'"),
        (('1e308', '0'), "'1e308'"),
        (('0', '-1000001'), "'-1000001'"),
        (('1', '1', '--tolerance', '0'), '--tolerance: must be in [1e-06, 100], got 0.0'),
        (('1', '1', '--tolerance', '-1'), '--tolerance: must be in [1e-06, 100], got -1.0'),
        (('1', '1', '--tolerance', 'abc'), "--tolerance: must be a finite number, got 'abc'"),
        (('1', '1', '--timeout', '-1e-3'), "--timeout: must be positive, got '-1e-3'"),
        (('1', '1', '--timeout', 'inf'), "'inf'"),
        (('1', '1', '--params-file', 'nowhere.yaml'), "no such file: 'nowhere.yaml'"),
        (('1', '1', '--params-file', '.'), "'.'"),
        (('1', '1', '--bogus'), '--bogus'),
    ],
    ids=lambda value: ' '.join(value) if isinstance(value, tuple) else '',
)
def test_drive_to_says_what_it_cannot_take(capsys, arguments, words):
    from diffdrive_jacobian.ros.signals import Signals
    from diffdrive_jacobian.tools import drive_to

    with pytest.raises(SystemExit) as end:
        drive_to.main(arguments, Signals())
    assert end.value.code == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith('drive_to: error: ')
    assert words in line


def test_drive_to_says_what_its_nodes_cannot_take(world, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'malformed.yaml').write_text('go_to_goal: [1, 2\n  b: }')
    refused = {
        ('--params-file', 'malformed.yaml'): 'malformed.yaml',
        ('--ros-args', '-p', 'kp:=0.0'): "'kp' must be in (0, 100], got 0.0",
    }
    children = [world.start('drive_to', '1', '1', *arguments) for arguments in refused]
    for child, words in zip(children, refused.values(), strict=True):
        assert (child.exit(), child.stdout) == (2, '')
        assert 'Traceback' not in child.stderr
        assert words in child.stderr.splitlines()[-1]


ROS = ['--ros-args', '-p', 'x:=-1', '-r', '__ns:=/a']


@pytest.mark.parametrize(
    ('arguments', 'own', 'ros'),
    [
        ([], [], []),
        (['1', '-1'], ['1', ' -1'], []),
        (['-1e-1', '-.5', '-1E+3'], [' -1e-1', ' -.5', ' -1E+3'], []),
        (['-inf', '-nan'], [' -inf', ' -nan'], []),
        (['--tolerance', '-1', '--timeout=-1'], ['--tolerance', ' -1', '--timeout=-1'], []),
        (['-h', '--open', '-', '-1m'], ['-h', '--open', '-', '-1m'], []),
        (['1', '1', *ROS], ['1', '1'], ROS),
        (['1', *ROS, '--', '-1'], ['1', ' -1'], [*ROS, '--']),
        ([*ROS, '--', '1', *ROS, '--', '1'], ['1', '1'], [*ROS, '--', *ROS, '--']),
        (['1', '--', '-1'], ['1', '--', ' -1'], []),
        (['--ros-args', '--ros-args', '-1'], [], ['--ros-args', '--ros-args', '-1']),
        (['1', '1', '--ros-args', '--'], ['1', '1'], ['--ros-args', '--']),
    ],
)
def test_arguments_of_tool_and_ros_are_told_apart(arguments, own, ros):
    assert _cli.split_arguments(arguments) == (own, ros)
