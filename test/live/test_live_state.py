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

"""What the live page shows of one robot: goals, paths, the path that was driven, and numbers."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from diffdrive_jacobian.control import Arrival, circle_path, line_path
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.live import robot_state
from diffdrive_jacobian.live.quantities import chain, errors, region, rounded
from diffdrive_jacobian.live.robot_state import SPACING, GoalProgress, RobotState, Trail
from diffdrive_jacobian.messages.goal_status import GoalState


def at(x, y=0.0):
    """Return a single goal."""
    return np.array([[x, y, 0.0]])


def execute(goal, goals, stamp):
    """Send goals or a path, and report that the controller drives to them."""
    goal.sent(goals, (stamp, 0))
    goal.reported(GoalState.EXECUTING, (stamp, 0))


def move(state, time, x, y=0.0, theta=0.0):
    state.moved(time, np.array([x, y, theta]), (0.5, 0.0), None)


def shown(state):
    """Return what the page receives."""
    return json.loads(json.dumps(state.shown(age=0.0, by_hand=False), allow_nan=False))


# --- Goals


def test_goals_and_their_state():
    goal = GoalProgress()
    goal.sent(np.vstack([at(1.0), at(1.0, 1.0)]), (1, 0))
    assert not goal.active
    goal.reported(GoalState.EXECUTING, (1, 0))
    np.testing.assert_array_equal(goal.current, [1.0, 0.0, 0.0])
    goal.moved(np.array([0.99, 0.0, 0.0]), Arrival())
    assert goal.shown()['index'] == 1
    assert len(goal.remaining()) == 1
    goal.reported(GoalState.SUCCEEDED, (1, 0))
    assert goal.current is None
    assert goal.shown()['state'] == 'succeeded'


def test_the_progress_on_a_path_outlives_a_refused_goal_and_the_same_path_again():
    goal = GoalProgress()
    execute(goal, line_path(4.0), 1)
    for x in (0.0, 0.3, 0.6):
        goal.moved(np.array([x, 0.1, 0.0]), Arrival())
    assert goal.path.s == pytest.approx(0.6)
    # While it waits for an answer nothing is known of it.
    goal.sent(at(9.0, 9.0), (2, 0))
    assert goal.path is None
    goal.reported(GoalState.ABORTED, (2, 0))
    goal.reported(GoalState.EXECUTING, (1, 0))
    assert (goal.path.s, goal.active) == (pytest.approx(0.6), True)
    # A planner repeats its path.
    execute(goal, line_path(4.0), 3)
    assert goal.path.s == pytest.approx(0.6)
    for stamp, other in enumerate((line_path(3.0), line_path(4.0).timed(1.0)), 4):
        goal.sent(other, (stamp, 0))
        goal.moved(np.array([0.9, 0.0, 0.0]), Arrival())
        assert goal.path.s == 0.0
        goal.reported(GoalState.EXECUTING, (stamp, 0))
        goal.moved(np.array([0.4, 0.0, 0.0]), Arrival())
        assert goal.path.s == pytest.approx(0.4)


def test_a_path_whose_status_comes_first_is_a_path():
    goal = GoalProgress()
    goal.reported(GoalState.ACCEPTED, (1, 0))
    assert goal.shown()['goals'] is None
    execute(goal, line_path(4.0), 1)
    assert len(goal.shown()['path']) > 100
    assert goal.path is not None


# --- Numbers


def test_the_chain_is_that_of_document_a():
    numbers = chain(0.0, (0.5, 2.35619449), None, (0.033, 0.16))
    assert numbers['wanted'] == pytest.approx([20.864, 9.440], abs=1e-3)
    assert numbers['world'] == pytest.approx([0.5, 0.0, 2.35619], abs=1e-5)
    identity = np.array(numbers['forward']) @ np.array(numbers['inverse'])
    assert identity == pytest.approx(np.eye(2), abs=1e-5)
    # At another heading, as measured, and each wheel has its own radius.
    numbers = chain(0.7, (0.5, 0.0), (3.0, -1.0), (0.05, 0.3), (1.1, 0.9))
    right, left = 3.0 * 0.05 * 1.1, -1.0 * 0.05 * 0.9
    v, omega = (right + left) / 2.0, (right - left) / 0.3
    assert numbers['measured']
    assert numbers['twist'] == pytest.approx([v, omega], rel=1e-5)
    world = [v * math.cos(0.7), v * math.sin(0.7), omega]
    assert numbers['world'] == pytest.approx(world, rel=1e-4)
    assert numbers['wanted'] == pytest.approx([0.5 / 0.05 / 1.1, 0.5 / 0.05 / 0.9], rel=1e-5)


def test_the_region_contains_95_percent():
    """Of a normal distribution: 2.448 standard deviations in the plane, 1.96 of the heading."""
    turned = se2.homogeneous([0.0, 0.0, 0.6])
    found = region(turned @ np.diag([0.3, 0.05, 0.2]) ** 2 @ turned.T)
    assert abs(math.sin(found['angle'] - 0.6)) < 1e-5
    axes = [found[name] for name in ('a', 'b', 'heading')]
    assert axes == pytest.approx([2.4477 * 0.3, 2.4477 * 0.05, 1.96 * 0.2], rel=1e-4)
    assert region(np.zeros((3, 3))) is None
    assert region(np.full((3, 3), math.nan)) is None


def test_errors_and_numbers_that_are_short_and_finite():
    found = errors(np.array([0.0, 0.0, 0.5]), np.array([0.0, 2.0, 0.0]), 0.0)
    assert found == pytest.approx((2.0, math.pi / 2 - 0.5))
    assert errors(np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.4)[0] == pytest.approx(0.6)
    assert rounded([1.23456789, math.nan, (np.float64(2.0), 3)]) == [1.23457, None, [2.0, 3]]


# --- The path that was driven


def test_a_path_is_bounded_and_ends_where_the_robot_is(monkeypatch):
    """Also of odometry that jumps after every few messages."""
    monkeypatch.setattr(robot_state, 'MAX_POINTS', 300)
    for piece in (1, 3, 10**9):
        trail, renewed = Trail(), 0
        for step in range(3600):
            x = 1.1 * SPACING * step + 5.0 * (step // piece)
            before, trail = trail, trail.extended(x, 0.0)
            renewed += trail is not before
            assert len(trail.points) <= 300
            assert trail.points[-1][0] == pytest.approx(x, abs=0.5)
        # A new path is sent to the page as a whole.
        assert renewed < 60
    assert trail.points[0] == (0.0, 0.0)
    trail = trail.extended(0.0, 0.0)
    assert trail.points[-2:] == [None, (0.0, 0.0)]
    assert len(trail.extended(0.0, SPACING / 2).points) == len(trail.points)


def test_the_path_is_interrupted_where_a_robot_is_placed():
    state = RobotState('/')
    for x in (0.0, 0.02, 0.04):
        move(state, x, x)
    state.interrupt()
    # One message more is from before.
    for time, x in ((0.06, 0.06), (0.08, 0.2), (0.1, 0.22)):
        move(state, time, x)
    abscissas = [point and point[0] for point in state.trail.points]
    assert abscissas == [0.0, 0.02, 0.04, 0.06, None, 0.2, 0.22]


# --- States of a robot


def test_parameters_of_any_node_may_be_anything():
    state = RobotState('/')
    move(state, 1.0, 1.0, 2.0, 0.5)
    execute(state.goal, at(2.0, 2.0), 1)
    usual = shown(state)['geometry']
    for value in (math.nan, math.inf, -1.0, 0.0, 1e-300, 1e300, 'x', None, True, [1.0]):
        geometry = ('wheel_radius', 'wheel_separation', 'left_wheel_name')
        state.robot_values = dict.fromkeys(geometry, value)
        names = ('kp', 'kv', 'offset', 'xy_goal_tolerance', 'use_goal_heading')
        for controller in ('go_to_goal', 'pose', 'offset_point', value):
            state.controller_values = {**dict.fromkeys(names, value), 'controller': controller}
            assert shown(state)['geometry'] == usual


def test_a_planned_path_is_shown_with_its_errors():
    state = RobotState('/')
    execute(state.goal, circle_path(1.0), 1)
    state.controller_values = {'controller': 'go_to_goal', 'path_controller': 'kanayama'}
    for x in (0.0, 0.1):
        move(state, x, x, -0.05, 0.2)
    page = shown(state)
    now, goal = page['now'], page['goal']
    assert (page['law']['name'], now['bearing_error']) == ('kanayama', None)
    away = math.hypot(0.1, 1.05) - 1.0
    assert now['across'] == pytest.approx(-away, abs=1e-4)
    passed = math.atan2(0.1, 1.05)
    assert now['path_heading_error'] == pytest.approx(0.2 - passed, abs=1e-4)
    assert now['distance'] == pytest.approx(2.0 * math.pi - passed, abs=2e-3)
    places = np.array(goal['path'])
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 1] - 1.0), 1.0, atol=1e-3)
    assert len(goal['goals']) == 1
    # It has no times.
    assert (now['along'], now['late'], goal['reference']) == (None, None, None)
    execute(state.goal, at(2.0, 2.0), 2)
    page = shown(state)
    assert (page['now']['across'], page['goal'].get('path')) == (None, None)
    assert page['law']['name'] == 'go_to_goal'


def test_a_trajectory_waits_for_a_robot_that_is_far_from_it():
    state = RobotState('/')
    state.controller_values = {'path_controller': 'pure_pursuit', 'path_approach_distance': 0.2}
    # What was before the path does not count.
    move(state, 2.0, 0.0)
    state.goal.sent(line_path(2.0).timed(0.5), (1, 0))
    move(state, 3.0, 0.0)
    state.goal.reported(GoalState.EXECUTING, (1, 0))

    def moved(time, x):
        move(state, time, x)
        page = shown(state)
        return page['now']['along'], page['now']['late'], page['goal']['reference'][0]

    moved(5.0, 0.0)
    assert moved(5.2, 0.1) == pytest.approx((0.0, 0.0, 0.1), abs=1e-9)
    # It stands: once the times are 0.2 m ahead they wait, a step later.
    for step in range(10):
        found = moved(5.3 + 0.1 * step, 0.1)
    assert found == pytest.approx((0.1 - 0.35, 0.5, 0.35))
    # Nor do the times go on while odometry is missing, beyond odom_timeout.
    state.controller_values |= {'path_approach_distance': 9.0, 'odom_timeout': 0.3}
    _, late, reference = moved(9.0, 0.1)
    assert reference == pytest.approx(0.35 + 0.5 * 0.3)
    assert late == pytest.approx(4.0 - 2.0 * reference)


def test_through_waypoints_without_a_stop_the_law_of_paths_drives():
    state, late = RobotState('/'), RobotState('/')
    late.controller_values = state.controller_values = {
        'controller': 'pose',
        'path_controller': 'kanayama',
        'pass_waypoints': True,
        'waypoint_tolerance': 0.2,
    }
    execute(state.goal, at(1.0), 1)
    assert not state.along_path
    execute(state.goal, np.vstack([at(1.0), at(2.0)]), 2)
    move(state, 1.0, 0.85)
    page = shown(state)
    assert (page['law']['name'], page['along_path'], page['goal']['index']) == ('kanayama', True, 1)
    # Of goals that were sent before this program listened nothing is known.
    late.goal.reported(GoalState.EXECUTING, (7, 0))
    move(late, 1.0, 0.0)
    assert shown(late)['law']['name'] == ''
