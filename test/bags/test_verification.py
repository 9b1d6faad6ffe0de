"""Verification: a run driven again moves as it did, and what was altered is found, with its place."""

from __future__ import annotations

import math
import re
from dataclasses import fields, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from std_srvs.srv import Trigger
from support.bags import REAL
from support.lockstep_nodes import change
from support.lockstep_nodes import make_complete as make
from support.recorded import recorded
from support.ros_messages import goal, goals, twist, twist_stamped
from support.runs import built_run, series

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags.recorded_robot import start_covariances
from diffdrive_jacobian.bags.run import Series
from diffdrive_jacobian.bags.verification import (
    COVARIANCE_TOLERANCE,
    largest_covariance_difference,
    verify,
)
from diffdrive_jacobian.faults import ActuatorLag, DeadWheel, Loss, SaturatedWheel
from diffdrive_jacobian.messages.codecs import Changes
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.simulation.robot import Robot
from diffdrive_jacobian.simulation.robot_model import RobotModel
from diffdrive_jacobian.testing import Lockstep

EXACT = 1e-9


def held(run, tolerance=EXACT):
    """Verify a run within a tolerance; return what was found."""
    verification = verify(run)
    assert verification.holds(tolerance, tolerance), (
        verification.distances.max(),
        verification.headings.max(),
    )
    return verification


def rows(series, keep):
    return replace(
        series, received=series.received[keep], stamps=series.stamps[keep], values=series.values[keep]
    )


NOTHING = slice(0, 0)
COUNT = 100
"""Odometry messages of a drive."""
LIMITS = {'linear__x__max_velocity': 0.1, 'angular__z__max_velocity': 0.5, 'max_wheel_velocity': 3.0}
ROBOTS = {
    'twist': {},
    'wheels': {'command_interface': 'wheels'},
    'limits': {**LIMITS, 'publish_rate': 333.0, 'x': 4.0, 'y': -1.0, 'theta': 2.0},
}


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
        # Tests share it.
        for field in fields(made.run):
            value = getattr(made.run, field.name)
            is_series = isinstance(value, Series)
            for array in (value.received, value.stamps, value.values) if is_series else (value,):
                if isinstance(array, np.ndarray):
                    array.setflags(write=False)
        return made.run

    return drive


@pytest.fixture
def run(drives):
    """The run of a robot without limits, which is not changed."""
    return drives('twist')


@pytest.fixture
def driven(lockstep, tmp_path):
    """A function that records while a robot gets commands, each for some seconds; returns the run."""

    def drive(commands, seconds, rest=0.0):
        with recorded(lockstep, tmp_path / 'run') as made:
            made.look()
            for v, omega in commands:
                lockstep.publish('cmd_vel', twist(v, omega))
                lockstep.run_for(seconds)
            if rest:
                lockstep.run_for(rest)
        return made.run

    return drive


@pytest.mark.parametrize('name', ROBOTS)
def test_a_run_is_driven_again_exactly(drives, name):
    run = drives(name)
    verification = held(run)
    assert (verification.source, verification.start) == ('cmd_vel_out', 'start_pose')
    assert len(verification.seconds) == len(run.odometry) > COUNT - 10
    assert np.ptp(run.odometry.values[:, 0]) > (0.01 if name == 'limits' else 0.2)
    if name != 'limits':
        # Without cmd_vel_out the commands are taken by their recording.
        verification = held(replace(run, cmd_vel_out=rows(run.cmd_vel_out, NOTHING)))
        assert verification.source == ('joint_command' if name == 'wheels' else 'cmd_vel')
        assert verification.start == 'odometry'


def test_messages_that_are_there_twice_do_not_turn_back_time(run):
    twice = np.repeat(np.arange(len(run.odometry)), 2)
    run = replace(
        run, odometry=rows(run.odometry, twice), odometry_covariances=run.odometry_covariances[twice]
    )
    assert len(held(run).seconds) == len(twice)


def test_placements_resets_timeouts_and_parameters_are_driven_again(lockstep, robot_at, tmp_path):
    robot = robot_at(cmd_vel_timeout=0.15)
    with recorded(lockstep, tmp_path / 'run') as made:
        made.look()
        lockstep.publish('cmd_vel', twist(0.5, 1.0))
        lockstep.run_for(0.5)
        placed = PoseWithCovarianceStamped()
        placed.pose.pose = goal(3.0, 3.0, -2.0).pose
        lockstep.publish('cmd_vel', twist(-0.5, 2.0))
        lockstep.run_for(0.1)
        lockstep.publish('initialpose', placed)
        lockstep.run_for(0.3)
        lockstep.publish('cmd_vel', twist(0.3, -1.0))
        # The placement notices the timeout, which took effect since the last odometry.
        lockstep.run_for(0.155)
        lockstep.publish('initialpose', placed)
        lockstep.run_for(0.045)
        lockstep.publish('cmd_vel', twist(1.0, 0.1))
        change(robot, linear__x__max_velocity=0.2)
        lockstep.run_for(0.1)
        lockstep.call(Trigger, 'reset_odometry')
        lockstep.run_for(0.3)
    run = made.run
    assert len(run.start_pose) == 4
    assert run.parameter_events[-1][1].values == {'linear.x.max_velocity': 0.2}
    held(run)


def test_a_robot_that_takes_time_is_driven_again_with_its_parameters(robot_at, driven):
    robot_at(
        linear__x__max_acceleration=0.5,
        linear__x__max_deceleration=-0.8,
        angular__z__max_acceleration=2.0,
        wheel_lag=0.1,
        command_delay=0.05,
        max_wheel_acceleration=20.0,
    )
    run = driven(((0.5, 1.0), (-0.3, 1.0), (0.4, -2.0), (0.0, 0.0), (0.3, 0.3)), 0.23, rest=0.6)
    verification = held(run, 1e-12)
    assert (verification.source, verification.start) == ('cmd_vel_out', 'start_pose')
    assert verification.covariance_difference <= COVARIANCE_TOLERANCE
    without = verify(replace(run, parameters={}))
    assert without.distances.max() > 0.01
    assert 'cannot be reproduced without them' in without.notes[-1]
    with pytest.raises(BagError, match=r'it lacks start_pose .* does not come to a known state'):
        verify(replace(run, start_pose=rows(run.start_pose, NOTHING)))


def test_changes_of_the_dynamics_are_driven_again(lockstep, robot_at, tmp_path):
    robot = robot_at(linear__x__max_acceleration=0.4, command_delay=0.13)
    with recorded(lockstep, tmp_path / 'run') as made:
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
            lockstep.publish('cmd_vel', twist(v, 0.7))
            lockstep.run_for(0.07)
            change(robot, **changes)
            lockstep.run_for(0.0313)
            # At the time of a command.
            lockstep.publish('cmd_vel', twist(-v, 0.5))
            change(robot, angular__z__max_acceleration=2.0 + v)
            lockstep.publish('cmd_vel', twist(v, -0.5))
            lockstep.run_for(0.1)
    run = made.run
    assert len(run.parameter_events) >= 12
    held(run, 1e-12)
    assert verify(replace(run, parameter_events=())).distances.max() > 0.01


@pytest.mark.parametrize('limits', [{}, {'linear__x__max_acceleration': 0.5, 'wheel_lag': 0.05}])
def test_faults_of_the_motors_are_driven_again(lockstep, robot_at, driven, limits):
    robot_at(**limits)
    lockstep.inject(
        ActuatorLag(0.2, start=0.1, duration=0.5),
        DeadWheel('left', start=0.3, duration=0.5),
        SaturatedWheel('right', 3.5, start=0.2, duration=0.8),
        # At the end of the first one.
        ActuatorLag(0.1, start=0.6),
    )
    run = driven([(0.3, (-1) ** number) for number in range(6)], 0.2)
    held(run, 1e-12)
    other = {'robot': '/b'}
    of_another = tuple(
        (at, event._replace(arguments={**event.arguments, **other})) for at, event in run.fault_events
    )
    assert verify(replace(run, fault_events=of_another)).distances.max() > 0.01
    without = verify(replace(run, fault_events=()))
    assert without.distances.max() > 0.01
    assert '/fault_events must be recorded' in without.notes[-1]


def test_time_that_goes_back_is_followed(robot_at, driven):
    robot_at()
    run = driven([(0.5, 1.0)], 0.4)
    shifted = replace(run.odometry, stamps=run.odometry.stamps - 10**9)
    last = run.odometry.received[-1:]
    first, moving = run.odometry.values[:1, :3], run.odometry.values[:1, 3:]

    def joined(one, **other):
        return replace(
            one, **{name: np.concatenate([getattr(one, name), other[name]]) for name in other}
        )

    def again(twists):
        begun = shifted.stamps[:1]
        return replace(
            run,
            odometry=joined(
                run.odometry,
                received=run.odometry.received + 10**9,
                stamps=shifted.stamps,
                values=shifted.values,
            ),
            start_pose=joined(run.start_pose, received=last, stamps=begun, values=first),
            cmd_vel_out=joined(run.cmd_vel_out, received=last + 1, stamps=begun, values=twists),
        )

    assert len(held(again(moving)).seconds) == 2 * len(run.odometry)
    stood = verify(again(0.0 * moving))
    assert stood.distances[: len(run.odometry)].max() < EXACT
    assert stood.distances[-1] > 0.1


@pytest.mark.lockstep(start=100.0)
def test_late_stamped_commands_are_explained(lockstep, robot_at, tmp_path):
    robot_at(enable_stamped_cmd_vel=True)
    with recorded(lockstep, tmp_path / 'run') as made:
        for index in range(10):
            lockstep.run_for(0.05)
            late = lockstep.now - 30_000_000
            lockstep.publish('cmd_vel', twist_stamped(0.5, (-1) ** index, late))
    assert len(made.run.cmd_vel_out) == 10
    held(made.run)


@pytest.mark.parametrize('slip', [False, True])
def test_a_recording_that_begins_late_is_verified_from_its_first_odometry(
    lockstep, robot_at, tmp_path, slip
):
    """From its start if the robot stood until then, as where nodes spin long after they were created."""
    robot_at(x=0.3, theta=0.7, simulate_slip=slip)
    lockstep.run_for(0.5)
    with recorded(lockstep, tmp_path / 'run') as made:
        lockstep.run_for(0.1)
        lockstep.publish('cmd_vel', twist(0.1, 0.9))
        lockstep.run_for(0.7)
    verification = held(made.run)
    assert verification.start == 'start_pose'
    assert verification.covariance_difference <= COVARIANCE_TOLERANCE
    assert (verification.truth is not None) == slip
    driven = replace(made.run, odometry=rows(made.run.odometry, slice(20, None)))
    driven = replace(driven, odometry_covariances=made.run.odometry_covariances[20:])
    assert held(driven).start == 'odometry'


def test_after_a_reset_of_the_odometry_alone_the_truth_has_no_known_start(lockstep, robot_at, tmp_path):
    robot_at(simulate_slip=True, cmd_vel_timeout=0.1)
    lockstep.publish('cmd_vel', twist(0.3, -0.7))
    lockstep.run_for(0.5)
    lockstep.call(Trigger, 'reset_odometry')
    lockstep.run_for(0.5)
    with recorded(lockstep, tmp_path / 'run') as made:
        lockstep.run_for(0.1)
        lockstep.publish('cmd_vel', twist(0.1, 0.9))
        lockstep.run_for(0.3)
        lockstep.publish('initialpose', PoseWithCovarianceStamped())
        lockstep.run_for(0.1)
    verification = held(made.run)
    assert (verification.start, verification.truth) == ('odometry', None)
    assert len(made.run.start_pose) == 3
    assert len(verification.seconds) == len(made.run.odometry)


def test_what_was_altered_is_found_with_its_place(run):
    odometry = run.odometry
    commands = run.cmd_vel_out
    seconds = (commands.stamps - odometry.stamps[0]) / 1e9
    gap = verify(replace(run, cmd_vel_out=rows(commands, (seconds < 0.5) | (seconds > 1.0))))
    assert not gap.holds(EXACT, EXACT)
    first = gap.seconds[np.flatnonzero(gap.distances > EXACT)[0]]
    assert 0.5 <= first <= 0.6
    for column, differences in ((0, 'distances'), (1, 'distances'), (2, 'headings')):
        altered = odometry.values.copy()
        altered[73, column] += 1e-3
        found = verify(replace(run, odometry=replace(odometry, values=altered)))
        assert not found.holds(EXACT, EXACT)
        assert found.seconds[getattr(found, differences).argmax()] == pytest.approx(
            (odometry.stamps[73] - odometry.stamps[0]) / 1e9
        )
        assert getattr(found, differences).max() == pytest.approx(1e-3)


@pytest.mark.parametrize('missed', [1, 10])
def test_a_recorder_that_missed_the_first_commands_does_not_blame_the_robot(run, missed):
    late = replace(run, cmd_vel_out=rows(run.cmd_vel_out, slice(missed, None)))
    found = held(late)
    assert any('moved before the first command that was recorded' in note for note in found.notes)
    assert found.start == 'odometry'
    assert len(found.distances) >= len(run.odometry) - missed - 20
    assert not any('before the first command' in note for note in held(run).notes)


def test_a_bag_of_ros2_bag_record_is_verified_against_our_robot():
    run = read_run(REAL)
    verification = held(run, 0.02)
    # That robot integrates by midpoints at 100 Hz; the true times of its commands are not known.
    assert 1e-4 < verification.distances.max() < 2e-3
    slower = verify(run, {'linear.x.max_velocity': 0.05})
    assert not slower.holds(0.02, 0.02)


@pytest.mark.parametrize('column', [3, 4])
@pytest.mark.parametrize('factor', [1.01, 2.0, math.nan])
def test_velocities_are_compared(run, column, factor):
    values = run.odometry.values.copy()
    values[50, column] *= factor
    found = verify(replace(run, odometry=replace(run.odometry, values=values)))
    differences = (found.speeds, found.turn_rates)[column - 3]
    assert not found.agrees(EXACT, EXACT)
    assert not np.delete(differences, 50).any()
    assert found.distances.max() < EXACT


@pytest.mark.parametrize(
    ('name', 'index', 'words'),
    [
        ('odometry', 40, r'odom at 0\.800 s, when the robot published the others'),
        ('odometry', -1, 'odom at '),
        ('wheels', 40, 'joint_states at 0.800 s'),
        ('start_pose', 0, 'start_pose: where the odometry began is not verified'),
    ],
)
def test_a_message_that_is_missing_is_named(run, name, index, words):
    series = getattr(run, name)
    kept = np.delete(np.arange(len(series)), index)
    changes = {name: rows(series, kept)}
    if name == 'odometry':
        changes['odometry_covariances'] = run.odometry_covariances[kept]
    found = verify(replace(run, **changes))
    assert found.agrees(EXACT, EXACT)
    assert not found.holds(EXACT, EXACT)
    (missing,) = found.missing
    assert re.match(words, missing)


def test_messages_that_were_skipped_or_lost_are_missing(run):
    for changes in ({'skipped': {'/odom': 1}}, {'missing': {'/cmd_vel_out': 2}}):
        (missing,) = verify(replace(run, **changes)).missing
        assert re.match(r'[12] messages on /(odom|cmd_vel_out)', missing)
    # The goals do not matter.
    held(replace(run, skipped={'/goals': 1}))


def test_many_messages_that_are_missing_at_the_beginning_or_the_end_are_named(run):
    for name, kept in (
        ('odometry', slice(60, None)),
        ('wheels', slice(0, 40)),
        ('wheels', slice(60, None)),
    ):
        changes = {name: rows(getattr(run, name), kept)}
        covariances = run.odometry_covariances[kept if name == 'odometry' else slice(None)]
        topic = 'odom' if name == 'odometry' else 'joint_states'
        (missing,) = verify(replace(run, **changes, odometry_covariances=covariances)).missing
        assert re.match(rf'{topic} at .* and \d\d more, when', missing)


@pytest.mark.parametrize('what', ['start', 'odometry', 'covariance', 'covariances'])
def test_a_start_that_does_not_fit_the_odometry_is_a_difference(lockstep, robot_at, tmp_path, what):
    """Although the first odometry comes as late as in a process that has just started."""
    robot_at(x=0.3)
    lockstep.run_for(0.2)
    with recorded(lockstep, tmp_path / 'run') as made:
        lockstep.run_for(0.1)
        lockstep.publish('cmd_vel', twist(0.1, 0.9))
        lockstep.run_for(0.4)
    run = made.run
    assert held(run).start == 'start_pose'
    moved = run.odometry.values + np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    wider = run.start_covariances + np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])
    changes = {
        'start': {'start_pose': replace(run.start_pose, values=run.start_pose.values + 1.0)},
        'odometry': {'odometry': replace(run.odometry, values=moved)},
        'covariance': {'start_covariances': wider},
        'covariances': {'odometry_covariances': np.full_like(run.odometry_covariances, 7.0)},
    }
    assert not verify(replace(run, **changes[what])).agrees(EXACT, EXACT)


@pytest.mark.parametrize('limits', [{}, {'linear__x__max_acceleration': 0.5}, {'simulate_slip': True}])
def test_a_robot_that_is_started_again_while_it_moves_is_followed(lockstep, robot_at, tmp_path, limits):
    robot = robot_at(**limits)
    with recorded(lockstep, tmp_path / 'run') as made:
        made.look()
        lockstep.publish('cmd_vel', twist(0.3, 0.7))
        lockstep.run_for(0.5)
        lockstep.remove(robot)
        lockstep.run_for(0.1)
        robot_at(**limits)
        made.look()
        lockstep.run_for(0.2)
        lockstep.publish('cmd_vel', twist(-0.2, 0.7))
        lockstep.run_for(0.3)
    assert len(made.run.start_pose) == 2
    held(made.run)


def test_placements_are_followed_by_the_time_of_recording(robot_at, lockstep, tmp_path):
    robot_at()
    with recorded(lockstep, tmp_path / 'run') as made:
        lockstep.publish('cmd_vel', twist(0.0, 0.0))
        made.look()
        lockstep.publish('cmd_vel', twist(0.3, 0.7))
        lockstep.run_for(0.3)
        lockstep.publish('initialpose', PoseWithCovarianceStamped())
        lockstep.run_for(0.1)
        lockstep.publish('cmd_vel', twist(0.3, 0.7))
        lockstep.run_for(0.2)
    run = replace(made.run, cmd_vel_out=rows(made.run.cmd_vel_out, NOTHING))
    held(run, 0.02)
    # Of a robot that moves already.
    late = rows(run.odometry, slice(4, None))
    held(replace(run, odometry=late, cmd_vel=rows(run.cmd_vel, slice(1, None))), 0.02)


def test_what_a_fault_loses_is_not_missing(lockstep, robot_at, driven):
    robot_at()
    lockstep.inject(Loss('odom', 0.3))
    run = driven([(0.3, 0.5)], 1.0)
    assert len(run.odometry) < len(run.wheels) - 5
    assert 'missing messages of odom were not looked for' in held(run).notes[-1]


def test_without_another_topic_of_the_robot_nothing_can_be_missed(lockstep, robot_at, driven):
    robot_at()
    lockstep.inject(Loss('odom', 0.3), Loss('joint_states', 0.3))
    run = driven([(0.3, 0.5)], 1.0)
    assert len(run.wheels) < 45
    # As of a robot that drifts.
    held(replace(run, ground_truth=run.odometry))


def test_parameters_that_a_robot_reports_when_it_starts_are_used(run):
    slow = {'linear.x.max_velocity': 0.05}
    (name,) = [node for node in run.parameters if node.endswith('virtual_robot')]
    by_time = replace(run, cmd_vel_out=rows(run.cmd_vel_out, NOTHING))
    held(by_time, 0.02)
    at = int(run.cmd_vel.received[0]) - 1
    started = replace(by_time, parameter_events=((at, Changes(name, slow, at)),))
    assert verify(started).distances.max() > 0.05


TAKES_TIME = {
    'at once': {},
    'ramps': {'linear__x__max_acceleration': 0.5},
    'lag': {'wheel_lag': 0.1},
    'ramps, delay': {'linear__x__max_acceleration': 0.5, 'command_delay': 0.053},
    'all': {'linear__x__max_acceleration': 5.0, 'command_delay': 0.053, 'wheel_lag': 0.002},
}


@pytest.mark.parametrize('name', TAKES_TIME)
@pytest.mark.parametrize(('odometry', 'commands'), [(0.0, 0.5), (0.4, 0.4), (0.31, 0.7)])
def test_a_late_recorder_does_not_blame_the_robot(robot_at, driven, name, odometry, commands):
    robot_at(**TAKES_TIME[name])
    run = driven([(0.1, 0.5), (0.3, -0.5), (0.0, 0.4), (-0.2, 0.1), (0.2, 0.0)], 0.23, rest=0.3)
    begun = run.odometry.received[0]

    def late(series, seconds):
        return rows(series, series.received >= begun + seconds * 1e9)

    # The latched start arrives after the odometry.
    received = np.maximum(run.start_pose.received, begun + int(odometry * 1e9) + 10**8)
    found = held(
        replace(
            run,
            odometry=late(run.odometry, odometry),
            odometry_covariances=np.empty((0, 9)),
            wheels=late(run.wheels, odometry),
            cmd_vel_out=late(run.cmd_vel_out, commands),
            start_pose=replace(run.start_pose, received=received),
        )
    )
    assert len(found.distances) > 10
    assert found.start == 'odometry'


def still(count=100, begin=10**9, step=10**8, **keywords):
    """Return the odometry of a robot that stands."""
    return series('odometry', begin + step * np.arange(count), np.zeros((count, 5)), **keywords)


def test_runs_that_cannot_be_verified_say_why(run):
    odometry, stamps = run.odometry, 2 * 10**18 + 10**8 * np.arange(100)
    stopped = replace(odometry, received=0 * odometry.received)
    shuffled = replace(odometry, stamps=odometry.stamps - 10**9 * (np.arange(len(odometry)) % 2))
    silent = replace(run, cmd_vel_out=rows(run.cmd_vel_out, NOTHING), cmd_vel=rows(run.cmd_vel, NOTHING))
    cases = [
        (replace(run, odometry=rows(odometry, NOTHING)), 'no odometry'),
        (replace(run, odometry=stopped), 'clock of the recorder stood still'),
        (replace(run, odometry=shuffled), 'record without use_sim_time'),
        (silent, 'has no commands: record cmd_vel_out, or cmd_vel'),
    ]
    for ahead in (10**18, -(10**18)):
        commands = series('cmd_vel', stamps + ahead, np.full((100, 2), 0.5))
        late = still(begin=2 * 10**18, received=stamps + ahead)
        of_another = built_run(odometry=late, cmd_vel=commands)
        cases.append((of_another, 'another clock than the stamps of the odometry'))
        applied = series('cmd_vel_out', stamps[50:] + ahead, np.full((50, 2), 0.5), stamps[50:])
        of_another = built_run(odometry=still(begin=2 * 10**18), cmd_vel_out=applied)
        cases.append((of_another, 'no odometry after the first command on cmd_vel_out'))
    for topic in ('cmd_vel', 'cmd_vel_out'):
        late = series(topic, still().stamps[-1:] + 1, [[0.5, 0.3]])
        last = built_run(odometry=still(), **{topic: late})
        cases.append((last, f'no odometry after the first command on {topic}'))
    for given, words in cases:
        with pytest.raises(BagError, match=words):
            verify(given)


def test_odometry_that_was_not_compared_is_counted():
    odometry = still()
    commands = series('cmd_vel', odometry.stamps[40:], np.zeros((60, 2)))
    verification = verify(built_run(odometry=odometry, cmd_vel=commands))
    assert len(verification.seconds) == 61
    assert verification.notes == (
        'the velocities were not compared: when each command took effect is in cmd_vel_out',
        '39 of 100 odometry messages precede the start of the simulated robot and were not compared',
    )


def test_commands_that_precede_the_odometry_are_passed_over():
    odometry = still()
    stamps = [*(odometry.stamps[:3] - 10**9), *odometry.stamps]
    commands = series('cmd_vel', stamps, [[1.0, 0.0]] * 3 + [[0.0, 0.0]] * 100)
    assert verify(built_run(odometry=odometry, cmd_vel=commands)).holds(0.0, 0.0)


# --- The covariance


def test_the_covariances_are_those_of_the_node_to_the_last_bit(lockstep, robot_at, tmp_path):
    robot_at(cmd_vel_timeout=0.3)
    with recorded(lockstep, tmp_path / 'run') as made:
        made.look()
        lockstep.publish('cmd_vel', twist(0.2, 1.0))
        lockstep.run_for(0.5)
        placed = PoseWithCovarianceStamped()
        placed.pose.covariance[0] = placed.pose.covariance[7] = placed.pose.covariance[35] = 0.04
        lockstep.publish('initialpose', placed)
        for turn in range(0, 40, 8):
            lockstep.publish('cmd_vel', twist(-0.2, 0.1 * turn))
            lockstep.run_for(0.1)
    run = made.run
    verification = held(run)
    assert verification.covariance_difference == 0.0
    # The heading of the start is exactly zero, so that no digit is lost in the quaternion.
    assert run.odometry_covariances[-1, 5] > 0.04
    forged = run.odometry_covariances.copy()
    forged[40, 3] *= 1.0 + 1e-6
    verification = verify(replace(run, odometry_covariances=forged))
    assert verification.covariance_difference > COVARIANCE_TOLERANCE
    assert not verification.holds(EXACT, EXACT)


def test_without_the_robot_or_its_start_the_covariances_are_not_compared(run):
    assert held(replace(run, parameters={})).covariance_difference is None
    without_start = replace(run, start_pose=rows(run.start_pose, NOTHING))
    assert verify(without_start).covariance_difference is None
    # Any other robot has none.
    held(replace(without_start, parameters={}))


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
