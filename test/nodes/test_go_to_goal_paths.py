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

"""The node go_to_goal on paths: circles, trajectories, waypoints without stops, and paths it refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from support.lockstep_nodes import (
    ACCEPTED,
    CANCELED,
    EXECUTING,
    SECOND,
    SUCCEEDED,
    Controller,
    change,
    make,
)
from support.ros_messages import goal, goals, odometry, path, pose_of, twists

from diffdrive_jacobian.control import Path, PathController
from diffdrive_jacobian.control.controllers import ALL_PATH_CONTROLLERS
from diffdrive_jacobian.drives.nodes import overrides
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot

STRAIGHT = path((0, 0), (0.5, 0), (1, 0), stamp=2)
RATE = 25.0
"""Rate of the odometry in the drives (Hz)."""


def circle(count, radius):
    angles = np.linspace(0.0, math.tau, count + 1)
    return [(radius * math.sin(a), radius * (1.0 - math.cos(a))) for a in angles]


def drive(lockstep, topic, message, *, start=(0.0, 0.0, 0.0), **parameters):
    """Drive to the end; give the poses, shape (n, 3), the commands and the seconds it took."""
    poses, commands = lockstep.listen(Odometry, 'odom'), lockstep.listen(Twist, 'cmd_vel')
    status = lockstep.listen(GoalStatus, 'goal_status')
    begin = dict(zip(('x', 'y', 'theta'), start, strict=True))
    lockstep.add(make(VirtualRobot, publish_rate=RATE, **begin))
    lockstep.add(make(GoToGoal, **{'path_speed': 0.5, **parameters}))
    lockstep.publish(topic, message)
    before = lockstep.now
    lockstep.run_until(lambda: status[-1].status == SUCCEEDED, 30.0, 'arrival')
    seconds = (lockstep.now - before) / SECOND
    return np.array([pose_of(one) for one in poses]), twists(commands), seconds


@pytest.fixture
def controller(lockstep):
    return Controller(lockstep)


# --- Drives


@pytest.mark.parametrize('law', tuple(ALL_PATH_CONTROLLERS))
def test_a_path_is_reached_followed_and_driven_to_its_end_without_a_stop(lockstep, law):
    """A quarter of a circle, from beside it: within 1 cm after a part of it."""
    quarter = path(*circle(32, 1.0)[:9])
    start = (-0.1, -0.1, 0.5)
    how = {'path_controller': law, 'lookahead_distance': 0.2}
    poses, commands, seconds = drive(lockstep, 'path', quarter, start=start, **how)
    late = poses[poses[:, 0] > 0.8]
    assert len(late) > 10
    assert abs(np.hypot(late[:, 0], late[:, 1] - 1.0) - 1.0).max() < 0.01
    assert commands[-1] == (0.0, 0.0)
    assert min(v for v, _ in commands[len(commands) // 2 : -1]) > 0.05
    assert math.dist(poses[-1, :2], (1.0, 1.0)) < 0.021
    assert math.pi / 2.0 / 0.5 < seconds < 6.0


def test_a_trajectory_is_driven_at_its_times(lockstep):
    """A line at 0.2 m/s, a pause of 0.6 s, and at 0.3 m/s to the end."""
    times, places = [0.0, 1.0, 1.6, 2.1, 2.6], [0.0, 0.2, 0.2, 0.35, 0.5]
    message = path(*[(x, 0.0) for x in places], times=times)
    poses, commands, seconds = drive(lockstep, 'path', message, path_controller='kanayama')
    assert abs(seconds - 2.6) < 1.0
    planned = Path(np.array([(x, 0.0) for x in places]), np.array(times))
    # The robot answers the first odometry.
    count = round(2.4 * RATE)
    expected = [planned.at_time(step / RATE).x for step in range(count)]
    assert abs(poses[:count, 0] - expected).max() < 0.08
    assert max(abs(v) for v, _ in commands[round(1.45 * RATE) : round(1.6 * RATE)]) < 0.08


def nearest(poses, point):
    return np.hypot(*(poses[:, :2] - point).T).min()


def test_waypoints_are_passed_without_stopping(lockstep):
    points = circle(8, 0.5)[1:5]
    message = goals(*[goal(*one) for one in points])
    poses, commands, seconds = drive(lockstep, 'goals', message, pass_waypoints=True)
    assert seconds < 6.0
    assert commands[-1] == (0.0, 0.0)
    # It turns at the start only: the first waypoint is not ahead.
    assert min(v for v, _ in commands[round(RATE / 2.0) : -1]) > 0.05
    assert max(nearest(poses, point) for point in points) < 0.1


def test_a_waypoint_that_was_missed_is_reported_and_driven_to(lockstep, capfd):
    corner = [(0.2, 0.0), (0.4, 0.0), (0.4, 0.2)]
    how = {'pass_waypoints': True, 'lookahead_distance': 0.3, 'waypoint_tolerance': 0.02, 'kv': 4.0}
    poses, _, _ = drive(lockstep, 'goals', goals(*[goal(*one) for one in corner]), kp=8.0, **how)
    assert 'waypoint 2 of 3 was passed at more than waypoint_tolerance, 0.02 m' in capfd.readouterr().err
    assert max(nearest(poses, point) for point in corner) <= 0.02


# --- Commands on a path


def test_a_trajectory_waits_while_odometry_is_missing(lockstep):
    controller = Controller(lockstep, path_controller='kanayama')
    controller.send(path((0, 0), (10, 0), times=[0, 100]))
    assert controller.at(0, 0) == pytest.approx((0.1, 0.0))
    lockstep.run_for(5.0)
    assert controller.at(0.05, 0.0) == pytest.approx((0.1, 0.0))


def test_parameters_change_while_it_drives(controller):
    controller.send(STRAIGHT)
    # A robot that faces backwards turns in place.
    assert controller.at(0.0, 0.0, 3.0) == (0.0, -9.0)
    assert controller.at(0.1, 0.0) == (0.2, 0.0)
    assert change(controller.node, path_speed=0.1, path_controller='kanayama').successful
    assert controller.at(0.2, 0.0) == (0.1, 0.0)
    assert change(controller.node, linear__x__max_velocity=0.05).successful
    assert controller.at(0.3, 0.0) == (0.05, 0.0)


def follow(controller, *places):
    """Send the straight path and odometry on it; the robot drives at full speed."""
    controller.send(STRAIGHT)
    for x in places:
        assert controller.at(x, 0.0) == (0.2, 0.0)


def test_slows_down_towards_the_end_and_drives_to_the_last_pose_as_to_a_goal(controller):
    follow(controller, 0.0, 0.2, 0.4, 0.6, 0.8)
    limits = {'linear__x__max_acceleration': 1.0, 'linear__x__max_deceleration': -0.1}
    assert change(controller.node, **limits).successful
    assert controller.at(0.9, 0.0)[0] == pytest.approx(math.sqrt(2.0 * 0.1 * 0.1))
    assert change(controller.node, **dict.fromkeys(limits, math.nan)).successful
    assert controller.at(0.975, 0.0)[0] == pytest.approx(math.sqrt(2.0 * 0.5 * 0.025))
    # The rest is shorter than the tolerance, but the robot is beside the path: as to a goal.
    v, omega = controller.at(0.99, 0.2)
    assert omega == pytest.approx(3.0 * math.atan2(-0.2, 0.01))
    assert v == pytest.approx(0.5 * 0.01)
    assert controller.at(1.0, 0.01) == (0.0, 0.0)
    assert controller.statuses == [(2, ACCEPTED), (2, EXECUTING), (2, SUCCEEDED)]


def test_the_same_path_again_goes_on_where_the_robot_is(lockstep, controller, capfd):
    """As from a node that publishes its path every second, also while odometry is missing."""
    follow(controller, 0.0, 0.2, 0.4, 0.6)
    controller.send(STRAIGHT)
    assert controller.at(0.8, 0.0) == (0.2, 0.0)
    lockstep.run_for(1.0)
    assert 'robot stopped, waiting' in capfd.readouterr().err
    controller.send(STRAIGHT)
    lockstep.run_for(1.0)
    assert controller.at(0.8, 0.0) == (0.2, 0.0)
    assert 'odometry is received again' in capfd.readouterr().err
    # Another one does not.
    controller.send(path((0, 0), (1, 0)))
    assert controller.at(0.8, 0.0)[0] < 0.0


def test_a_path_law_of_the_user_with_a_state_is_reset_after_the_robot_has_stood(lockstep):
    steps = []

    def law(pose, reference, *, state, dt):
        steps.append((state[0], dt))
        return 0.1, 0.0, [state[0] + 1.0]

    own = PathController(name='counting', law=law, gains=(), state=(0.0,))
    lockstep.listen(GoalStatus, 'goal_status')
    lockstep.add(GoToGoal(path_controller=own, parameter_overrides=overrides({'odom_timeout': 0.3})))
    lockstep.publish('path', STRAIGHT)
    for x in (0.0, 0.1):
        lockstep.publish('odom', odometry(x, 0.0, 0.0))
        lockstep.run_for(0.1)
    lockstep.run_for(0.5)
    lockstep.publish('path', STRAIGHT)
    lockstep.run_for(0.5)
    lockstep.publish('odom', odometry(0.2, 0.0, 0.0))
    assert steps == [(0.0, 0.0), (1.0, pytest.approx(0.1)), (0.0, 0.0)]


def test_goal_and_path_replace_each_other(controller):
    controller.send(goal(1, 0, stamp=1))
    assert controller.at(0, 0) == (0.5, 0.0)
    controller.send(STRAIGHT)
    assert controller.at(0, 0) == (0.2, 0.0)
    controller.send(goal(1, 0, stamp=3))
    assert controller.at(0, 0) == (0.5, 0.0)
    assert controller.statuses[2:5] == [(1, CANCELED), (2, ACCEPTED), (2, EXECUTING)]
