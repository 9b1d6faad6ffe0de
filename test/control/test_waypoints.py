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
    raise AssertionError(f'the law was called with {pose} and {goal}')


def echo(pose, goal):
    """A law that returns its arguments."""
    return (*pose, *goal)


def drive(arrival):
    """Return the poses, the waypoints driven to at each of them, and the last pose."""
    waypoints, pose, history = Waypoints(POSES), np.zeros(3), []
    for _ in range(2_000):
        waypoints, command = waypoints.follow(pose, law, arrival, GAIN)
        if command is None:
            return history, pose
        history.append((pose, waypoints))
        pose = integrate(pose, command, 0.04)
    raise AssertionError(f'never arrived: {waypoints.index} at {pose}')


def test_waypoints_are_reached_in_order_and_the_heading_only_when_it_counts():
    driven, end = drive(POSITIONS_ONLY)
    indices = [waypoints.index for _, waypoints in driven]
    assert np.all(np.diff(indices) >= 0)
    for index in (0, 1):
        # The step that turns to the next waypoint is taken where the last one is reached, not before.
        switch = indices.index(index + 1)
        left, before = driven[switch][0], driven[switch - 1][0]
        assert math.dist(left[:2], POSES[index, :2]) <= 0.02 < math.dist(before[:2], POSES[index, :2])
    assert math.dist(end[:2], POSES[-1, :2]) <= 0.02
    assert not any(waypoints.turning for _, waypoints in driven)
    turned, end = drive(WITH_HEADING)
    assert abs(wrap_angle(end[2] - POSES[-1, 2])) <= 0.01
    # Up to the last position both drive alike; from there on nothing but the heading changes.
    assert all(np.array_equal(one[0], other[0]) for one, other in zip(driven, turned, strict=False))
    turning = turned[len(driven) :]
    assert turning
    assert all(waypoints.turning and waypoints.index == 2 for _, waypoints in turning)
    assert {tuple(pose[:2]) for pose, _ in turning} == {tuple(end[:2])}


def test_waypoints_already_reached_are_skipped_in_one_step_without_a_copy():
    """Else a message with 300,000 poses in one place would block for minutes."""
    poses = np.zeros((300, 3))
    poses[298:, 0] = 1.0
    waypoints = Waypoints(poses)
    here, command = waypoints.follow(np.zeros(3), echo, WITH_HEADING, GAIN)
    assert here.index == 298
    assert command == (0.0, 0.0, 0.0, 1.0, 0.0, 0.0)
    assert here.poses is waypoints.poses
    assert (waypoints.index, waypoints.turning) == (0, False)


def test_at_the_last_waypoint_nothing_or_the_heading_is_left():
    at_goal = Waypoints(np.array([[0.01, 0.0, 1.0], [0.0, -0.01, 2.0]]))
    here, command = at_goal.follow(np.zeros(3), refuses, POSITIONS_ONLY, GAIN)
    assert (here.index, here.turning, command) == (1, False, None)
    here, command = at_goal.follow(np.zeros(3), refuses, WITH_HEADING, GAIN)
    assert (here.index, here.turning) == (1, True)
    assert command == turn_in_place(0.0, 2.0, GAIN) == (0.0, GAIN * 2.0)
    # While it turns a drift does not send it back.
    assert here.follow([5.0, 5.0, 0.0], refuses, WITH_HEADING, GAIN) == (here, (0.0, GAIN * 2.0))
    assert here.follow([5.0, 5.0, 2.0 - 0.009], refuses, WITH_HEADING, GAIN) == (here, None)
    # A turn ends when the heading no longer counts.
    assert here.follow(np.zeros(3), refuses, POSITIONS_ONLY, GAIN)[1] is None


def test_headings_are_compared_across_half_a_turn():
    goal = Waypoints(np.array([[0.0, 0.0, math.pi]]), turning=True)
    assert goal.follow([0.0, 0.0, 0.005 - math.pi], refuses, WITH_HEADING, GAIN)[1] is None
    _, command = goal.follow([0.0, 0.0, 0.5 - math.pi], refuses, WITH_HEADING, GAIN)
    assert command == (0.0, pytest.approx(-GAIN * 0.5))


def test_a_tolerance_counts_to_its_edge():
    goal, edge = Waypoints(np.array([[1.0, 2.0, 0.5]])), Arrival(xy_tolerance=0.25)
    assert goal.follow([0.75, 2.0, 0.0], refuses, edge, GAIN)[1] is None
    assert goal.follow([np.nextafter(0.75, 0.0), 2.0, 0.0], echo, edge, GAIN)[1] is not None
    exact = Arrival(xy_tolerance=0.0, yaw_tolerance=0.0, use_heading=True)
    assert goal.follow([1.0, 2.0, 0.5], refuses, exact, GAIN)[1] is None


def test_arrival_is_judged_at_the_point_that_the_offset_names():
    """Document B's law brings the point to the goal, the axle centre stays away from it."""
    ahead = Arrival(xy_tolerance=0.01, offset=0.2)
    goal = Waypoints(np.array([[1.0, 2.0, 0.0]]))
    for theta in (0.0, 2.0, -3.0):
        pose = np.array([1.0 - 0.2 * math.cos(theta), 2.0 - 0.2 * math.sin(theta), theta])
        assert goal.follow(pose, refuses, ahead, GAIN)[1] is None
        assert goal.follow([1.0, 2.0, theta], echo, ahead, GAIN)[1] is not None


def test_resumed_waypoints_check_the_last_position_again():
    resumed = Waypoints(POSES, 2, turning=True).resumed()
    assert (resumed.index, resumed.turning) == (2, False)
    away = POSES[2] + [1.0, 0.0, 0.0]
    assert not resumed.follow(away, law, WITH_HEADING, GAIN)[0].turning


def test_poses_must_be_a_list_that_has_the_index_and_are_copied():
    """What is no number is in kinematics/test_arguments.py."""
    for bad in (np.zeros((0, 3)), np.zeros(3), np.zeros((1, 1, 3))):
        with pytest.raises(ValueError, match=r'^poses must '):
            Waypoints(bad)
    for bad in (-1, 3):
        with pytest.raises(ValueError, match=r'^index must be '):
            Waypoints(POSES, bad)
    poses = POSES.copy()
    waypoints = Waypoints(poses)
    poses[:] = 7.0
    assert np.array_equal(waypoints.poses, POSES)
    with pytest.raises(ValueError, match='read-only'):
        waypoints.poses[0] = 7.0
