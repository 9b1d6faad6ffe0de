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

"""What go_to_goal warns of, and the rate of the odometry that it measures."""

from __future__ import annotations

import math

import pytest
from support.lockstep_nodes import change, make
from support.ros_messages import goal, path

from diffdrive_jacobian.control import VelocityLimits
from diffdrive_jacobian.nodes.advice import (
    gain_warnings,
    limit_warnings,
    path_warnings,
    rate_warnings,
)
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.odometry_rate import PERIODS, OdometryRate
from diffdrive_jacobian.nodes.stopping import overshoot_warnings, rolls_on
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.simulation import closed_loops
from diffdrive_jacobian.simulation.actuators import AccelerationLimits, Actuators, AxisLimits

MILLISECOND = 1_000_000
SPIRAL, WEAVES = 'is not larger than kv', 'the robot weaves about the path'
NO_FORWARD, NO_TURN = 'the robot may not drive forward', 'the robot may turn in one direction only'


@pytest.mark.parametrize(
    ('unsuitable', 'words'),
    [
        ({'linear_x_max_velocity': 0.0}, f'linear.x.max_velocity is 0: {NO_FORWARD}'),
        ({'angular_z_max_velocity': 0.0}, NO_TURN),
        ({'angular_z_min_velocity': -0.0}, NO_TURN),
        ({'angular_z_max_velocity': 0.05}, 'limited to 0.05 rad/s: half a turn takes more than 60 s'),
    ],
)
def test_limits_with_which_goals_cannot_be_reached(unsuitable, words):
    (warning,) = limit_warnings(GoToGoalParameters(**unsuitable).limits())
    assert words in warning
    assert limit_warnings(GoToGoalParameters(angular_z_max_velocity=0.06).limits()) == []


def test_gains_that_are_too_large_for_the_rate():
    parameters = GoToGoalParameters(kp=3.0)
    assert rate_warnings(parameters, 50.0) == rate_warnings(parameters, math.inf) == []
    (warning,) = rate_warnings(parameters, 2.5)
    assert 'not below the odometry rate of 2.5 Hz' in warning
    # The law has no kp, but the turn at the goal has.
    offset = {'controller': 'offset_point', 'kp': 20.0, 'offset': 1.0}
    assert rate_warnings(GoToGoalParameters(**offset), 10.0) == []
    assert len(rate_warnings(GoToGoalParameters(**offset, use_goal_heading=True), 10.0)) == 1


BACKWARDS = {'controller': 'offset_point', 'linear_x_min_velocity': 0.0}
SLOW = {'linear_x_max_acceleration': 0.05, 'kv': 1.0}


@pytest.mark.parametrize(
    ('warnings', 'unsuitable', 'suitable', 'words'),
    [
        (gain_warnings, {'kp': 0.5, 'kv': 0.5}, {'kp': 0.6}, SPIRAL),
        (gain_warnings, {'controller': 'pose', 'kp': 1.0}, {'kp': 1.1}, 'choose kp > 2 kv'),
        (gain_warnings, BACKWARDS, {'linear_x_min_velocity': -0.1}, 'may not back up'),
        (gain_warnings, SLOW, {'stop_in_time': True}, 'kv 1 lets the robot drive too fast to stop'),
        (path_warnings, {'path_controller': 'kanayama', 'k_theta': 1.0}, {'k_theta': 5.0}, WEAVES),
    ],
)
def test_gains_and_limits_that_do_not_suit_the_law(warnings, unsuitable, suitable, words):
    (warning,) = warnings(GoToGoalParameters(**unsuitable))
    assert words in warning
    assert warnings(GoToGoalParameters(**{**unsuitable, **suitable})) == []


def test_the_advice_is_given_where_a_robot_overshoots():
    """The law `v = kv distance`, straight on, with a limit and from far away."""
    limits = VelocityLimits(max_v=0.6, max_omega=1.0, min_omega=-1.0)
    actuators = Actuators(
        acceleration=AccelerationLimits(v=AxisLimits(max_acceleration=1.0, max_deceleration=-0.2))
    )
    gains = [0.5, 0.6, 0.8, 1.5]
    found = closed_loops(
        lambda poses, goals, gain: (gain * (goals[..., 0] - poses[..., 0]), 0.0 * poses[..., 0]),
        [0.0, 0.0, 0.0], [3.0, 0.0], gains,
        limits=limits, actuators=actuators, duration=12.0, rate=20.0,
    )  # fmt: skip
    advice = [bool(overshoot_warnings(kv, None, limits, actuators)) for kv in gains]
    # Up to the tolerance the robot may be fast without overshooting by more than that.
    assert advice == (found.overshoot > 0.02).tolist() == [False, False, True, True]
    fast = VelocityLimits(max_v=5.0)
    assert overshoot_warnings(0.5, None, fast, actuators)
    assert not overshoot_warnings(None, None, fast, actuators)
    assert not overshoot_warnings(0.5, None, fast, Actuators())


@pytest.mark.parametrize('side', [1.0, -1.0])
def test_turns_are_overshot_in_the_direction_that_is_faster(side):
    slowing = AxisLimits(max_acceleration=1.0, max_deceleration=-1.0, max_deceleration_reverse=1.0)
    actuators = Actuators(acceleration=AccelerationLimits(omega=slowing))
    lower, upper = sorted([-8.0 * side, 0.5 * side])
    (warning,) = overshoot_warnings(
        None, 3.0, VelocityLimits(min_omega=lower, max_omega=upper), actuators
    )
    assert 'choose kp below 0.25,' in warning
    slower = VelocityLimits(min_omega=-0.5, max_omega=0.5)
    assert overshoot_warnings(None, 3.0, slower, actuators) == []


def test_how_far_a_robot_rolls_on_is_described_where_it_is_known():
    actuators = Actuators(
        acceleration=AccelerationLimits(v=AxisLimits(max_acceleration=0.4, max_deceleration=-0.1)),
        lag=0.1,
        delay=200 * MILLISECOND,
    )
    words = '; the robot rolls on for about 0.260 m and turns by 0.000 rad'
    assert rolls_on(actuators, (0.2, 0.0)) == words
    assert rolls_on(actuators, (0.0, 0.0)) == rolls_on(actuators, (math.nan, 0.0)) == ''
    assert rolls_on(Actuators(), (0.2, 0.0)) == ''


# --- When the node logs it


def test_the_node_warns_with_the_first_goal_and_when_that_changes(lockstep, capfd):
    def warned():
        said = capfd.readouterr().err
        return {words for words in (SPIRAL, NO_FORWARD, NO_TURN) if words in said}

    node = lockstep.add(make(GoToGoal, kp=0.5, kv=0.5, linear__x__max_velocity=0.0))
    assert warned() == {NO_FORWARD}
    for expected in ({SPIRAL}, set()):
        lockstep.publish('goal_pose', goal(1.0, 0.0))
        assert warned() == expected
    for changes, expected in (
        ({'linear__x__max_velocity': 1.0, 'controller': 'offset_point'}, set()),
        ({'controller': 'go_to_goal'}, {SPIRAL}),
        ({'kp': 0.6}, set()),
        ({'kp': 0.5}, {SPIRAL}),
        ({'angular__z__min_velocity': 0.0}, {SPIRAL, NO_TURN}),
    ):
        assert change(node, **changes).successful
        assert warned() == expected


def test_along_a_path_its_law_is_warned_about(lockstep, capfd):
    weaving = {'path_controller': 'kanayama', 'k_theta': 1.0}
    lockstep.add(make(GoToGoal, kp=0.5, kv=0.5, **weaving))
    lockstep.publish('path', path((0.0, 0.0), (1.0, 0.0)))
    said = capfd.readouterr().err
    assert WEAVES in said
    assert SPIRAL not in said
    lockstep.publish('goal_pose', goal(1.0, 0.0))
    said = capfd.readouterr().err
    assert SPIRAL in said
    assert WEAVES not in said


# --- The rate of the odometry


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
