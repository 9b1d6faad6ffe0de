"""The nodes, send_goal and drive_to as processes: signals, exit codes, and who discovers whom."""

from __future__ import annotations

import itertools
import os
import re
import signal
import time

import pytest
from support.processes import Drive, open_world

pytestmark = pytest.mark.process

NODES = ('virtual_robot', 'go_to_goal', 'wheel_bridge')
FAST = ('--ros-args', '-p', 'kp:=8.0', '-p', 'kv:=4.0')
FAR = ('50', '0')


@pytest.fixture
def world(tmp_path):
    with open_world(tmp_path) as made:
        yield made


# --- Signals


def test_nodes_exit_0_on_a_signal(world):
    signals = [(signal.SIGINT,), (signal.SIGTERM,), (signal.SIGINT, signal.SIGINT)]
    children = [(world.start(name), numbers) for name, numbers in zip(NODES, signals, strict=True)]
    for child, numbers in children:
        child.until_says('subscribed to ')
        for number in numbers:
            child.signal(number)
    for child, _ in children:
        assert child.exit() == 0
        assert 'Traceback' not in child.stderr


def test_nodes_exit_0_on_signals_that_do_not_cease(world):
    # From the start of the imports to the last moment of the interpreter.
    children = [world.start(name, fresh=True) for name in NODES]
    for child in children:
        child.until_catches(signal.SIGHUP)
    # New interpreters import a lot: on a machine that is busy otherwise, for long.
    deadline = time.monotonic() + 60.0
    for number in itertools.cycle([signal.SIGINT, signal.SIGTERM, signal.SIGHUP]):
        if not any(child.running for child in children):
            break
        assert time.monotonic() < deadline
        for child in children:
            child.signal(number)
        time.sleep(0.002)
    assert [child.exit() for child in children] == [0, 0, 0]
    for child in children:
        assert 'Traceback' not in child.stderr


def test_sigterm_to_the_controller_stops_the_robot(world):
    drive = Drive(world)
    sender = drive.send(*FAR)
    drive.controller.signal(signal.SIGTERM)
    assert drive.controller.exit(5.0) == 0
    assert 'Traceback' not in drive.controller.stderr
    assert sender.exit() == 1
    assert sender.last_line.startswith(('canceled', 'lost'))
    drive.until_canceled()
    drive.harness.until(lambda: drive.commands[-1] == type(drive.commands[-1])(), 'zero came last')


# --- Goals


def test_send_goal_drives_three_processes_to_the_goal(world):
    world.start('virtual_robot', '--ros-args', '-p', 'command_interface:=wheels')
    world.start('go_to_goal', *FAST)
    world.start('wheel_bridge')
    sender = world.run('send_goal', '1', '1')
    assert sender.exit() == 0
    assert sender.last_line.startswith('arrived')
    assert sender.stderr == ''


def test_each_goal_has_its_own_end_whatever_became_of_older_ones(world):
    drive = Drive(world, *FAST)
    foreign = world.run('send_goal', '1', '1', '--frame', 'map')
    assert (foreign.exit(), foreign.last_line[:7]) == (1, 'aborted')
    drive.controller.until_says("refused: .*'odom'.*'map'")
    assert not drive.commands
    for x in ('0.1', '0.4'):
        sender = world.run('send_goal', x, '0')
        assert (sender.exit(), sender.last_line[:7]) == (0, 'arrived')
        drive.harness.until(
            lambda x=x: abs(drive.odometry[-1].pose.pose.position.x - float(x)) < 0.021, f'is at {x}'
        )


def test_no_wait_leaves_the_goal_and_timeout_and_ctrl_c_cancel_it(world):
    drive = Drive(world)
    left = world.start('send_goal', *FAR, '--no-wait')
    drive.harness.until(drive.drives, 'the robot drives')
    sender = world.run('send_goal', *FAR, '--timeout', '0.5')
    assert sender.exit() == 1
    lines = sender.stdout.splitlines()
    assert lines[-2].startswith('not arrived within --timeout 0.5 s')
    assert lines[-1] == 'canceled: the robot was stopped'
    drive.until_canceled()
    assert (left.exit(), left.last_line) == (0, 'sent: goal (50, 0) on /goal_pose')
    sender = drive.send(*FAR)
    sender.signal(signal.SIGINT)
    assert sender.exit(5.0) == 130
    assert sender.last_line == 'canceled: the robot was stopped'
    assert 'Traceback' not in sender.stderr
    drive.until_canceled()
    assert drive.controller.running


def test_a_second_ctrl_c_ends_the_wait_for_a_controller_that_hangs(world):
    drive = Drive(world)
    sender = drive.send(*FAR)
    drive.controller.signal(signal.SIGSTOP)
    begun = time.monotonic()
    while sender.running and time.monotonic() < begun + 4.0:
        sender.signal(signal.SIGINT)
        time.sleep(0.3)
    assert sender.exit(0.1) == 130
    assert sender.last_line.endswith('the robot may still drive')
    assert 'Traceback' not in sender.stderr
    drive.controller.signal(signal.SIGKILL)


def test_a_controller_that_was_killed_is_noticed_within_seconds(world):
    drive = Drive(world)
    sender = drive.send(*FAR)
    drive.controller.signal(signal.SIGKILL)
    # DDS takes it for alive for 20 s.
    assert sender.exit(10.0) == 1
    assert drive.harness.peer.count_publishers('goal_status') == 1
    assert sender.last_line.startswith('lost: the controller /go_to_goal has not answered for 3 s')
    assert sender.stderr == ''


def test_another_reader_of_goals_is_no_controller(world):
    from geometry_msgs.msg import PoseStamped

    recorded = world.harness.listen(PoseStamped, 'goal_pose')
    sender = world.start('send_goal', '0', '0')
    # It waits, though its goal would be read.
    world.until_published('goal_pose')
    sender.until_says('waiting: no node is subscribed to /goal_pose and publishes /goal_status')
    drive = Drive(world, *FAST)
    assert (sender.exit(), sender.last_line[:7]) == (0, 'arrived')
    world.harness.until(lambda: len(recorded) == 1, 'the goal was sent once')
    assert not recorded[0].header.frame_id
    drive.controller.signal(signal.SIGINT)
    assert drive.controller.exit() == 0


def test_send_goal_reports_a_missing_controller(world):
    arguments = ('-1', '-1e-1', '--wait', '1', '--ros-args', '-r', '__ns:=/here')
    sender = world.start('send_goal', *arguments, fresh=True)
    assert sender.exit() == 1
    assert sender.last_line.startswith(
        'not sent within 1 s: no node is subscribed to /here/goal_pose and'
    )
    assert sender.stderr == ''


# --- drive_to


def assert_arrived(child, x, y):
    """Check that drive_to arrived, and that it reports the right position."""
    assert (child.exit(), child.stderr) == (0, '')
    numbers = re.fullmatch(
        r'arrived: the robot stopped at x (\S+) m, y (\S+) m, heading \S+ rad, '
        r'(\S+) m from the goal, after \S+ s',
        child.last_line,
    )
    at_x, at_y, distance = map(float, numbers.groups())
    assert distance <= 0.02
    assert (at_x - x) ** 2 + (at_y - y) ** 2 <= 0.021**2


def test_drive_to_arrives(world):
    usual = world.start('drive_to', '--no-record', '0.3', '0.2')
    waypoints = world.start('drive_to', '--no-record', '0.3', '0', '-1e-1', '-.1', *FAST)
    assert_arrived(usual, 0.3, 0.2)
    first = usual.stdout.splitlines()[0]
    assert re.match(r'goal 1/1 \(0.3, 0.2\) +0.361 m to go, wheels left +0.00, right', first)
    assert_arrived(waypoints, -0.1, -0.1)
    assert re.search(r'goal 1/2 \(0.3, 0\)(.|\n)*goal 2/2 \(-0.1, -0.1\)', waypoints.stdout)


@pytest.mark.parametrize('older', [{}, {'ROS_LOCALHOST_ONLY': '1'}], ids=['usual', 'localhost only'])
def test_drive_to_is_not_discovered(world, monkeypatch, older):
    peer = world.harness.peer
    for name, value in older.items():
        monkeypatch.setenv(name, value)
    child = world.start('drive_to', '--no-record', '0.05', '0', *FAST)
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

    child = world.start('drive_to', '--no-record', '0.2', '0', '--open', *FAST)
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


def test_drive_to_exits_130_on_a_signal(world):
    signals = [(signal.SIGINT, signal.SIGINT), (signal.SIGTERM,)]
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
