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

"""The nodes, send_goal and drive_to as processes: signals, exit codes, and who discovers whom."""

from __future__ import annotations

import itertools
import math
import os
import re
import signal
import time

import pytest
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from support.processes import Drive

pytestmark = pytest.mark.process

FAST = ('--ros-args', '-p', 'kp:=8.0', '-p', 'kv:=4.0')
FAR = ('50', '0')
RATE = 4.0
"""Rate of odometry that is so slow that the robot moves while the last one has zero velocity (Hz)."""


def interrupt(children, *numbers):
    """Send signals without end, until all children have exited."""
    # New interpreters import a lot: on a machine that is busy otherwise, for long.
    deadline = time.monotonic() + 60.0
    for number in itertools.cycle(numbers):
        if not any(child.running for child in children):
            break
        assert time.monotonic() < deadline
        for child in children:
            child.signal(number)
        time.sleep(0.002)
    assert not any('Traceback' in child.stderr for child in children)


# --- Nodes and send_goal


def test_a_node_exits_0_on_signals_that_do_not_cease(world):
    """From the start of the imports to the last moment of the interpreter."""
    child = world.start('virtual_robot')
    child.until_catches(signal.SIGHUP)
    interrupt([child], signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    assert child.exit() == 0


def test_send_goal_waits_for_the_controller_and_drives_three_processes_to_the_goal(world):
    """Another reader of goals is no controller."""
    recorded = world.harness.listen(PoseStamped, 'goal_pose')
    sender = world.start('send_goal', '0.1', '0')
    world.until_published('goal_pose')
    sender.until_says('waiting: no node is subscribed to /goal_pose and publishes /goal_status')
    nodes = [
        world.start('virtual_robot', '--ros-args', '-p', 'command_interface:=wheels'),
        world.start('go_to_goal', *FAST),
        world.start('wheel_bridge'),
    ]
    assert (sender.exit(), sender.last_line[:7], sender.stderr) == (0, 'arrived', '')
    world.harness.until(lambda: len(recorded) == 1, 'the goal was sent once')
    assert not recorded[0].header.frame_id
    interrupt(nodes, signal.SIGINT, signal.SIGTERM)
    assert [node.exit() for node in nodes] == [0, 0, 0]


def test_no_wait_leaves_the_goal_and_ctrl_c_cancels_it(world):
    drive = Drive(world)
    left = world.start('send_goal', *FAR, '--no-wait')
    drive.harness.until(drive.drives, 'the robot drives')
    assert (left.exit(), left.last_line) == (0, 'sent: goal (50, 0) on /goal_pose')
    sender = drive.send(*FAR)
    sender.signal(signal.SIGINT)
    assert sender.exit(5.0) == 130
    assert sender.last_line == 'canceled: the robot was stopped'
    assert 'Traceback' not in sender.stderr
    drive.until_canceled()
    assert drive.controller.running
    # A second Ctrl-C ends the wait for a controller that hangs.
    sender = drive.send(*FAR)
    drive.controller.signal(signal.SIGSTOP)
    deadline = time.monotonic() + 20.0
    while sender.running and time.monotonic() < deadline:
        sender.signal(signal.SIGINT)
        time.sleep(0.3)
    assert sender.exit(0.1) == 130
    assert sender.last_line.endswith('the robot may still drive')
    assert 'Traceback' not in sender.stderr
    drive.controller.signal(signal.SIGKILL)


# --- drive_to


def test_drive_to_arrives_and_is_not_discovered(world, monkeypatch):
    # The older variable does not open it.
    monkeypatch.setenv('ROS_LOCALHOST_ONLY', '1')
    # On a busy machine nodes may wait for each other, which is warned of.
    patient = ('-p', 'cmd_vel_timeout:=60.0', '-p', 'odom_timeout:=60.0')
    hidden = (*FAST, *patient, '-r', '__ns:=/hidden')
    child = world.start('drive_to', '--no-record', '0.1', '0', '-1e0', '-1.', *hidden)
    peer, seen = world.harness.peer, set()
    while child.running:
        world.harness.executor.spin_once(timeout_sec=0.01)
        seen |= {f'{namespace}/{name}' for name, namespace in peer.get_node_names_and_namespaces()}
        seen |= {name for name, _ in peer.get_topic_names_and_types()}
    assert '//peer' in seen
    assert not any('hidden' in name for name in seen)
    assert (child.exit(), child.stderr) == (0, '')
    first = child.stdout.splitlines()[0]
    assert re.match(r'goal 1/2 \(0.1, 0\) +0.100 m to go, wheels left +0.00, right', first)
    assert 'goal 2/2 (-1, -1)' in child.stdout
    numbers = re.fullmatch(
        r'arrived: the robot stopped at x (\S+) m, y (\S+) m, heading \S+ rad, '
        r'(\S+) m from the goal, after \S+ s',
        child.last_line,
    )
    x, y, distance = map(float, numbers.groups())
    assert distance <= 0.02
    assert math.dist((x, y), (-1.0, -1.0)) <= 0.021


def test_drive_to_open_survives_invalid_messages_and_reports_where_the_robot_stopped(world):
    odometry = world.harness.listen(Odometry, 'odom')
    applied = world.harness.listen(TwistStamped, 'cmd_vel_out')
    rate = ('--ros-args', '-p', f'virtual_robot:publish_rate:={RATE}')
    child = world.start('drive_to', *FAR, '--no-record', '--open', *rate)
    odom, states = world.harness.talk(Odometry, 'odom'), world.harness.talk(JointState, 'joint_states')
    bad = Odometry()
    bad.pose.pose.position.x = float('nan')
    odom.publish(bad)
    states.publish(JointState(name=['a', 'b', 'c']))
    child.until_says('odometry dropped: position must be finite')
    world.harness.until(lambda: applied and odometry, 'it drives')
    child.signal(signal.SIGINT)
    assert child.exit(5.0) == 130
    reported = float(re.search(r'stopped at x (\S+) m', child.last_line)[1])
    assert reported > 0.0

    def stands_there():
        """On a busy machine its last messages may not have left the process before that has ended."""
        last = [one for one in odometry if math.isfinite(one.pose.pose.position.x)][-1]
        ahead = reported - last.pose.pose.position.x
        return -0.001 < ahead < 0.001 + 0.5 * last.twist.twist.linear.x

    world.harness.until(stands_there, 'it stands at the reported position', patience=3.0)


def test_drive_to_exits_130_on_signals_while_it_imports(world):
    child = world.start('drive_to', '--no-record', *FAR)
    child.until_catches(signal.SIGHUP)
    interrupt([child], signal.SIGINT)
    assert child.exit() == 130
    # On a busy machine it may take longer to start than it is given after the second signal.
    killed = child.stderr in (
        'drive_to: interrupted\n',
        'drive_to: ended by a second signal, before it could finish\n',
    )
    assert killed or child.last_line.startswith('interrupted: the robot')


@pytest.mark.parametrize(
    ('number', 'options'),
    [(signal.SIGTERM, ()), (signal.SIGINT, ('--lockstep', '--timeout', '1e6'))],
    ids=['real time', 'lockstep'],
)
def test_drive_to_exits_130_on_a_signal_while_it_drives(world, number, options):
    child = world.start('drive_to', '--no-record', *FAR, *options)
    child.until_says(r'goal 1/1 \(50, 0\) .* m to go')
    child.signal(number)
    assert (child.exit(), child.stderr) == (130, '')
    assert child.last_line.startswith('interrupted: the robot stopped at')


def test_drive_to_survives_a_reader_that_goes_away(world):
    # As in `drive_to 1 1 | head -1`.
    read, write = os.pipe()
    os.close(read)
    child = world.start('drive_to', '--no-record', *FAR, '--timeout', '0.2', stdout=write)
    os.close(write)
    assert (child.exit(), child.stderr) == (1, '')
