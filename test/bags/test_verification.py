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

"""Verification: a run driven again moves as it did, and what was altered is found, with its place."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from std_srvs.srv import Trigger
from support.bags import REAL
from support.lockstep_nodes import change
from support.lockstep_nodes import make_complete as make
from support.recorded import recorded
from support.ros_messages import goal, goals, placement, twist
from support.runs import built_run, series

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags.recorded_robot import start_covariances
from diffdrive_jacobian.bags.verification import (
    COVARIANCE_TOLERANCE,
    largest_covariance_difference,
    verify,
)
from diffdrive_jacobian.faults import ActuatorLag, DeadWheel, Loss, SaturatedWheel, TimeJump
from diffdrive_jacobian.messages.codecs import Changes
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.simulation.robot import Robot
from diffdrive_jacobian.simulation.robot_model import RobotModel
from diffdrive_jacobian.testing import Lockstep
from diffdrive_jacobian.testing.recorded_run import RecordedRun
from diffdrive_jacobian.tools import verify_run

pytestmark = pytest.mark.slow
EXACT = 1e-9
NOTHING = slice(0, 0)
COUNT = 100
"""Odometry messages of a drive."""
LIMITS = {'linear__x__max_velocity': 0.1, 'angular__z__max_velocity': 0.5, 'max_wheel_velocity': 3.0}
ROBOTS = {
    'twist': {},
    'wheels': {'command_interface': 'wheels'},
    'limits': {**LIMITS, 'publish_rate': 333.0, 'x': 4.0, 'y': -1.0, 'theta': 2.0},
}


def verified(run, tolerance=EXACT):
    """Verify a run, which must hold within a tolerance; return what was found."""
    verification = verify(run)
    assert verification.holds(tolerance, tolerance), (
        verification.distances.max(),
        verification.headings.max(),
        verification.missing,
    )
    return verification


def kept(run, **which):
    """Return a run with some of its messages only: the indices are given by the name of a series."""
    changes = {}
    for name, index in which.items():
        one = getattr(run, name)
        changes[name] = replace(
            one, received=one.received[index], stamps=one.stamps[index], values=one.values[index]
        )
        if name == 'odometry':
            changes['odometry_covariances'] = run.odometry_covariances[index]
    return replace(run, **changes)


@pytest.fixture(scope='module')
def drives(tmp_path_factory):
    """Return a function that drives a robot to two waypoints, once for each name."""

    @cache
    def drive(name):
        parameters = ROBOTS[name]
        with Lockstep() as world:
            world.add(make(VirtualRobot, **parameters))
            if name == 'wheels':
                world.add(make(WheelBridge))
            world.add(make(GoToGoal))
            with recorded(world, tmp_path_factory.mktemp('runs') / 'run') as made:
                world.publish('goals', goals(goal(0.5, 0.2), goal(-0.3, 0.4)))
                world.run_for(COUNT / parameters.get('publish_rate', 50.0))
        return made.run

    return drive


@pytest.fixture
def run(drives):
    """The run of a robot without limits. Tests share it and change copies only."""
    return drives('twist')


@pytest.fixture
def recording(lockstep, tmp_path):
    """Record what the nodes do within a block."""
    return partial(recorded, lockstep, tmp_path / 'run')


@pytest.fixture
def command(lockstep):
    """A function that publishes a command, and then lets time pass."""

    def command(v, omega, seconds=0.0):
        lockstep.publish('cmd_vel', twist(v, omega))
        if seconds:
            lockstep.run_for(seconds)

    return command


@pytest.fixture
def driven(lockstep, recording, command):
    """A function that records while a robot gets commands, each for some seconds; returns the run."""

    def drive(commands, seconds, rest=0.0):
        with recording() as made:
            made.look()
            for v, omega in commands:
                command(v, omega, seconds)
            if rest:
                lockstep.run_for(rest)
        return made.run

    return drive


# --- What is driven again exactly


@pytest.mark.parametrize('name', ROBOTS)
def test_a_run_is_driven_again_exactly(drives, name):
    run = drives(name)
    verification = verified(run)
    assert (verification.source, verification.start) == ('cmd_vel_out', 'start_pose')
    assert len(verification.seconds) == len(run.odometry) > COUNT - 10
    assert np.ptp(run.odometry.values[:, 0]) > (0.01 if name == 'limits' else 0.2)
    if name != 'limits':
        # Without cmd_vel_out the commands are taken by their recording.
        verification = verified(kept(run, cmd_vel_out=NOTHING))
        assert verification.source == ('joint_command' if name == 'wheels' else 'cmd_vel')
        assert verification.start == 'odometry'


@pytest.mark.parametrize('slip', [False, True])
def test_placements_resets_timeouts_and_parameters_are_driven_again(
    lockstep, robot_at, recording, command, slip
):
    robot = robot_at(cmd_vel_timeout=0.15, simulate_slip=slip)
    with recording() as made:
        made.look()
        command(0.5, 1.0, 0.5)
        command(-0.5, 2.0, 0.1)
        lockstep.publish('initialpose', placement(3.0, 3.0, -2.0, variances=(0.04, 0.04, 0.04)))
        command(-0.4, 1.5, 0.3)
        # The next placement notices the timeout, which took effect since the last odometry.
        command(0.3, -1.0, 0.155)
        lockstep.publish('initialpose', placement(3.0, 3.0, -2.0))
        lockstep.run_for(0.045)
        command(1.0, 0.1)
        change(robot, linear__x__max_velocity=0.2)
        lockstep.run_for(0.1)
        lockstep.call(Trigger, 'reset_odometry')
        lockstep.run_for(0.3)
    run = made.run
    assert len(run.start_pose) == 4
    assert run.parameter_events[-1][1].values == {'linear.x.max_velocity': 0.2}
    assert run.odometry_covariances[:, 5].max() > 0.04
    verification = verified(run)
    assert verification.covariance_difference <= COVARIANCE_TOLERANCE
    assert (verification.truth is not None) == slip


def test_changes_of_the_dynamics_are_driven_again(lockstep, robot_at, recording, command):
    robot = robot_at(linear__x__max_acceleration=0.4, command_delay=0.13)
    with recording() as made:
        made.look()
        for v, changes in (
            (0.3, {'wheel_lag': 0.1}),
            (-0.2, {'linear__x__max_acceleration': 0.9, 'linear__x__max_deceleration': -0.3}),
            (0.5, {'command_delay': 0.31, 'cmd_vel_timeout': 0.2}),
            (0.4, {'command_delay': 0.0, 'wheel_lag': 0.0}),
            (-0.3, {'linear__x__max_acceleration': math.nan}),
            (0.3, {'max_wheel_acceleration': 9.0, 'wheel_radius': 0.04}),
            (0.9, {'linear__x__max_acceleration': 2.0, 'command_delay': 0.2}),
        ):
            command(v, 0.7, 0.07)
            change(robot, **changes)
            lockstep.run_for(0.0313)
            # At the time of a command.
            command(-v, 0.5)
            change(robot, angular__z__max_acceleration=2.0 + v)
            command(v, -0.5, 0.1)
    run = made.run
    assert len(run.parameter_events) >= 12
    verification = verified(run, 1e-12)
    assert (verification.source, verification.start) == ('cmd_vel_out', 'start_pose')
    assert verify(replace(run, parameter_events=())).distances.max() > 0.01
    without = verify(replace(run, parameters={}, parameter_events=()))
    assert without.distances.max() > 0.01
    assert 'cannot be reproduced without them' in without.notes[-1]


def test_faults_of_the_motors_are_driven_again(lockstep, robot_at, driven):
    robot_at(linear__x__max_acceleration=0.5, wheel_lag=0.05)
    lockstep.inject(
        ActuatorLag(0.2, start=0.1, duration=0.5),
        DeadWheel('left', start=0.3, duration=0.5),
        SaturatedWheel('right', 3.5, start=0.2, duration=0.8),
        # At the end of the first one.
        ActuatorLag(0.1, start=0.6),
    )
    run = driven([(0.3, (-1) ** number) for number in range(6)], 0.2)
    verified(run, 1e-12)
    of_another = tuple(
        (at, event._replace(arguments={**event.arguments, 'robot': '/b'}))
        for at, event in run.fault_events
    )
    assert verify(replace(run, fault_events=of_another)).distances.max() > 0.01
    without = verify(replace(run, fault_events=()))
    assert without.distances.max() > 0.01
    assert '/fault_events must be recorded' in without.notes[-1]
    with pytest.raises(BagError, match=r'it lacks start_pose .* does not come to a known state'):
        verify(kept(run, start_pose=NOTHING))


@pytest.mark.parametrize('limits', [{}, {'linear__x__max_acceleration': 0.5}, {'simulate_slip': True}])
def test_a_robot_that_is_started_again_while_it_moves_is_followed(
    lockstep, robot_at, recording, command, limits
):
    robot = robot_at(**limits)
    with recording() as made:
        made.look()
        command(0.3, 0.7, 0.5)
        lockstep.remove(robot)
        lockstep.run_for(0.1)
        robot_at(**limits)
        made.look()
        lockstep.run_for(0.2)
        command(-0.2, 0.7, 0.3)
    assert len(made.run.start_pose) == 2
    verified(made.run)


def test_time_that_goes_back_is_followed(lockstep, robot_at, command, tmp_path):
    robot_at()
    whole = RecordedRun(lockstep, tmp_path)
    lockstep.inject(TimeJump(-0.3, start=0.5))
    for v, omega in ((0.5, 1.0), (0.2, -0.5), (0.4, 0.1)):
        command(v, omega, 0.3)
    run = read_run(whole.finish())
    assert len(run.odometry.back) == 1
    assert len(verified(run).seconds) == len(run.odometry)
    before = run.cmd_vel_out.received <= run.odometry.received[run.odometry.back[0]]
    stood = verify(kept(run, cmd_vel_out=before))
    assert stood.distances[:20].max() < EXACT
    assert stood.distances[-1] > 0.01


def test_messages_that_are_there_twice_do_not_turn_back_time(run):
    twice = np.repeat(np.arange(len(run.odometry)), 2)
    assert len(verified(kept(run, odometry=twice)).seconds) == len(twice)


def test_placements_are_followed_by_the_time_of_recording(lockstep, robot_at, recording, command):
    robot_at()
    with recording() as made:
        command(0.0, 0.0)
        made.look()
        command(0.3, 0.7, 0.3)
        lockstep.publish('initialpose', PoseWithCovarianceStamped())
        lockstep.run_for(0.1)
        command(0.3, 0.7, 0.2)
    run = kept(made.run, cmd_vel_out=NOTHING)
    verified(run, 0.02)
    # Of a robot that moves already.
    verified(kept(run, odometry=slice(4, None), cmd_vel=slice(1, None)), 0.02)


def test_parameters_that_a_robot_reports_are_used_by_the_time_of_recording(run):
    (name,) = [node for node in run.parameters if node.endswith('virtual_robot')]
    by_time = kept(run, cmd_vel_out=NOTHING)
    # Of a robot that starts later than the recorder, and of one that drives.
    for at in (run.cmd_vel.received[0] - 1, run.odometry.received[50]):
        slow = Changes(name, {'linear.x.max_velocity': 0.05}, int(at))
        found = verify(replace(by_time, parameter_events=((int(at), slow),)))
        before = run.odometry.received < at
        assert (found.distances[before[-len(found.distances) :]] < 0.02).all()
        assert found.distances.max() > 0.05


def test_a_bag_of_ros2_bag_record_is_verified_against_our_robot():
    run = read_run(REAL)
    verification = verified(run, 0.02)
    # That robot integrates by midpoints at 100 Hz; the true times of its commands are not known.
    assert 1e-4 < verification.distances.max() < 2e-3
    assert not verify(run, {'linear.x.max_velocity': 0.05}).holds(0.02, 0.02)


# --- Recordings that begin late


@pytest.mark.parametrize('slip', [False, True])
def test_the_start_counts_if_the_robot_stood_until_the_first_odometry(
    lockstep, robot_at, recording, command, slip
):
    """As where nodes spin long after they were created."""
    robot_at(x=0.3, theta=0.7, simulate_slip=slip)
    lockstep.run_for(0.5)
    with recording() as made:
        lockstep.run_for(0.1)
        command(0.1, 0.9, 0.7)
    run = made.run
    verification = verified(run)
    assert verification.start == 'start_pose'
    assert verification.covariance_difference <= COVARIANCE_TOLERANCE
    assert (verification.truth is not None) == slip
    assert not any('ground_truth was not compared' in note for note in verification.notes)
    assert verified(kept(run, odometry=slice(20, None))).start == 'odometry'


def test_a_start_that_does_not_fit_the_odometry_is_a_difference(lockstep, robot_at, recording, command):
    """Although the first odometry comes as late as in a process that has just started."""
    robot_at(x=0.3)
    lockstep.run_for(0.2)
    with recording() as made:
        lockstep.run_for(0.1)
        command(0.1, 0.9, 0.4)
    run = made.run
    assert verified(run).start == 'start_pose'
    wider = run.start_covariances + np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])
    moved = run.odometry.values + np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    for changes in (
        {'start_pose': replace(run.start_pose, values=run.start_pose.values + 1.0)},
        {'start_covariances': wider},
        {'odometry': replace(run.odometry, values=moved)},
        {'odometry_covariances': np.full_like(run.odometry_covariances, 7.0)},
    ):
        assert not verify(replace(run, **changes)).agrees(EXACT, EXACT), changes


def test_after_a_reset_of_odometry_the_truth_has_no_known_start(lockstep, robot_at, recording, command):
    robot_at(simulate_slip=True, cmd_vel_timeout=0.1)
    command(0.3, -0.7, 0.5)
    lockstep.call(Trigger, 'reset_odometry')
    lockstep.run_for(0.2)
    with recording() as made:
        lockstep.run_for(0.1)
        command(0.1, 0.9, 0.3)
    verification = verified(made.run)
    assert (verification.start, verification.truth) == ('odometry', None)
    assert any('ground_truth was not compared' in note for note in verification.notes)


@pytest.mark.parametrize('missed', [1, 10])
def test_missed_first_commands_do_not_blame_the_robot(run, missed):
    found = verified(kept(run, cmd_vel_out=slice(missed, None)))
    assert any('moved before the first command that was recorded' in note for note in found.notes)
    assert found.start == 'odometry'
    assert len(found.distances) >= len(run.odometry) - missed - 20
    assert not any('before the first command' in note for note in verified(run).notes)


TAKES_TIME = {
    'at once': {},
    'ramps': {'linear__x__max_acceleration': 0.5},
    'lag': {'wheel_lag': 0.1},
    'ramps, delay': {'linear__x__max_acceleration': 0.5, 'command_delay': 0.053},
    'all': {'linear__x__max_acceleration': 5.0, 'command_delay': 0.053, 'wheel_lag': 0.002},
}


@pytest.mark.parametrize('name', TAKES_TIME)
def test_a_late_recorder_does_not_blame_a_robot_that_takes_time(robot_at, driven, name):
    robot_at(**TAKES_TIME[name])
    run = driven([(0.1, 0.5), (0.3, -0.5), (0.0, 0.4), (-0.2, 0.1), (0.2, 0.0)], 0.23, rest=0.3)
    begun = run.odometry.received[0]
    # Seconds until the odometry and the commands are recorded.
    for odometry, commands in ((0.0, 0.5), (0.4, 0.4), (0.31, 0.7)):
        since = {'odometry': odometry, 'wheels': odometry, 'cmd_vel_out': commands}
        late = kept(
            run,
            **{name: getattr(run, name).received >= begun + at * 1e9 for name, at in since.items()},
        )
        # The latched start arrives after the odometry.
        received = np.maximum(run.start_pose.received, begun + int(odometry * 1e9) + 10**8)
        late = replace(late, start_pose=replace(run.start_pose, received=received))
        found = verified(replace(late, odometry_covariances=np.empty((0, 9))))
        assert len(found.distances) > 10
        assert found.start == 'odometry'


# --- What was altered or is missing


def test_what_was_altered_is_found_with_its_place(run):
    odometry, commands = run.odometry, run.cmd_vel_out
    seconds = (commands.stamps - odometry.stamps[0]) / 1e9
    gap = verify(kept(run, cmd_vel_out=(seconds < 0.5) | (seconds > 1.0)))
    assert not gap.holds(EXACT, EXACT)
    assert 0.5 <= gap.seconds[np.flatnonzero(gap.distances > EXACT)[0]] <= 0.6
    for column, differences in enumerate(('distances', 'distances', 'headings', 'speeds', 'turn_rates')):
        altered = odometry.values.copy()
        altered[73, column] += 1e-3
        found = verify(replace(run, odometry=replace(odometry, values=altered)))
        assert not found.agrees(EXACT, EXACT)
        assert getattr(found, differences)[73] == pytest.approx(1e-3)
        assert np.delete(getattr(found, differences), 73).max() < EXACT
        assert found.seconds[73] == pytest.approx((odometry.stamps[73] - odometry.stamps[0]) / 1e9)
    for column in (3, 4):
        altered = odometry.values.copy()
        altered[50, column] = math.nan
        assert not verify(replace(run, odometry=replace(odometry, values=altered))).agrees(EXACT, EXACT)
    forged = run.odometry_covariances.copy()
    forged[40, 3] *= 1.0 + 1e-6
    found = verify(replace(run, odometry_covariances=forged))
    assert found.covariance_difference > COVARIANCE_TOLERANCE
    assert not found.agrees(EXACT, EXACT)


@pytest.mark.parametrize(
    ('name', 'which', 'words'),
    [
        ('odometry', 40, r'odom at 0\.800 s, when the robot published the others'),
        ('odometry', -1, r'odom at \d'),
        ('odometry', slice(60), r'odom at .* and \d\d more, when'),
        ('wheels', 40, r'joint_states at 0\.800 s'),
        ('wheels', slice(40, None), r'joint_states at .* and \d\d more, when'),
        ('wheels', slice(60), r'joint_states at .* and \d\d more, when'),
        ('start_pose', 0, 'start_pose: where the odometry began is not verified'),
    ],
)
def test_messages_that_are_missing_are_named(run, name, which, words):
    found = verify(kept(run, **{name: np.delete(np.arange(len(getattr(run, name))), which)}))
    assert found.agrees(EXACT, EXACT)
    assert not found.holds(EXACT, EXACT)
    (missing,) = found.missing
    assert re.match(words, missing)


def test_the_tool_fails_if_messages_are_missing(run, capsys, monkeypatch):
    whole, part = run, kept(run, odometry=np.delete(np.arange(len(run.odometry)), 40))
    for read, code, words in (
        (whole, 0, 'moves as recorded'),
        (part, 1, 'NOT verified: what was recorded'),
    ):
        monkeypatch.setattr(verify_run, 'read_run', lambda *_, read=read, **__: read)
        assert verify_run.main(['run'], Signals()) == code
        assert words in capsys.readouterr().out


def test_messages_that_were_skipped_or_lost_are_missing(run):
    for changes in ({'skipped': {'/odom': 1}}, {'missing': {'/cmd_vel_out': 2}}):
        (missing,) = verify(replace(run, **changes)).missing
        assert re.match(r'[12] messages on /(odom|cmd_vel_out)', missing)
    # The goals do not matter.
    verified(replace(run, skipped={'/goals': 1}))


@pytest.mark.parametrize('topics', [('odom',), ('odom', 'joint_states')])
def test_what_a_fault_loses_is_not_missing(lockstep, robot_at, driven, topics):
    robot_at()
    lockstep.inject(*(Loss(topic, 0.3) for topic in topics))
    run = driven([(0.3, 0.5)], 1.0)
    assert len(run.odometry) < 45
    if 'joint_states' in topics:
        assert len(run.wheels) < 45
        # As of a robot that drifts, so that it publishes a third message with these two.
        run = replace(run, ground_truth=run.odometry)
    notes = verified(run).notes
    assert any('missing messages of odom were not looked for' in note for note in notes)


# --- What cannot be verified


def still(count=100, begin=10**9, step=10**8, **keywords):
    """Return the odometry of a robot that stands."""
    return series('odometry', begin + step * np.arange(count), np.zeros((count, 5)), **keywords)


def test_runs_that_cannot_be_verified_say_why(run):
    odometry, standing = run.odometry, still()
    back = replace(odometry, stamps=odometry.stamps - 10**9 * (np.arange(len(odometry)) % 2))
    clock_stopped = replace(odometry, received=0 * odometry.received)
    early = series('cmd_vel', standing.stamps, np.full((100, 2), 0.5))
    other_clock = replace(standing, received=standing.received + 10**18)
    last = standing.stamps[-1:] + 1
    for given, words in (
        (kept(run, odometry=NOTHING), 'no odometry'),
        (replace(run, odometry=clock_stopped), 'clock of the recorder stood still'),
        (replace(run, odometry=back), 'record without use_sim_time'),
        (kept(run, cmd_vel_out=NOTHING, cmd_vel=NOTHING), 'no commands: record cmd_vel_out, or cmd_vel'),
        (
            built_run(odometry=other_clock, cmd_vel=early),
            'another clock than the stamps of the odometry',
        ),
        *(
            (
                built_run(odometry=standing, **{topic: series(topic, last, [[0.5, 0.3]])}),
                f'no odometry after the first command on {topic}',
            )
            for topic in ('cmd_vel', 'cmd_vel_out')
        ),
    ):
        with pytest.raises(BagError, match=words):
            verify(given)


def test_odometry_before_the_commands_is_not_compared():
    odometry = still()
    commands = series('cmd_vel', odometry.stamps[40:], np.zeros((60, 2)))
    verification = verify(built_run(odometry=odometry, cmd_vel=commands))
    assert len(verification.seconds) == 61
    assert verification.notes == (
        'the velocities were not compared: when each command took effect is in cmd_vel_out',
        '39 of 100 odometry messages precede the start of the simulated robot and were not compared',
    )
    stamps = [*(odometry.stamps[:3] - 10**9), *odometry.stamps]
    commands = series('cmd_vel', stamps, [[1.0, 0.0]] * 3 + [[0.0, 0.0]] * 100)
    assert verify(built_run(odometry=odometry, cmd_vel=commands)).holds(0.0, 0.0)


# --- The covariance


def test_without_the_robot_or_its_start_the_covariances_are_not_compared(run):
    assert verified(replace(run, parameters={})).covariance_difference is None
    without_start = kept(run, start_pose=NOTHING)
    assert verify(without_start).covariance_difference is None
    # Any other robot has none.
    verified(replace(without_start, parameters={}))


def test_covariances_are_compared_in_units_of_their_standard_deviations():
    robot = Robot(model=RobotModel(), stamp=0, pose=np.zeros(3), covariance=np.zeros((3, 3)))
    now = robot.commanded((0.2, 0.1), 0).at(1_000_000_000)
    recorded = np.array([now.moments[:6]])
    for factor, exact in ((1.0 + 1e-11, True), (1.0 + 1e-8, False)):
        difference = largest_covariance_difference([now], factor * recorded)
        assert (difference <= COVARIANCE_TOLERANCE) == exact


def test_an_invalid_covariance_of_a_start_is_zero():
    entries = np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 1.0], [1.0, 5.0, 0.0, 1.0, 0.0, 1.0]])
    found = start_covariances(SimpleNamespace(start_covariances=entries, start_pose=[0, 1]))
    np.testing.assert_array_equal(found, [np.eye(3).ravel(), np.zeros(9)])
