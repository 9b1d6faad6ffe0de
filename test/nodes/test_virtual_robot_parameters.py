"""The node virtual_robot and its parameters: limits on what it drives, and changes while it runs."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from support.lockstep_nodes import SECOND, Topics, change, comes_after
from support.ros_messages import covariance_of, instants, pose_message, pose_of, twist, twists

from diffdrive_jacobian.control import VelocityLimits, saturate
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.simulation.exact_moments import gaussian, propagate_moments

LIMITS = {
    'forward': ({'linear__x__max_velocity': 0.25}, {'min_v': -0.25, 'max_v': 0.25}),
    'reverse': ({'linear__x__min_velocity': -0.1}, {'min_v': -0.1}),
    'no reverse': (
        {'linear__x__max_velocity': 0.5, 'linear__x__min_velocity': 0.0},
        {'max_v': 0.5, 'min_v': 0.0},
    ),
    # The quotient of a speed and it overflows.
    'too small': ({'linear__x__max_velocity': 5e-324}, {'min_v': 0.0, 'max_v': 0.0}),
    'turning': ({'angular__z__max_velocity': 1.0}, {'min_omega': -1.0, 'max_omega': 1.0}),
    'clockwise': ({'angular__z__min_velocity': -0.5}, {'min_omega': -0.5}),
    'wheels': ({'max_wheel_velocity': 9.0}, {'max_wheel_speed': 9.0}),
}


@pytest.fixture
def driving(lockstep, robot_at):
    """A robot that is told at t = 1 s to drive at 1 m/s, with its topics."""
    topics = Topics(lockstep)
    topics.robot = robot_at()
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    return topics


@pytest.mark.parametrize('name', LIMITS)
def test_limits_keep_the_curvature_hold_for_the_running_command_and_let_it_go_again(
    lockstep, robot_at, name
):
    parameters, limits = LIMITS[name]
    limits, topics = VelocityLimits(**limits), Topics(lockstep)
    robot = robot_at(**parameters)
    for command in ((1.0, 3.0), (-1.0, 3.0)):
        lockstep.publish('cmd_vel', twist(*command))
        assert twists(topics.applied)[-1] == saturate(*command, limits, 0.033, 0.16)
    # Live: none, these, none again.
    pose, begin = pose_of(topics.starts[-1]), lockstep.now
    full, limited = (-1.0, -3.0), saturate(-1.0, -3.0, limits, 0.033, 0.16)
    none = dict.fromkeys(parameters, math.nan)
    assert change(robot, **none).successful
    lockstep.settle()
    topics.applied.clear()
    lockstep.publish('cmd_vel', twist(*full))
    for values in (parameters, none):
        lockstep.run_for(0.2)
        assert change(robot, **values).successful
    lockstep.run_for(1.0)
    tenths = [begin, begin + SECOND // 5, begin + 2 * (SECOND // 5), begin + SECOND // 2]
    told = list(zip(instants(topics.applied), twists(topics.applied), strict=True))
    if limited == full:
        assert told == [(tenths[0], full), (tenths[3], (0.0, 0.0))]
    else:
        assert told == list(zip(tenths, [full, limited, full, (0.0, 0.0)], strict=True))
    for command, seconds in ((full, 0.2), (limited, 0.2), (full, 0.1)):
        pose = se2.integrate(pose, command, seconds)
    assert topics.odom[-1].pose.pose == pose_message(pose)


@pytest.mark.parametrize(
    ('timeout', 'strikes'), [(0.1, 0.2), (0.2, 0.2), (0.3, 0.3), (2.0, 2.0), (0.0, None)]
)
def test_timeout_changes_for_the_running_command(lockstep, driving, timeout, strikes):
    lockstep.run_for(0.2)
    assert change(driving.robot, cmd_vel_timeout=timeout).successful
    lockstep.run_for(2.8)
    # It counts from the command; one that is over strikes at once.
    stops = [] if strikes is None else [SECOND + round(strikes * SECOND)]
    assert instants(driving.applied) == [SECOND, *stops]
    assert pose_of(driving.odom[-1])[0] == pytest.approx(strikes or 3.0, abs=1e-15)


@pytest.mark.parametrize('rate', [0.5, 50.5, 1000.0])
def test_rate_changes_at_once(lockstep, driving, rate):
    lockstep.run_for(0.013)
    changed, period = lockstep.now, round(SECOND / rate)
    assert change(driving.robot, publish_rate=rate).successful
    driving.odom.clear()
    lockstep.run_for(5.0 / rate)
    # A tick that is due sooner stays due.
    first = min(SECOND + SECOND // 50, changed + period)
    expected = range(first, lockstep.now + 1, period)
    assert instants(driving.odom) == list(expected)
    assert len(expected) in (5, 6)


@pytest.mark.parametrize('pause', [0.001, 0.01])
def test_rate_that_keeps_changing_starves_nobody(lockstep, driving, pause):
    driving.odom.clear()
    for rate in itertools.islice(itertools.cycle([21.0, 20.0]), 100):
        change(driving.robot, publish_rate=rate)
        lockstep.run_for(pause)
    assert len(driving.odom) >= math.floor(100 * pause * 20)


def test_initial_pose_counts_from_the_next_reset_on(lockstep, driving):
    assert change(driving.robot, x=3.0, y=4.0, theta=5.0).successful
    lockstep.run_for(1.0)
    assert pose_of(driving.odom[-1]).tolist() == [0.5, 0.0, 0.0]
    assert lockstep.call(Trigger, 'reset_odometry').success
    expected = pose_message([3.0, 4.0, 5.0 - math.tau])
    assert driving.starts[-1].pose.pose == expected
    assert comes_after(lockstep, driving.odom, 0.02).pose.pose == expected


def test_names_change_with_the_next_message(lockstep, driving):
    names = {'odom_frame_id': 'o', 'base_frame_id': 'b', 'left_wheel_name': 'l', 'right_wheel_name': 'r'}
    assert change(driving.robot, **names).successful
    odometry = comes_after(lockstep, driving.odom, 0.02)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ('o', 'b')
    assert driving.states[-1].name == ['l', 'r']
    lockstep.publish('cmd_vel', twist(0.5, 0.0))
    assert driving.applied[-1].header.frame_id == 'b'


@pytest.mark.parametrize('variance', [0.0, 1e-5, 1.0])
def test_uncertainty_grows_with_the_variance_of_the_wheels(lockstep, robot_at, variance):
    topics = Topics(lockstep)
    robot = robot_at(wheel_travel_variance=0.0)
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    lockstep.run_for(0.2)
    assert not np.any(covariance_of(topics.odom[-1]))
    assert change(robot, wheel_travel_variance=variance).successful
    lockstep.run_for(0.2)
    # Straight ahead: its double over L^2 in the heading, and to first order half of it along the way.
    covariance = covariance_of(topics.odom[-1])
    assert covariance[2, 2] == pytest.approx(2.0 * variance * 0.2 / 0.16**2, rel=1e-12)
    if variance <= 1e-5:
        assert covariance[0, 0] == pytest.approx(variance * 0.2 / 2.0, rel=1e-2)
    arc = ((1.0, 0.0), 0.2, 0.16, variance)
    expected = propagate_moments(gaussian(np.zeros((3, 3))), np.zeros(3), *arc).second_moment
    assert covariance == pytest.approx(expected, rel=1e-9, abs=1e-16)


BAD = [
    ({'wheel_radius': 0.0}, 'wheel_radius'),
    ({'wheel_radius': math.nan}, 'wheel_radius'),
    ({'wheel_radius': 'big'}, 'expected'),
    ({'linear__x__max_velocity': -1.0}, "'linear.x.max_velocity' must be in [0, 1000]"),
    ({'linear__x__min_velocity': 0.5}, 'got 0.5'),
    ({'max_wheel_velocity': math.inf}, 'or .nan for none'),
    ({'base_frame_id': ''}, "'base_frame_id' must be not empty"),
    ({'base_frame_id': 'odom'}, 'must differ'),
    ({'command_interface': 'wheels'}, 'read-only'),
    ({'publish_rate': 2000.0}, 'publish_rate'),
    ({'wheel_separation': 1.0, 'cmd_vel_timeout': -1.0}, 'cmd_vel_timeout'),
]


def test_bad_changes_are_refused_with_the_reason_and_change_nothing(lockstep, driving):
    before = driving.robot.parameters
    lockstep.run_for(0.2)
    for changes, words in BAD:
        result = change(driving.robot, **changes)
        assert not result.successful
        assert words in result.reason
        assert driving.robot.parameters is before
    lockstep.run_for(0.32)
    assert instants(driving.applied) == [SECOND, SECOND + SECOND // 2]
    assert pose_of(driving.odom[-1]).tolist() == [0.5, 0.0, 0.0]


def test_integers_are_taken_for_doubles_and_other_parameters_are_left_alone(driving):
    assert driving.robot.set_parameters([Parameter('wheel_separation', value=1)])[0].successful
    assert driving.robot.parameters.wheel_separation == 1.0
    assert driving.robot.get_parameter('wheel_separation').value == 1.0
    driving.robot.declare_parameter('foreign', 3)
    assert driving.robot.set_parameters([Parameter('foreign', value=4)])[0].successful
