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

"""Driving to goals and along paths without ROS: goals, their progress, and the next commands."""

from __future__ import annotations

import math

import numpy as np
import pytest

from diffdrive_jacobian.control import (
    VelocityLimits,
    go_to_goal,
    go_to_pose,
    offset_point,
    saturate,
    turn_in_place,
)
from diffdrive_jacobian.messages.codecs import Route, State
from diffdrive_jacobian.nodes.steering import Goal, Pursuit, Steering
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters

SECOND = 1_000_000_000
RATE = 50.0


def poses(*places):
    return tuple((float(x), float(y), 0.0) for x, y in places)


def goal(*places, frame=''):
    return Goal(frame, np.array(poses(*places)))


def path(*places, times=None, frame=''):
    return Goal.along_path(Route((0, 0), frame, poses(*places), times))


def at(x, y, theta=0.0, twist=(0.0, 0.0)):
    return State((0, 0), 'odom', (float(x), float(y), theta), twist)


def steering(before=None, **parameters):
    return Steering(GoToGoalParameters(**parameters), before)


def command(steer, one, state, rate=RATE):
    """Return the first command to a goal."""
    return steer.command(Pursuit.of(one), state, SECOND, rate)[1]


# --- Goals


def test_a_goal_describes_itself():
    assert str(goal((1, 2))) == 'x 1.000, y 2.000'
    assert str(goal((0, 0), (1, 2))) == '2 waypoints, the last at x 1.000, y 2.000'
    trajectory = path((0, 0), (0, 2), times=(0.0, 4.0))
    assert str(trajectory).startswith('path of 2.00 m in 4.0 s through 2 poses, the last at x 0.000')


def test_the_same_path_has_the_same_poses_times_and_frame():
    one = path((0, 0), (1, 0), times=(0.0, 2.0))
    assert one.is_same_path(path((0, 0), (1, 0), times=(0.0, 2.0)))
    for other in (
        path((0, 0), (1, 0)),
        path((0, 0), (1, 0), times=(0.0, 2.5)),
        path((0, 0), (1, 0.5), times=(0.0, 2.0)),
        path((0, 0), (1, 0), times=(0.0, 2.0), frame='map'),
        goal((0, 0), (1, 0)),
    ):
        assert not one.is_same_path(other)
        assert not other.is_same_path(one)
    assert path((0, 0), (1, 0)).is_same_path(path((0, 0), (1, 0)))
    assert not goal((1, 0)).is_same_path(goal((1, 0)))
    with pytest.raises(ValueError, match='path is invalid: '):
        path((1, 1), (1, 1))


def test_progress_is_another_value_and_the_same_question_has_the_same_answer():
    steer, begun = steering(), Pursuit.of(goal((1, 0), (1, 1)))
    state = at(0, 0)
    after, first = steer.command(begun, state, SECOND, RATE)
    assert after is begun
    assert first == (0.5, 0.0)
    assert steer.command(begun, state, SECOND, RATE) == (after, first)
    # The second one is to the left of the first.
    after, (v, omega) = steer.command(begun, at(1, 0), SECOND, RATE)
    assert (begun.index, after.index) == (0, 1)
    assert omega == pytest.approx(3.0 * math.pi / 2)
    assert abs(v) < 1e-12
    assert steer.command(after, at(1, 1), SECOND, RATE)[1] is None


# --- Laws

LAWS = {
    'go_to_goal': lambda pose, to, kp, kv, d: go_to_goal(pose, to[:2], kp, kv),
    'offset_point': lambda pose, to, kp, kv, d: offset_point(pose, to[:2], kv, d),
    'pose': lambda pose, to, kp, kv, d: go_to_pose(pose, to, kp, kv),
}
POSES = [(0.0, 0.0, 0.0), (2.0, 0.5, math.pi), (-1.0, -0.3, 1.5), (0.9, 1.2, -2.5), (-1e5, 1e5, 1.0)]
PLAUSIBLE = VelocityLimits(min_v=-1e3, max_v=1e3, min_omega=-1e3, max_omega=1e3)


def axle(x, y, theta, offset):
    """Place the axle such that the point at an offset is at x, y."""
    return at(x - offset * math.cos(theta), y - offset * math.sin(theta), theta)


@pytest.mark.parametrize('name', LAWS)
def test_each_pose_is_answered_by_the_law_that_was_chosen(name):
    gains = {'kp': 5.0, 'kv': 1.5, 'offset': -0.2}
    steer = steering(controller=name, **gains)
    target, following = (1.0, 0.4, 2.0), (3.0, 3.0, 1.0)
    pursuit = Pursuit.of(Goal('', np.array([target, following])))
    for pose in POSES:
        expected = saturate(*LAWS[name](pose, target, *gains.values()), PLAUSIBLE, 1.0, 1.0)
        pursuit, found = steer.command(pursuit, at(*pose), SECOND, math.inf)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert pursuit.index == 0
    # A waypoint counts by its position, which is that of the driven point.
    here = axle(*target[:2], 0.3, -0.2 if name == 'offset_point' else 0.0)
    pursuit, found = steer.command(pursuit, here, SECOND, math.inf)
    assert found == pytest.approx(LAWS[name](here.pose, following, *gains.values()), rel=1e-9)
    assert pursuit.index == 1


@pytest.mark.parametrize(('name', 'takes_heading'), [('go_to_goal', False), ('pose', True)])
def test_where_the_heading_counts_the_robot_turns_in_place_at_the_end(name, takes_heading):
    for use in (True, False):
        steer = steering(controller=name, yaw_goal_tolerance=0.1, use_goal_heading=use)
        pursuit = Pursuit.of(Goal('', np.array([(1.0, 0.0, -2.0)])))
        pursuit, found = steer.command(pursuit, at(1.0, 0.0), SECOND, RATE)
        if not use and not takes_heading:
            assert found is None
            continue
        assert found == turn_in_place(0.0, -2.0, 3.0)
        assert steer.command(pursuit, at(1.0, 0.1, -2.11), SECOND, RATE)[1] is not None
        assert steer.command(pursuit, at(1.0, 0.1, -2.09), SECOND, RATE)[1] is None


# --- Limits


def test_a_robot_does_not_turn_by_more_than_a_half_turn_between_two_messages():
    behind, steer = Pursuit.of(goal((-1, 1e-3))), steering(kp=100.0)
    _, free = steer.command(behind, at(0, 0), SECOND, math.inf)[1]
    assert free == pytest.approx(100.0 * math.pi, rel=1e-3)
    for rate in (5.0, 30.0, 45.0):
        _, omega = steer.command(behind, at(0, 0), SECOND, rate)[1]
        assert abs(omega) <= math.pi * rate
        # Whole turns less: the robot faces there at the next message.
        turns = (free - omega) / (math.tau * rate)
        assert turns == pytest.approx(round(turns))


# --- Paths


def test_a_path_may_begin_only_so_far_from_the_robot():
    pursuit = Pursuit.of(path((1, 0), (2, 0)))
    assert steering(max_path_distance=1.0).begin(pursuit, (0.0, 0.0, 0.0)) is pursuit
    assert steering(max_path_distance=0.6).begin(pursuit, (0.5, 0.3, 0.0)) is pursuit
    with pytest.raises(ValueError, match=r'within max_path_distance, 0\.9 m, of the robot, got 1 m'):
        steering(max_path_distance=0.9).begin(pursuit, (0.0, 0.0, 0.0))


def test_the_end_of_a_path_is_a_goal_and_lateness_is_by_its_times():
    steer = steering()
    pursuit = Pursuit.of(path((0, 0), (1, 0), times=(0.0, 2.0)))
    pursuit, found = steer.command(pursuit, at(0, 0), SECOND, RATE)
    assert found is not None
    assert (pursuit.first_step, pursuit.last_step) == (SECOND, SECOND)
    for x in np.arange(0.0, 1.01, 0.01):
        # Half as fast as by its times.
        pursuit, found = steer.command(pursuit, at(x, 0), int((1.0 + 4.0 * x) * SECOND), RATE)
    assert pursuit.follower is None
    assert found is None
    assert pursuit.lateness(5 * SECOND) == ', 2.0 s later than by its times'
    assert pursuit.lateness(2 * SECOND) == ', 0.0 s later than by its times'
    assert Pursuit.of(path((0, 0), (1, 0))).lateness(SECOND) == ''


def test_one_goal_and_waypoints_where_the_robot_is_have_no_path():
    steer = steering(pass_waypoints=True)
    for places in ([(1, 0)], [(0, 0), (0, 0)]):
        assert steer.begin(Pursuit.of(goal(*places)), (0.0, 0.0, 0.0)).follower is None
    assert steer.begin(Pursuit.of(goal((1, 0), (2, 1))), (0.0, 0.0, 0.0)).follower.passing


def test_it_brakes_for_the_goal_only_if_it_is_to_stop_in_time():
    limits = {'linear_x_max_acceleration': 0.1, 'linear_x_max_deceleration': -0.1, 'kv': 2.0}
    # At 0.2 m/s it needs the 0.2 m that are left.
    near = at(0.8, 0, twist=(0.2, 0.0))
    assert command(steering(**limits), goal((1, 0)), near) == (pytest.approx(0.4), 0.0)
    assert command(steering(**limits, stop_in_time=True), goal((1, 0)), near) == (0.0, 0.0)
    # A robot without limits stops at once.
    assert command(steering(kv=2.0, stop_in_time=True), goal((1, 0)), near) == (pytest.approx(0.4), 0.0)
