"""The tool drive_to as a process, and the arguments of the tools."""

from __future__ import annotations

import os
import re
import signal
import time
from pathlib import Path

import pytest
from support.processes import open_world

pytestmark = pytest.mark.process

CONFIGS = sorted((Path(__file__).parents[2] / 'config').glob('*.yaml'))
QUICK = ('--ros-args', '-p', 'go_to_goal:kp:=8.0', '-p', 'go_to_goal:kv:=4.0')
FAR = ('50', '0')


@pytest.fixture
def world(tmp_path):
    with open_world(tmp_path) as made:
        yield made


def assert_arrived(child, x, y, tolerance=0.02):
    """Check that it arrived, and that it reports the right position."""
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
def drives(tmp_path_factory):
    """Start drives that need no interaction, all at once; they run during the other tests."""
    directory = tmp_path_factory.mktemp('drives')
    malformed = directory / 'malformed.yaml'
    malformed.write_text('go_to_goal: [1, 2\n  b: }')
    commands = {
        'usual': ('0.3', '0.2'),
        'waypoints': ('0.3', '0', '0.3', '0.3', *QUICK),
        'behind': ('-1e-1', '-.1', '--tolerance', '0.01', *QUICK),
        'late': (*FAR, '--timeout', '0.5'),
        'all nodes': ('0', '0', '--ros-args', '-p', 'kp:=6.0', '-p', 'wheel_radius:=0.05'),
        'kp': ('1', '1', '--ros-args', '-p', 'kp:=0.0'),
        'malformed': ('1', '1', '--params-file', str(malformed)),
    }
    for config in CONFIGS:
        commands[config.stem] = ('0.2', '0.1', '--tolerance', '0.1', '--params-file', str(config))
    with open_world(directory) as world:
        yield {
            name: world.start('drive_to', '--no-record', *command) for name, command in commands.items()
        }


# --- Driving


def test_drive_to_arrives(drives):
    assert_arrived(drives['behind'], -0.1, -0.1, 0.01)
    assert_arrived(drives['waypoints'], 0.3, 0.3)
    assert re.search(r'goal 1/2 \(0.3, 0\)(.|\n)*goal 2/2 \(0.3, 0.3\)', drives['waypoints'].stdout)


def test_a_parameter_of_one_of_its_nodes_is_not_unknown_to_drive_to(drives):
    assert_arrived(drives['all nodes'], 0.0, 0.0)


@pytest.mark.parametrize('config', [config.stem for config in CONFIGS])
def test_drive_to_takes_the_files_in_config(drives, config):
    assert_arrived(drives[config], 0.2, 0.1, 0.1)


def test_drive_to_gives_up_after_the_timeout(drives):
    late = drives['late']
    assert (late.exit(), late.stderr) == (1, '')
    assert late.last_line.startswith('not arrived (--timeout 0.5 s was too short): the robot')


def test_drive_to_reports_invalid_parameters_of_its_nodes(drives):
    refused = {'malformed': 'malformed.yaml', 'kp': "'kp' must be in (0, 100], got 0.0"}
    for name, words in refused.items():
        assert (drives[name].exit(), drives[name].stdout) == (2, '')
        assert 'Traceback' not in drives[name].stderr
        assert words in drives[name].stderr.splitlines()[-1]


@pytest.mark.parametrize('older', [{}, {'ROS_LOCALHOST_ONLY': '1'}], ids=['usual', 'localhost only'])
def test_drive_to_is_not_discovered(world, monkeypatch, older):
    peer = world.harness.peer
    for name, value in older.items():
        monkeypatch.setenv(name, value)
    child = world.start('drive_to', '--no-record', '0.05', '0', *QUICK)
    seen = set()
    while child.running:
        world.harness.executor.spin_once(timeout_sec=0.01)
        seen |= set(peer.get_node_names()) | {name for name, _ in peer.get_topic_names_and_types()}
    assert_arrived(child, 0.05, 0.0)
    assert seen == {'peer', '/parameter_events', '/rosout'}


def test_drive_to_open_is_discovered_and_reports_where_the_robot_stopped(world):
    from geometry_msgs.msg import TwistStamped
    from nav_msgs.msg import Odometry

    odometry = world.harness.listen(Odometry, 'odom')
    applied = world.harness.listen(TwistStamped, 'cmd_vel_out')
    # So slow that the robot moves already while the last odometry has zero velocity.
    child = world.start(
        'drive_to', *FAR, '--no-record', '--open', '--ros-args', '-p', 'virtual_robot:publish_rate:=4.0'
    )
    world.harness.until(lambda: applied and odometry, 'it drives')
    child.signal(signal.SIGINT)
    assert child.exit(5.0) == 130
    reported = float(re.search(r'stopped at x (\S+) m', child.last_line)[1])
    assert reported > 0.0

    def stands_there():
        pose, twist = odometry[-1].pose.pose, odometry[-1].twist.twist
        return twist.linear.x == 0.0 and abs(pose.position.x - reported) < 0.001

    world.harness.until(stands_there, 'it stands at the reported position', patience=3.0)


def test_drive_to_open_survives_invalid_messages_of_other_processes(world):
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import JointState

    child = world.start('drive_to', '--no-record', '0.2', '0', '--open', *QUICK)
    bad = Odometry()
    bad.pose.pose.position.x = float('nan')
    odom = world.harness.talk(Odometry, 'odom')
    states = world.harness.talk(JointState, 'joint_states')
    while child.running:
        odom.publish(bad)
        states.publish(JointState(name=['a', 'b', 'c']))
        world.harness.executor.spin_once(timeout_sec=0.02)
    assert (child.exit(), child.last_line[:9]) == (0, 'arrived: ')
    assert 'odometry dropped: position must be finite' in child.stderr


# --- Signals


def test_drive_to_exits_130_on_a_signal(world):
    signals = [(signal.SIGINT,), (signal.SIGINT, signal.SIGINT), (signal.SIGTERM,)]
    children = [world.start('drive_to', '--no-record', *FAR) for _ in signals]
    for child, numbers in zip(children, signals, strict=True):
        child.until_says(r'goal 1/1 \(50, 0\)')
        for number in numbers:
            child.signal(number)
        assert child.exit(5.0) == 130
        assert child.last_line.startswith('interrupted: the robot stopped at')
        assert child.stderr == ''


def test_drive_to_exits_130_on_signals_that_do_not_cease(world):
    def interrupt(child):
        deadline = time.monotonic() + 60.0
        while child.running:
            assert time.monotonic() < deadline
            child.signal(signal.SIGINT)
            time.sleep(0.002)
        assert child.exit() == 130
        assert 'Traceback' not in child.stderr

    # While it imports, and when it has imported.
    for fresh in (True, False):
        started = world.start('drive_to', '--no-record', *FAR, fresh=fresh)
        started.until_catches(signal.SIGHUP)
        interrupt(started)
        # On a busy machine it may take longer to start than it is given after the second signal.
        killed = started.stderr in (
            'drive_to: interrupted\n',
            'drive_to: ended by a second signal, before it could finish\n',
        )
        assert killed or started.last_line.startswith('interrupted: the robot')
    driving = world.start('drive_to', '--no-record', *FAR)
    driving.until_says('m to go')
    interrupt(driving)
    assert driving.last_line.startswith('interrupted: the robot')


def test_drive_to_survives_a_reader_that_goes_away(world):
    # As in `drive_to 1 1 | head -1`.
    read, write = os.pipe()
    os.close(read)
    child = world.start('drive_to', '--no-record', *FAR, '--timeout', '0.2', stdout=write)
    os.close(write)
    assert (child.exit(), child.stderr) == (1, '')


def test_drive_to_arrives_with_nothing_but_defaults(drives):
    assert_arrived(drives['usual'], 0.3, 0.2)
    first = drives['usual'].stdout.splitlines()[0]
    assert re.match(r'goal 1/1 \(0.3, 0.2\) +0.361 m to go, wheels left +0.00, right', first)
