"""What go_to_goal warns of, and the rate of the odometry that it measures, without ROS."""

from __future__ import annotations

import math

import pytest

from diffdrive_jacobian.nodes.advice import (
    gain_warnings,
    limit_warnings,
    path_warnings,
    rate_warnings,
)
from diffdrive_jacobian.nodes.odometry_rate import PERIODS, OdometryRate
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters

MILLISECOND = 1_000_000


@pytest.mark.parametrize(
    ('limits', 'words'),
    [
        ({}, None),
        ({'linear_x_max_velocity': 0.0}, 'linear.x.max_velocity is 0: the robot may not drive forward'),
        ({'angular_z_max_velocity': 0.0}, 'the robot may turn in one direction only or not at all'),
        ({'angular_z_min_velocity': -0.0}, 'the robot may turn in one direction only or not at all'),
        ({'angular_z_max_velocity': 0.05}, 'limited to 0.05 rad/s: half a turn takes more than 60 s'),
        ({'angular_z_max_velocity': 0.06}, None),
    ],
)
def test_limits_with_which_goals_cannot_be_reached(limits, words):
    found = limit_warnings(GoToGoalParameters(**limits).limits())
    assert [words in one for one in found] == [True] * (words is not None)


def test_gains_that_are_too_large_for_the_rate():
    parameters = GoToGoalParameters(kp=3.0)
    assert rate_warnings(parameters, 50.0) == rate_warnings(parameters, math.inf) == []
    (warning,) = rate_warnings(parameters, 2.5)
    assert 'not below the odometry rate of 2.5 Hz' in warning
    # The law has no kp, but the turn at the goal has.
    offset = {'controller': 'offset_point', 'kp': 20.0, 'offset': 1.0}
    assert rate_warnings(GoToGoalParameters(**offset), 10.0) == []
    assert len(rate_warnings(GoToGoalParameters(**offset, use_goal_heading=True), 10.0)) == 1


def test_gains_with_which_a_robot_that_takes_time_overshoots():
    slow = {'linear_x_max_acceleration': 0.05, 'kv': 1.0, 'kp': 3.0}
    (warning,) = gain_warnings(GoToGoalParameters(**slow))
    assert warning.startswith('kv 1 lets the robot drive too fast to stop')
    assert gain_warnings(GoToGoalParameters(**slow, stop_in_time=True)) == []
    assert gain_warnings(GoToGoalParameters()) == []
    (warning,) = gain_warnings(GoToGoalParameters(kp=0.3))
    assert 'is not larger than kv' in warning


def test_gains_of_the_law_of_paths():
    assert path_warnings(GoToGoalParameters()) == []
    (warning,) = path_warnings(GoToGoalParameters(path_controller='kanayama', k_theta=1.0))
    assert 'the robot weaves about the path' in warning


def test_the_rate_is_measured_once_at_the_beginning_of_a_goal():
    rate, now = OdometryRate(), 0
    assert (rate.hz, rate.measured) == (math.inf, False)
    for number in range(PERIODS):
        # A gap and messages at once do not count.
        now += {3: 500, 4: 0, 5: 0}.get(number, 20) * MILLISECOND
        assert not rate.receive(now)
    assert rate.receive(now + 20 * MILLISECOND)
    assert (rate.hz, rate.measured) == (50.0, True)
    for period, expected, changed in ((20, 50.0, False), (18, 1e3 / 18, False), (100, 10.0, True)):
        rate.begin()
        assert not rate.measured
        found = [rate.receive(step * period * MILLISECOND) for step in range(PERIODS + 1)]
        assert found == [False] * PERIODS + [changed]
        assert rate.hz == pytest.approx(expected)


def test_a_clock_that_stands_has_no_rate():
    rate = OdometryRate()
    assert not any(rate.receive(0) for _ in range(PERIODS + 1))
    assert (rate.hz, rate.measured) == (math.inf, True)
