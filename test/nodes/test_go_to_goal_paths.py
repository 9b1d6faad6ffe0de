"""The node go_to_goal on paths: circles, trajectories, waypoints without stops, and paths it refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from std_srvs.srv import Trigger
from support.lockstep_nodes import (
    ABORTED,
    ACCEPTED,
    CANCELED,
    EXECUTING,
    SECOND,
    SUCCEEDED,
    Controller,
    Topics,
    arrives,
    change,
    make,
)
from support.ros_messages import goal, goals, odometry, path, pose_of, spoiled, twists

from diffdrive_jacobian.control import Path, PathController
from diffdrive_jacobian.control.controllers import PathControllers
from diffdrive_jacobian.messages.conversion import MAX_PATH_POSES
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot

LAWS = tuple(PathControllers())
STRAIGHT = path((0, 0), (0.5, 0), (1, 0), stamp=2)
FAST = {'path_speed': 0.5}
"""A speed that saves time."""


def circle(count, radius=1.0):
    angles = np.linspace(0.0, math.tau, count + 1)
    return [(radius * math.sin(a), radius * (1.0 - math.cos(a))) for a in angles]


def drive(lockstep, topic, message, *, start=(0.0, 0.0, 0.0), controller=None, **parameters):
    """Drive to the end; give the poses, shape (n, 3), the commands and the seconds it took."""
    topics = Topics(lockstep)
    x, y, theta = map(float, start)
    lockstep.add(make(VirtualRobot, x=x, y=y, theta=theta))
    lockstep.add(controller or make(GoToGoal, **parameters))
    lockstep.publish(topic, message)
    before = lockstep.now
    arrives(lockstep, topics, 60.0)
    seconds = (lockstep.now - before) / SECOND
    return np.array([pose_of(one) for one in topics.odom]), twists(topics.commands), seconds


@pytest.fixture
def controller(lockstep):
    return Controller(lockstep)


# --- Paths that are driven


@pytest.mark.parametrize('law', LAWS)
def test_a_path_is_reached_followed_and_driven_to_its_end_without_a_stop(lockstep, law):
    """A quarter of a circle, from beside it: within 1 cm after a part of it."""
    quarter = path(*circle(32)[:9])
    start = (-0.3, -0.2, 1.0)
    how = {**FAST, 'path_controller': law, 'lookahead_distance': 0.2}
    poses, commands, seconds = drive(lockstep, 'path', quarter, start=start, **how)
    late = poses[poses[:, 0] > 0.8]
    assert len(late) > 20
    assert abs(np.hypot(late[:, 0], late[:, 1] - 1.0) - 1.0).max() < 0.01
    assert commands[-1] == (0.0, 0.0)
    assert min(v for v, _ in commands[len(commands) // 2 : -1]) > 0.05
    assert math.dist(poses[-1, :2], (1.0, 1.0)) < 0.021
    assert math.pi / 2.0 / 0.5 < seconds < 7.0


def test_a_closed_path_is_driven_once_around(lockstep):
    poses, _, seconds = drive(lockstep, 'path', path(*circle(32, 0.3)), **FAST)
    assert abs(np.hypot(poses[:, 0], poses[:, 1] - 0.3) - 0.3).max() < 0.01
    assert math.dist(poses[-1, :2], (0.0, 0.0)) < 0.02
    assert abs(seconds - 0.6 * math.pi / 0.5) < 0.8


def test_a_robot_that_faces_backwards_turns_in_place(lockstep):
    poses, commands, _ = drive(lockstep, 'path', STRAIGHT, start=(0, 0, 3.0), **FAST)
    assert commands[0] == (0.0, -9.0)
    # From across the path it turns along a circle of half the look-ahead distance.
    assert abs(poses[:, 1]).max() < 0.12


@pytest.mark.parametrize('law', ['kanayama', 'dynamic_feedback'])
def test_a_trajectory_is_driven_at_its_times(lockstep, law):
    """A line at 0.2 m/s, a pause of 1 s, and at 0.3 m/s to the end."""
    times = [0.0, 1.0, 2.0, *np.linspace(2.0, 4.0, 5)[1:]]
    places = [0.0, 0.2, 0.2, *np.linspace(0.2, 0.8, 5)[1:]]
    message = path(*[(x, 0.0) for x in places], times=times)
    poses, commands, seconds = drive(lockstep, 'path', message, path_controller=law)
    assert abs(seconds - 4.0) < 1.0
    planned = Path(np.array([(x, 0.0) for x in places]), np.array(times))
    # The robot answers the first odometry.
    expected = [planned.at_time(0.02 * step).x for step in range(190)]
    assert abs(poses[:190, 0] - expected).max() < 0.08
    assert max(abs(v) for v, _ in commands[85:95]) < 0.08


def test_a_user_has_a_law_of_his_own(lockstep):
    def law(poses, references, gain):
        x, y, theta, v, omega, *_ = np.moveaxis(references, -1, 0)
        left = np.cos(theta) * (poses[..., 1] - y) - np.sin(theta) * (poses[..., 0] - x)
        return v, omega - gain * left - 2.0 * np.sin(poses[..., 2] - theta)

    mine = PathController(name='mine', law=law, gains=(PathControllers().find('kanayama').gains[1],))
    node = GoToGoal(path_controller=mine)
    assert node.get_parameter('path_controller').value == 'mine'
    assert change(node, **FAST).successful
    poses, _, _ = drive(lockstep, 'path', path(*circle(32, radius=0.5)[:17]), controller=node)
    assert abs(np.hypot(poses[:, 0], poses[:, 1] - 0.5) - 0.5).max() < 1e-2


# --- Commands on a path


def test_a_trajectory_waits_while_odometry_is_missing(lockstep):
    controller = Controller(lockstep, path_controller='kanayama')
    controller.send(path((0, 0), (10, 0), times=[0, 100]))
    assert controller.at(0, 0) == pytest.approx((0.1, 0.0))
    lockstep.run_for(5.0)
    assert controller.at(0.05, 0.0) == pytest.approx((0.1, 0.0))


def test_parameters_change_while_it_drives(controller):
    controller.send(STRAIGHT)
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
    assert controller.at(0.975, 0.0)[0] == pytest.approx(math.sqrt(2.0 * 0.5 * 0.025))
    # The rest is shorter than the tolerance, but the robot is beside the path: as to a goal.
    v, omega = controller.at(0.99, 0.2)
    assert omega == pytest.approx(3.0 * math.atan2(-0.2, 0.01))
    assert v == pytest.approx(0.5 * 0.01)
    assert controller.at(1.0, 0.01) == (0.0, 0.0)
    assert controller.statuses == [(2, ACCEPTED), (2, EXECUTING), (2, SUCCEEDED)]


def test_the_robot_can_stop_at_the_end_within_its_limits(controller):
    """By the taper, which knows them."""
    follow(controller, 0.0, 0.2, 0.4, 0.6, 0.8)
    limits = {'linear__x__max_acceleration': 1.0, 'linear__x__max_deceleration': -0.1}
    assert change(controller.node, **limits).successful
    taper = math.sqrt(2.0 * 0.1 * 0.1)
    assert controller.at(0.9, 0.0)[0] == pytest.approx(taper)


def test_a_robot_far_from_the_start_does_not_skip_the_path(controller):
    for place in [(1.0, 0.0), (0.7, 2.0), (3.0, 0.0)]:
        controller.send(path(*((0.5 * index - 4.0, 0.0) for index in range(11)), stamp=2))
        for _ in range(20):
            controller.at(*place)
        assert controller.node.waypoint <= 1
        assert controller.statuses[-2:] == [(2, ACCEPTED), (2, EXECUTING)]
        controller.send(goal(0, 0))


def test_the_same_path_again_goes_on_where_the_robot_is(controller):
    """As from a node that publishes its path every second."""
    follow(controller, 0.0, 0.2, 0.4, 0.6)
    controller.send(STRAIGHT)
    assert controller.at(0.8, 0.0) == (0.2, 0.0)
    controller.send(path((0, 0), (1, 0)))
    assert controller.at(0.8, 0.0)[0] < 0.0


def test_goal_and_path_replace_each_other_and_cancel_stops(lockstep, controller):
    controller.send(goal(1, 0, stamp=1))
    controller.at(0, 0)
    controller.send(STRAIGHT)
    assert controller.at(0, 0) == (0.2, 0.0)
    controller.send(path((0, 0), (0, 1), stamp=3))
    controller.at(0, 0, math.pi / 2.0)
    controller.send(goal(1, 0, stamp=4))
    assert controller.at(0, 0) == (0.5, 0.0)
    controller.send(path((0, 0), (1, 0), stamp=5))
    controller.at(0, 0)
    assert lockstep.call(Trigger, 'cancel_goal').success
    assert twists(controller.commands)[-1] == (0.0, 0.0)
    assert controller.sees(odometry(0, 0, 0)) == []
    ends = [one for one in controller.statuses if one[1] == CANCELED]
    assert ends == [(stamp, CANCELED) for stamp in (1, 2, 3, 4, 5)]


def test_some_positions_may_be_repeated(controller):
    controller.send(path((0, 0), (0, 0), (1, 0), (1, 0), (1, 1), stamp=1))
    assert controller.at(0, 0) == (0.2, 0.0)


# --- Paths that are refused

TOO_LONG = path((0, 0), (1, 0), stamp=2)
TOO_LONG.poses = TOO_LONG.poses * (MAX_PATH_POSES // 2 + 1)
BAD = [
    (path(stamp=2), 'at least two poses, got 0 (to stop, call cancel_goal'),
    (path((1, 0), stamp=2), 'at least two poses, got 1'),
    (path((1, 0), (1, 0), (1, 0), stamp=2), 'two different positions, got 3 in one place'),
    (path((0, 0), (1, math.nan), stamp=2), 'y nan'),
    (path((0, 0), (1, 0), (2, 0), stamp=2, times=[1, 3, 2]), 'got 2.000000000 s after 3'),
    (path((0, 0), (1, 0), (2, 0), stamp=2, times=[1, 1, 2]), 'must increase, or all be equal'),
    (path((0, 0), (1, 0), frame='map', stamp=2), "the odometry, 'odom' or '' for it, got 'map'"),
    (path(goal(0, 0, frame='a'), goal(1, 0, frame='b'), stamp=2), "one frame, got ['a', 'b']"),
    (path((0, 0), spoiled(goal(1, 0), 'pose.orientation.w', 0.0), stamp=2), 'length 1'),
    (TOO_LONG, f'at most {MAX_PATH_POSES} poses, got {MAX_PATH_POSES + 2}'),
]


def test_a_bad_path_is_refused_and_the_active_one_goes_on(controller, capfd):
    controller.send(path((0, 0), (1, 0), frame='odom', stamp=1))
    controller.at(0, 0)
    for message, words in BAD:
        controller.send(message)
        assert controller.at(0, 0) == (0.2, 0.0)
        assert controller.statuses[-3:] == [(1, EXECUTING), (2, ABORTED), (1, EXECUTING)]
        error = capfd.readouterr().err
        assert 'goal refused: ' in error
        assert words in error


def test_a_path_that_is_too_far_is_refused_if_asked(lockstep, capfd):
    controller = Controller(lockstep, max_path_distance=0.5)
    controller.send(path((0, 0.6), (1, 0.6), stamp=1))
    assert controller.sees(odometry(0, 0, 0)) == []
    assert controller.statuses == [(1, ACCEPTED), (1, ABORTED)]
    assert 'within max_path_distance, 0.5 m, of the robot, got 0.6 m' in capfd.readouterr().err
    controller.send(path((0, 0.4), (1, 0.4), stamp=2))
    assert controller.at(0, 0)[0] > 0.0


# --- Waypoints


def nearest(poses, point):
    return np.hypot(*(poses[:, :2] - point).T).min()


def test_passes_waypoints_without_stopping(lockstep):
    """Half a circle of 1 m through eight waypoints takes 50 s with eight stops."""
    points = circle(16)[1:9]
    message = goals(*[goal(*one) for one in points])
    poses, commands, seconds = drive(lockstep, 'goals', message, pass_waypoints=True, **FAST)
    assert seconds < 9.0
    assert commands[-1] == (0.0, 0.0)
    # It turns at the start only: the first waypoint is not ahead.
    assert min(v for v, _ in commands[25:-1]) > 0.05
    assert max(nearest(poses, point) for point in points) < 0.1


def test_a_waypoint_that_was_missed_is_driven_to(lockstep, capfd):
    corner = [(0.3, 0.0), (0.6, 0.0), (0.6, 0.3), (0.6, 0.6)]
    how = {'pass_waypoints': True, 'lookahead_distance': 0.3, 'waypoint_tolerance': 0.02, 'kv': 2.0}
    poses, _, _ = drive(lockstep, 'goals', goals(*[goal(*one) for one in corner]), **how)
    assert 'waypoint 2 of 4 was passed at more than waypoint_tolerance, 0.02 m' in capfd.readouterr().err
    assert max(nearest(poses, point) for point in corner) <= 0.02


def test_waypoints_where_the_robot_is_are_reached(lockstep):
    controller = Controller(lockstep, pass_waypoints=True)
    controller.send(goals(goal(1, 0), goal(1, 0), stamp=1))
    assert controller.at(1, 0) == (0.0, 0.0)
    assert controller.statuses[-1] == (1, SUCCEEDED)
