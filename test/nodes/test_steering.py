"""Driving to goals and along paths without ROS: goals, their progress, and the next commands."""

from __future__ import annotations

import math

import numpy as np
import pytest

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


@pytest.mark.parametrize(
    ('one', 'words'),
    [
        (goal((1, 2)), 'x 1.000, y 2.000'),
        (goal((0, 0), (1, 2)), '2 waypoints, the last at x 1.000, y 2.000'),
        (path((0, 0), (0, 2)), 'path of 2.00 m through 2 poses, the last at x 0.000, y 2.000'),
        (path((0, 0), (0, 2), times=(0.0, 4.0)), 'path of 2.00 m in 4.0 s through 2 poses, the last at'),
    ],
)
def test_a_goal_describes_itself(one, words):
    assert str(one).startswith(words)


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
    after, command = steer.command(begun, state, SECOND, RATE)
    assert after is begun
    assert command == (0.5, 0.0)
    assert steer.command(begun, state, SECOND, RATE) == (after, command)
    # The second one is to the left of the first.
    after, (v, omega) = steer.command(begun, at(1, 0), SECOND, RATE)
    assert (begun.index, after.index) == (0, 1)
    assert omega == pytest.approx(3.0 * math.pi / 2)
    assert abs(v) < 1e-12
    assert steer.command(after, at(1, 1), SECOND, RATE)[1] is None


@pytest.mark.parametrize('limit', [0.1, 1.0])
def test_commands_are_within_the_limits_on_the_same_curve(limit):
    free = steering().command(Pursuit.of(goal((3, 1))), at(0, 0), SECOND, RATE)[1]
    v, omega = steering(linear_x_max_velocity=limit).command(
        Pursuit.of(goal((3, 1))), at(0, 0), SECOND, RATE
    )[1]
    assert v == limit
    assert omega / v == pytest.approx(free[1] / free[0])


def test_a_robot_does_not_turn_by_more_than_a_half_turn_between_two_messages():
    pursuit, state, steer = Pursuit.of(goal((-1, 1e-3))), at(0, 0), steering(kp=100.0)
    _, free = steer.command(pursuit, state, SECOND, math.inf)[1]
    assert free == pytest.approx(100.0 * math.pi, rel=1e-3)
    for rate in (5.0, 30.0, 45.0):
        _, omega = steer.command(pursuit, state, SECOND, rate)[1]
        assert abs(omega) <= math.pi * rate
        # Whole turns less: the robot faces there at the next message.
        assert (free - omega) / (math.tau * rate) == pytest.approx(
            round((free - omega) / (math.tau * rate))
        )


def test_a_path_may_begin_only_so_far_from_the_robot():
    pursuit = Pursuit.of(path((1, 0), (2, 0)))
    assert steering(max_path_distance=1.0).begin(pursuit, (0.0, 0.0, 0.0)) is pursuit
    assert steering(max_path_distance=0.6).begin(pursuit, (0.5, 0.3, 0.0)) is pursuit
    with pytest.raises(ValueError, match=r'within max_path_distance, 0\.9 m, of the robot, got 1 m'):
        steering(max_path_distance=0.9).begin(pursuit, (0.0, 0.0, 0.0))


def test_waypoints_are_passed_along_a_path_from_the_robot_if_chosen():
    several = Pursuit.of(goal((1, 0), (2, 1)))
    assert steering().begin(several, (0.0, 0.0, 0.0)) is several
    steer = steering(pass_waypoints=True)
    passing = steer.begin(several, (0.0, 0.0, 0.0))
    assert passing.follower.passing
    assert passing.follower.path.poses[0].tolist() == [0.0, 0.0, 0.0]
    assert (passing.index, several.follower) == (0, None)
    # One goal, and goals where the robot is, have no path.
    for places in ([(1, 0)], [(0, 0), (0, 0)]):
        assert steer.begin(Pursuit.of(goal(*places)), (0.0, 0.0, 0.0)).follower is None


def test_a_waypoint_that_was_missed_is_driven_to():
    steer = steering(pass_waypoints=True, waypoint_tolerance=0.05)
    before = steer.begin(Pursuit.of(goal((1, 0), (2, 0), (3, 0))), (0.0, 0.0, 0.0))
    now, missed = SECOND, []
    for x in np.arange(0.0, 2.0, 0.1):
        # Beside the first one.
        after, command = steer.command(before, at(x, 0.2), now, RATE)
        missed.append(after.missed)
        assert command is not None
        before, now = after, now + SECOND // 50
    assert missed == sorted(missed)
    assert 0 < missed.count(True) < len(missed)
    assert before.follower is None
    assert before.index == 0


def test_the_end_of_a_path_is_a_goal_and_lateness_is_by_its_times():
    steer = steering()
    pursuit = Pursuit.of(path((0, 0), (1, 0), times=(0.0, 2.0)))
    pursuit, command = steer.command(pursuit, at(0, 0), SECOND, RATE)
    assert command is not None
    assert (pursuit.first_step, pursuit.last_step) == (SECOND, SECOND)
    for x in np.arange(0.0, 1.01, 0.01):
        # Half as fast as by its times.
        pursuit, command = steer.command(pursuit, at(x, 0), int((1.0 + 4.0 * x) * SECOND), RATE)
    assert pursuit.follower is None
    assert command is None
    assert pursuit.lateness(5 * SECOND) == ', 2.0 s later than by its times'
    assert pursuit.lateness(2 * SECOND) == ', 0.0 s later than by its times'
    assert Pursuit.of(path((0, 0), (1, 0))).lateness(SECOND) == ''


def test_a_robot_that_takes_time_is_told_to_stop_in_time():
    slow = {'linear_x_max_acceleration': 0.2, 'stop_in_time': True}
    v, _ = steering(**slow).command(
        Pursuit.of(goal((0.2, 0))), at(0, 0, twist=(0.3, 0.0)), SECOND, RATE
    )[1]
    free, _ = steering().command(Pursuit.of(goal((0.2, 0))), at(0, 0, twist=(0.3, 0.0)), SECOND, RATE)[1]
    assert v < free


def test_new_parameters_may_be_another_law_or_another_driven_point():
    before = steering(controller='offset_point', offset=0.1)
    assert not steering(before, controller='offset_point', offset=0.1, kp=1.0).drives_otherwise(before)
    assert steering(before, controller='offset_point', offset=0.2).drives_otherwise(before)
    assert steering(before).drives_otherwise(before)
