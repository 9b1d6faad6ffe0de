"""The nodes and send_goal as processes: signals, exit codes, goals from one process to another."""

from __future__ import annotations

import itertools
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


def test_no_wait_leaves_the_goal_and_timeout_cancels_it(world):
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


def test_ctrl_c_cancels_the_goal(world):
    drive = Drive(world)
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


def test_send_goal_reports_the_distance_of_the_point_that_is_driven(world):
    """The point 0.5 m ahead of the axle comes to the goal, the axle stays half a metre away."""
    Drive(world, '--ros-args', '-p', 'controller:=offset_point', '-p', 'offset:=0.5')
    # Far enough that odometry arrives before the goal is reached.
    sender = world.run('send_goal', '0.7', '0')
    assert sender.exit() == 0
    assert re.fullmatch(r'arrived, 0\.0\d\d m from the goal', sender.last_line)


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


# --- Parameters and arguments

REFUSED = {
    'value': [
        ('virtual_robot', ('-p', 'wheel_radius:=0.0'), ("'wheel_radius'", 'got 0.0', '[0.001, 10]')),
        ('virtual_robot', ('-p', 'enable_odom_tf:=3'), ("'enable_odom_tf'", 'got 3', 'true or false')),
        ('go_to_goal', ('-p', 'kp:=fast'), ("'kp'", "got 'fast'", 'double')),
        ('wheel_bridge', ('-p', 'left_wheel_name:=right_wheel_joint'), ("'left_wheel_name'", 'differ')),
    ],
    # rclpy raises RuntimeError and RCLError for these, not InvalidQosOverridesError.
    'qos': [
        ('go_to_goal', ('-p', 'qos_overrides./odom.subscription.reliability:=often'), ('often',)),
        ('go_to_goal', ('-p', 'qos_overrides./odom.subscription.depth:=-3'), ()),
    ],
    'argument': [
        ('go_to_goal', ('--params-file', 'nowhere.yaml'), ('nowhere.yaml',)),
        ('go_to_goal', ('--params-file', 'malformed.yaml'), ('malformed.yaml',)),
        ('go_to_goal', ('--', '--bogus'), ('--bogus',)),
    ],
}


@pytest.mark.parametrize('kind', REFUSED)
def test_invalid_arguments_of_a_node_are_reported(world, tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'malformed.yaml').write_text('go_to_goal: [1, 2\n  b: }')
    children = [world.start(name, '--ros-args', *arguments) for name, arguments, _ in REFUSED[kind]]
    for child, (name, _, words) in zip(children, REFUSED[kind], strict=True):
        assert (child.exit(), child.stdout) == (2, ''), child.command
        assert 'Traceback' not in child.stderr
        *before, line = child.stderr.splitlines()
        assert line.startswith(f'{name}: error: ')
        assert not [word for word in words if word not in line]
        assert not (before and kind == 'value')


def test_an_integer_is_taken_for_a_double_and_an_unknown_parameter_is_named(world, tmp_path):
    from rcl_interfaces.srv import GetParameters

    file = tmp_path / 'parameters.yaml'
    file.write_text('go_to_goal:\n  ros__parameters:\n    xy_goal_tolerence: 0.1\n    kp: 4\n')
    node = world.start('go_to_goal', '--ros-args', '--params-file', str(file), '-p', 'kv:=1')
    node.until_says("unknown parameter 'xy_goal_tolerence' .* did you mean 'xy_goal_tolerance'")
    client = world.harness.peer.create_client(GetParameters, 'go_to_goal/get_parameters')
    world.harness.until(client.service_is_ready, 'parameter service')
    future = client.call_async(GetParameters.Request(names=['kp', 'kv']))
    world.harness.until(future.done, 'parameters')
    assert [value.double_value for value in future.result().values] == [4.0, 1.0]
