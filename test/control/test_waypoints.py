"""Waypoints: driven in order, with the heading of the last one only when it counts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from diffdrive_jacobian.control import Arrival, Waypoints, go_to_goal, turn_in_place
from diffdrive_jacobian.kinematics.se2 import integrate, wrap_angle

GAIN = 3.0
POSES = np.array([[1.0, 0.0, 2.0], [1.0, 1.0, -2.0], [0.0, 1.0, 1.5]])
POSITIONS_ONLY = Arrival(xy_tolerance=0.02, yaw_tolerance=0.01, use_heading=False)
WITH_HEADING = Arrival(xy_tolerance=0.02, yaw_tolerance=0.01, use_heading=True)


def law(pose, goal):
    return go_to_goal(pose, goal[:2], 3.0, 0.5)


def refuses(pose, goal):
    raise AssertionError(f'no law was to be asked for, got {pose} and {goal}')


def echo(pose, goal):
    """A law that records its arguments."""
    return (*pose, *goal)


def drive(waypoints, arrival, pose, rate=50.0):
    """Close the loop; give the poses, the waypoints driven to at each of them, and the last pose."""
    history, command = [], (0.0, 0.0)
    for _ in range(10_000):
        waypoints, command = waypoints.follow(pose, law, arrival, GAIN)
        if command is None:
            return history, pose
        history.append((pose, waypoints))
        pose = integrate(pose, command, 1.0 / rate)
    raise AssertionError(f'never arrived: {waypoints.index} at {pose}')


@pytest.mark.parametrize('form', [tuple, list, np.array])
@pytest.mark.parametrize('number', [int, float, np.float32])
def test_a_pose_may_have_any_form(form, number):
    _, command = Waypoints(POSES).follow(form([number(0)] * 3), echo, POSITIONS_ONLY, GAIN)
    assert command == (0.0, 0.0, 0.0, 1.0, 0.0, 2.0)


@pytest.mark.parametrize('arrival', [POSITIONS_ONLY, WITH_HEADING])
def test_waypoints_are_reached_in_order_each_within_the_tolerance(arrival):
    history, end = drive(Waypoints(POSES), arrival, np.zeros(3))
    indices = [waypoints.index for _, waypoints in history]
    assert np.all(np.diff(indices) >= 0)
    assert set(indices) == {0, 1, 2}
    for index in (0, 1):
        # The step that turns to the next waypoint is taken where the last one is reached, not before.
        switch = indices.index(index + 1)
        left, before = history[switch][0], history[switch - 1][0]
        assert math.dist(left[:2], POSES[index, :2]) <= arrival.xy_tolerance
        assert math.dist(before[:2], POSES[index, :2]) > arrival.xy_tolerance
    assert math.dist(end[:2], POSES[-1, :2]) <= arrival.xy_tolerance


def test_the_heading_is_reached_at_the_end_and_only_when_it_counts():
    driven, end = drive(Waypoints(POSES), POSITIONS_ONLY, np.zeros(3))
    assert abs(wrap_angle(end[2] - POSES[-1, 2])) > 1.0
    assert not any(waypoints.turning for _, waypoints in driven)
    turned, end = drive(Waypoints(POSES), WITH_HEADING, np.zeros(3))
    assert abs(wrap_angle(end[2] - POSES[-1, 2])) <= WITH_HEADING.yaw_tolerance
    # Up to the last position both go the same way; from there on nothing but the heading changes.
    for (pose, waypoints), (same_pose, others) in zip(turned, driven, strict=False):
        assert (pose.tobytes(), waypoints.index) == (same_pose.tobytes(), others.index)
    turning = turned[len(driven) :]
    assert turning
    assert all(waypoints.turning and waypoints.index == 2 for _, waypoints in turning)
    assert {tuple(pose[:2]) for pose, _ in turning} == {tuple(end[:2])}


def test_the_law_is_called_with_the_pose_and_the_position_driven_to():
    pose = np.array([0.25, 0.5, 3.0])
    for index in range(3):
        here, command = Waypoints(POSES, index).follow(pose, echo, WITH_HEADING, GAIN)
        assert (here.index, here.turning) == (index, False)
        assert command == (*pose, *POSES[index])


@pytest.mark.parametrize('arrival', [POSITIONS_ONLY, WITH_HEADING])
def test_waypoints_already_reached_are_skipped_in_one_step(arrival):
    near = np.array(
        [[0.01, 0.0, 1.0], [0.0, -0.01, 2.0], [0.0, 0.0, 3.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    )
    here, command = Waypoints(near).follow(np.zeros(3), echo, arrival, GAIN)
    assert here.index == 3
    assert command == (0.0, 0.0, 0.0, 1.0, 0.0, 0.0)


def test_a_turn_ends_when_the_heading_no_longer_counts():
    turning = Waypoints(POSES[:1], turning=True)
    here = np.array([1.0, 0.0, 0.0])
    assert turning.follow(here, refuses, WITH_HEADING, GAIN)[1] == turn_in_place(0.0, 2.0, GAIN)
    assert turning.follow(here, refuses, POSITIONS_ONLY, GAIN)[1] is None


def test_when_every_waypoint_is_reached_there_is_no_command():
    near = np.array([[0.01, 0.0, 1.0], [0.0, -0.01, 2.0]])
    here, command = Waypoints(near).follow(np.zeros(3), refuses, POSITIONS_ONLY, GAIN)
    assert (here.index, here.turning, command) == (1, False, None)


def test_on_the_last_spot_the_heading_alone_is_left():
    near = np.array([[0.01, 0.0, 1.0], [0.0, -0.01, 2.0]])
    here, command = Waypoints(near).follow(np.zeros(3), refuses, WITH_HEADING, GAIN)
    assert (here.index, here.turning) == (1, True)
    assert command == turn_in_place(0.0, 2.0, GAIN) == (0.0, GAIN * 2.0)
    looking = np.array([0.0, 0.0, 2.0 - 0.009])
    assert here.follow(looking, refuses, WITH_HEADING, GAIN) == (here, None)


def test_the_heading_error_is_wrapped_across_the_cut():
    here = Waypoints(np.array([[0.0, 0.0, math.pi]]), turning=True)
    just_past = np.array([0.0, 0.0, 0.005 - math.pi])
    assert here.follow(just_past, refuses, WITH_HEADING, GAIN)[1] is None
    v, omega = here.follow(np.array([0.0, 0.0, 0.5 - math.pi]), refuses, WITH_HEADING, GAIN)[1]
    assert v == 0.0
    assert omega == pytest.approx(-GAIN * 0.5)


def test_while_it_turns_a_drift_does_not_send_it_back():
    here = Waypoints(POSES, 2, turning=True)
    for pose in ([5.0, 5.0, 0.0], [0.0, 1.0, 0.0]):
        again, command = here.follow(np.array(pose), refuses, WITH_HEADING, GAIN)
        assert again == here
        assert command == (0.0, GAIN * 1.5)


def test_a_tolerance_of_zero_is_met_on_the_spot_and_a_tolerance_counts_to_its_edge():
    exact = Arrival(xy_tolerance=0.0, yaw_tolerance=0.0, use_heading=True)
    goal = Waypoints(np.array([[1.0, 2.0, 0.5]]))
    assert goal.follow(np.array([1.0, 2.0, 0.5]), refuses, exact, GAIN)[1] is None
    assert goal.follow(np.array([np.nextafter(1.0, 2.0), 2.0, 0.5]), echo, exact, GAIN)[1] is not None
    edge = Arrival(xy_tolerance=0.25, yaw_tolerance=0.0, use_heading=False)
    assert goal.follow(np.array([0.75, 2.0, 0.0]), refuses, edge, GAIN)[1] is None
    assert goal.follow(np.array([np.nextafter(0.75, 0.0), 2.0, 0.0]), echo, edge, GAIN)[1] is not None


def test_arrival_is_judged_at_the_point_that_the_offset_names():
    """Document B's law brings the point to the goal, the axle centre stays away from it."""
    ahead = Arrival(xy_tolerance=0.01, offset=0.2)
    goal = Waypoints(np.array([[1.0, 2.0, 0.0]]))
    for theta in (0.0, 2.0, -3.0):
        pose = np.array([1.0 - 0.2 * math.cos(theta), 2.0 - 0.2 * math.sin(theta), theta])
        assert goal.follow(pose, refuses, ahead, GAIN)[1] is None
        assert goal.follow(np.array([1.0, 2.0, theta]), echo, ahead, GAIN)[1] is not None


@pytest.mark.parametrize(
    ('name', 'bad'),
    [
        *((name, bad) for name in ('xy_tolerance', 'yaw_tolerance') for bad in (-1.0, np.nan, np.inf)),
        ('offset', np.nan),
        ('offset', [0.1, np.inf]),
    ],
)
def test_invalid_waypoints_are_named(name, bad):
    with pytest.raises(ValueError, match=rf'^{name} must be '):
        Arrival(**{name: bad})


def test_following_changes_no_value_in_place():
    waypoints, poses = Waypoints(POSES.copy()), POSES.copy()
    waypoints.follow(np.array([1.0, 0.0, 0.0]), law, WITH_HEADING, GAIN)
    assert (waypoints.index, waypoints.turning) == (0, False)
    assert np.array_equal(waypoints.poses, poses)


def test_resumed_waypoints_check_the_last_position_again():
    turning = Waypoints(POSES, 2, turning=True)
    resumed = turning.resumed()
    assert (resumed.index, resumed.turning) == (2, False)
    assert resumed.poses is turning.poses
    there, away = POSES[2] - [0.0, 0.0, 1.0], POSES[2] + [1.0, 0.0, 0.0]
    assert resumed.follow(there, refuses, WITH_HEADING, GAIN)[0].turning
    assert not resumed.follow(away, law, WITH_HEADING, GAIN)[0].turning
    driving = Waypoints(POSES, 1)
    assert driving.resumed() is driving


def test_waypoints_are_checked_and_do_not_change_with_the_array_they_were_given():
    for bad in (None, np.zeros((0, 3)), np.zeros(3), np.zeros((1, 2)), [[np.nan, 0.0, 0.0]]):
        with pytest.raises(ValueError, match=r'^poses must '):
            Waypoints(bad)
    for bad in (-1, 3, 1.0, None, True):
        with pytest.raises(ValueError, match=r'^index must be '):
            Waypoints(POSES, bad)
    poses = POSES.copy()
    waypoints = Waypoints(poses)
    poses[:] = 7.0
    assert np.array_equal(waypoints.poses, POSES)
    for here in (waypoints, waypoints.follow(POSES[0], law, POSITIONS_ONLY, GAIN)[0]):
        with pytest.raises(ValueError, match='read-only'):
            here.poses[0] = 7.0


def test_passing_waypoints_copies_none_of_them():
    """Else a message with 300,000 poses in one place would block for minutes."""
    waypoints = Waypoints(np.zeros((300, 3)))
    passed, command = waypoints.follow(np.zeros(3), refuses, POSITIONS_ONLY, GAIN)
    assert (passed.index, command) == (299, None)
    assert passed.poses is waypoints.poses
