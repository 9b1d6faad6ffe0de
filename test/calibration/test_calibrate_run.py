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

"""The tool calibrate_run: its files, what it reads from bags, and a message for each mistake."""

from __future__ import annotations

import math
import resource
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import yaml
from calibration_data import (
    JOINTS,
    NOMINAL,
    ROBOT,
    TRUE,
    Drive,
    assert_true,
    bag_messages,
    deviations,
    umbmark,
)
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from support import commands
from support.bags import count_more, write_bag
from support.lockstep_nodes import make_complete
from support.recorded import recorded
from support.ros_messages import twist

from diffdrive_jacobian.calibration import PARAMETERS, calibrate
from diffdrive_jacobian.calibration.data import read_wheels_and_reference, wheel_names
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.plots import calibration_figure
from diffdrive_jacobian.tools import calibrate_run

pytestmark = pytest.mark.slow
DIMENSIONS = {'/wheel_bridge': {'wheel_radius': 0.033, 'wheel_separation': 0.16}}


def drive(*commanded, seed=1):
    """Return a recording, by default of UMBmark."""
    robot = replace(ROBOT, drive=Drive.of(commanded)) if commanded else ROBOT
    return replace(robot, rate=15).recording(np.random.default_rng(seed))


RECORDING = drive()
SHORT = drive((8.0, 0.2, 0.5))


def write(path, sent=None, *, parameters=DIMENSIONS, **how):
    """Write a bag of messages, by default of a few seconds."""
    return write_bag(path, bag_messages(SHORT, **how) if sent is None else sent, parameters=parameters)


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A drive of UMBmark with a reference as PoseStamped. It is not changed."""
    return write(tmp_path_factory.mktemp('bags') / 'bag', bag_messages(RECORDING))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Where the tool works."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


run = partial(commands.run, 'calibrate_run')
refused = partial(commands.refused, 'calibrate_run')


def failed(*arguments):
    """Return what was printed and the error of a calibration that fails."""
    ended = run(*arguments)
    assert ended.code == 1
    return ended.out, commands.error_of('calibrate_run', ended)


def multipliers(path):
    values = yaml.safe_load(path.read_text())['/**']['ros__parameters']
    return [values[name] for name in PARAMETERS]


def left(folder):
    return sorted(one.name for one in folder.iterdir())


# --- Result


@pytest.mark.usefixtures('no_display')
def test_it_writes_parameters_and_a_picture(bag, folder, lockstep):
    for name in ('found.yaml', 'found.png'):
        (folder / name).write_text('replaced by --force')
    code, out, err = run(bag, '-o', 'found.yaml', '--force')
    assert code == 0
    assert err.startswith('calibrate_run: where the robot turns in place, it may go unnoticed')
    found = multipliers(folder / 'found.yaml')
    np.testing.assert_allclose(found, TRUE, atol=0.01)
    assert (folder / 'found.png').read_bytes().startswith(b'\x89PNG')
    assert left(folder) == ['found.png', 'found.yaml']
    assert out.endswith('found.yaml\nfound.png\n')
    assert all(f'{name}: {value:.5f} ± ' in out for name, value in zip(PARAMETERS, found, strict=True))
    # The bridge takes all of them, by these names.
    node = lockstep.add(WheelBridge(cli_args=['--ros-args', '--params-file', 'found.yaml']))
    assert [getattr(node.parameters, name) for name in PARAMETERS] == found


def test_speeds_and_another_clock_serve_too_and_matplotlib_is_not_needed(folder, monkeypatch):
    def draw(*_):
        raise ModuleNotFoundError(name='matplotlib')

    monkeypatch.setattr(calibrate_run, 'calibration_figure', draw)
    write(folder / 'bag', bag_messages(RECORDING, position=False, clock=5e5))
    ended = run('bag')
    assert ended.code == 0
    assert left(folder) == ['bag', 'bag_calibration.yaml']
    np.testing.assert_allclose(multipliers(folder / 'bag_calibration.yaml'), TRUE, atol=0.02)
    assert 'integrated from the speeds' in ended.err
    assert 'different clocks, so the times of recording are used' in ended.err
    assert 'matplotlib is not installed' in ended.err


def test_known_quantities_are_options(bag):
    known = ['--lever-arm', 0, 0, '--yaw-offset', 0, '--time-offset', 0, '--wheel-noise', 1e-5]
    known += ['--position-noise', 0.005, '--heading-noise', 0.01]
    out = run(bag, '-o', 'found.yaml', '--no-plot', *known).out
    assert 'x 0.0000 (given) m, y 0.0000 (given) m, yaw 0.0000 (given) rad' in out
    assert 'wheel travel variance 1e-05 m, reference 0.005 m and 0.01 rad' in out
    assert 'time offset' not in out


def test_the_picture_shows_both_paths_and_the_errors():
    driven = drive((3.0, 0.3, 0.5), (3.0, 0.3, -0.5), (3.0, 0.0, 1.0))
    plane, position, heading, residual = calibration_figure(calibrate([driven], NOMINAL)).axes
    labels = [text.get_text() for text in plane.get_legend().get_texts()]
    assert labels == ['odometry before', 'odometry after', 'reference', 'start']
    for panel in (position, heading):
        before, after = (np.nanmax(np.abs(one.get_ydata())) for one in panel.lines[:2])
        assert after < before / 1.5
    assert 'mm' in residual.get_ylabel()


def test_a_robot_of_this_package_is_calibrated_with_its_bag(lockstep, folder):
    """One with wrong wheels that slip. doc/calibration.md drives it again as calibrated."""
    wrong = {f'true_{name}': value for name, value in zip(PARAMETERS, TRUE, strict=True)}
    quiet = {'command_interface': 'wheels', 'cmd_vel_timeout': 0.0, 'publish_rate': 30.0}
    robot = make_complete(VirtualRobot, **quiet, **wrong, simulate_slip=True, slip_seed=5)
    with recorded(lockstep, folder / 'bag') as made:
        lockstep.add(robot)
        lockstep.add(make_complete(WheelBridge, cmd_vel_timeout=0.0))
        made.look()
        for duration, v, omega in umbmark(side=0.6, speed=0.5, turn=2.0):
            lockstep.publish('cmd_vel', twist(v, omega))
            lockstep.run_for(duration)
    read = read_wheels_and_reference(folder / 'bag')
    assert (read.reference_topic, read.dimensions) == ('/ground_truth', (0.033, 0.16))
    assert_true(calibrate([read.recording], NOMINAL))
    own = calibrate([read_wheels_and_reference(folder / 'bag', reference='odom').recording], NOMINAL)
    np.testing.assert_allclose(own.multipliers, 1.0, atol=1e-4)
    assert (deviations(own) < 1e-3).all()


# --- What is read


def same(found, expected, **tolerance):
    """Check that recordings hold the same."""
    for name in ('wheel_time', 'wheel_angles', 'pose_time', 'poses'):
        values = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(*values, err_msg=name, **tolerance)


@pytest.mark.parametrize('kind', [PoseWithCovarianceStamped, Odometry])
def test_each_type_of_reference_gives_the_same_and_missing_messages_are_counted(folder, kind):
    expected = read_wheels_and_reference(write(folder / 'bag'))
    assert expected.reference_topic == '/mocap/pose'
    other = write(folder / 'other', kind=kind, topic='/ground_truth')
    count_more(other, '/joint_states', 7)
    found = read_wheels_and_reference(other)
    assert found.reference_topic == '/ground_truth'
    assert found.notes == ('401 messages on /joint_states were found, the bag should have 408',)
    same(found.recording, expected.recording, rtol=0.0)


def test_bad_messages_are_skipped_and_counted_and_odd_ones_give_the_same(folder):
    """UTM coordinates, angles within a turn, joints of others, messages twice and in another order."""
    expected = read_wheels_and_reference(write(folder / 'bag')).recording
    sent = []
    bad = of_topic(bag_messages(SHORT), '/mocap/pose')[20:23]
    for index, (time, topic, message) in enumerate(bag_messages(SHORT)):
        if topic == '/mocap/pose':
            message.pose.position.x += math.nan if message in bad else 5e5
            message.pose.position.y += 5.4e6
        else:
            angles = [float(np.angle(np.exp(1j * one))) for one in message.position]
            message.name, message.position = ['arm', *message.name], [0.1, *angles]
            message.velocity = []
            if index % 10 == 0:
                other = JointState(header=message.header, name=['gripper'], position=[0.0])
                sent += [(time, topic, message), (time, topic, other)]
        # Received late, and so in another order than that of the stamps.
        sent.append((time + 0.1 * (index % 7 == 0), topic, message))
    read = read_wheels_and_reference(write(folder / 'odd', sorted(sent, key=lambda one: one[0])))
    note = '3 of 27 messages on /mocap/pose hold invalid or implausible values and were skipped'
    assert note in ' '.join(read.notes)
    kept = np.delete(np.arange(len(expected.pose_time)), slice(20, 23))
    turns = np.round((expected.wheel_angles - read.recording.wheel_angles)[0] / math.tau) * math.tau
    expected = replace(
        expected,
        pose_time=expected.pose_time[kept],
        poses=expected.poses[kept] + [5e5, 5.4e6, 0.0],
        wheel_angles=expected.wheel_angles - turns,
    )
    same(read.recording, expected, rtol=0.0, atol=3e-9)


def test_wheels_are_those_given_those_of_the_parameters_or_those_with_such_names():
    joints = ('a', 'b', 'left_wheel', 'right_wheel')
    bridge = {'left_wheel_name': 'a', 'right_wheel_name': 'b'}
    controller = {'left_wheel_names': ['b'], 'right_wheel_names': ['a']}
    for there, given, parameters, expected in (
        (joints, ('b', 'left_wheel'), bridge, ('b', 'left_wheel')),
        (joints, None, bridge, ('a', 'b')),
        (joints, None, controller, ('b', 'a')),
        (joints[2:], None, bridge, ('left_wheel', 'right_wheel')),
    ):
        found = wheel_names('run', '/joint_states', there, given, {'node': parameters})
        assert found == expected


# --- Mistakes


def test_straight_and_short_drives_are_refused_in_words(folder):
    straight = drive((1.0, 0.0, 0.0), (10.0, 0.4, 0.0), (1.0, 0.0, 0.0), seed=3)
    write(folder / 'straight', bag_messages(straight))
    out, message = failed('straight')
    assert 'does not determine the wheel separation: turn in place' in message
    assert 'Nothing was written' in message
    assert 'left_wheel_radius_multiplier' in out
    write(folder / 'short', bag_messages(drive((1.0, 0.2, 0.5))))
    assert 'too short' in failed('short')[1]
    assert left(folder) == ['short', 'straight']


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--reference', 'nothing'], ['no topic /nothing', '/mocap/pose']),
        (['--reference', 'joint_states'], ['must be of type nav_msgs/msg/Odometry']),
        (['--wheels-topic', '/mocap/pose'], ['must be of type sensor_msgs/msg/JointState']),
        (['--wheels', 'left', 'right'], ["no joint 'left'", JOINTS[0]]),
        (['--wheels', JOINTS[0], JOINTS[0]], ['both wheels', JOINTS[0]]),
        (['--wheel-radius', '50'], ['wheel radius must be in [0.001, 10] m, got 50.0']),
        (['-o', 'found.txt'], ['must end in .yaml']),
        (['--heading-noise', 'nan'], ['must be finite, got nan']),
        (['--yaw-offset', '90'], ['must be in radians']),
        (['bag'], ['each bag can be given once']),
    ],
)
def test_wrong_arguments(folder, arguments, words):
    write(folder / 'bag')
    message = refused('bag', *arguments)
    assert all(word in message for word in words), message
    assert left(folder) == ['bag']


SENT = bag_messages(SHORT)
TWO = sorted([*SENT, *bag_messages(SHORT, topic='/slam')], key=lambda one: one[0])
DIFFERENT = {**DIMENSIONS, '/other': {'wheel_radius': 0.05, 'wheel_separation': 0.3}}


@pytest.mark.parametrize(
    ('how', 'words'),
    [
        ({'sent': [one for one in SENT if one[1] != '/mocap/pose']}, ['no topic ground_truth']),
        ({'sent': [one for one in SENT if one[1] == '/mocap/pose']}, ['no topic joint_states']),
        ({'sent': TWO}, ['several such topics, /mocap/pose, /slam: choose one with --reference']),
        # Odometry is no reference unless it is chosen.
        ({'kind': Odometry, 'topic': '/odom'}, ['no topic ground_truth', '/odom (nav_msgs/msg/Od']),
        ({'parameters': None}, ['--wheel-radius and --wheel-separation']),
        ({'parameters': DIFFERENT}, ['0.033 and 0.16 m, 0.05 and 0.3 m']),
    ],
    ids=['no reference', 'no wheels', 'two', 'odometry', 'unknown', 'different'],
)
def test_topics_and_dimensions_must_be_known_and_unique(folder, how, words):
    message = refused(write(folder / 'bag', **how))
    assert all(word in message for word in words), message


def of_topic(sent, name):
    return [message for _, topic, message in sent if topic == name]


def change(sent, what):
    """Change the messages of a bag."""
    poses, wheels = of_topic(sent, '/mocap/pose'), of_topic(sent, '/joint_states')
    if what == 'frames':
        poses[3].header.frame_id = 'map'
    elif what == 'y up':
        for message in poses:
            place = message.pose.position
            place.y, place.z = 0.0, place.x
    elif what == 'NaN':
        for message in poses:
            message.pose.position.x = np.nan
    elif what == 'clock reset':
        for message in poses[10:]:
            message.header.stamp.sec -= 50
    elif what == 'counter reset':
        for message in wheels[100:]:
            message.position = [one - 50.0 for one in message.position]
    elif what == 'names':
        for message in wheels:
            message.name = ['a', 'b']


@pytest.mark.parametrize(
    ('what', 'words'),
    [
        ('frames', ['in several frames', "'map'", "'mocap'"]),
        ('y up', ['not that of a floor with z up']),
        ('NaN', ['no usable message on /mocap/pose', 'invalid or implausible values']),
        ('clock reset', ['goes back in time by 49.', 'its clock was reset']),
        ('counter reset', ['jumps by 49.', 'its counter was reset']),
        ('names', ['--wheels LEFT RIGHT', "'a'", "'b'"]),
    ],
)
def test_faults_of_a_bag_are_named(folder, what, words):
    sent = bag_messages(SHORT)
    change(sent, what)
    message = refused(write(folder / 'bag', sent))
    assert all(word in message for word in words), message
    assert left(folder) == ['bag']


def test_nothing_stays_if_the_picture_cannot_be_written(bag, folder, monkeypatch):
    monkeypatch.setattr(calibrate_run._output, 'drawn', lambda *_: bytes(1 << 20))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, limits[1]))
    try:
        message = failed(bag, '-o', 'found.yaml')[1]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert 'found.png cannot be written: File too large; nothing was written' in message
    assert left(folder) == []
