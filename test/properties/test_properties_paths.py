"""Staying on a path: kept by go_to_goal, and violated by a node that cuts corners, or does not drive."""

from __future__ import annotations

import math

import pytest
from nav_msgs.msg import Path
from property_nodes import Sender, goal_at, odometry_at
from support.lockstep_nodes import change, make
from support.ros_messages import path

from diffdrive_jacobian.control import circle_path, figure_eight_path
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.properties import StaysOnPath
from diffdrive_jacobian.testing import PropertyViolation


def message_of(shape):
    return path(*shape.poses.tolist())


@pytest.mark.parametrize('shape', [circle_path(1.0), figure_eight_path(1.0)], ids=['circle', 'eight'])
def test_go_to_goal_stays_on_a_path(lockstep, robot_at, shape):
    lockstep.require(StaysOnPath(0.03, within=40.0))
    robot_at()
    lockstep.add(make(GoToGoal))
    lockstep.publish('path', message_of(shape))
    lockstep.run_for(40.0)
    lockstep.finish()


def test_a_controller_that_looks_far_ahead_cuts_the_eight(lockstep, robot_at):
    lockstep.require(StaysOnPath(0.03))
    robot_at()
    change(lockstep.add(make(GoToGoal)), lookahead_distance=0.8)
    lockstep.publish('path', message_of(figure_eight_path(1.0)))
    with pytest.raises(PropertyViolation, match=r'm from the path and .* allowed: 0.03 m from'):
        lockstep.run_for(30.0)


@pytest.fixture
def send(lockstep):
    return Sender(lockstep)


def test_a_robot_that_does_not_drive_is_late(lockstep, send):
    lockstep.require(StaysOnPath(0.1, within=1.0))
    send('odom', odometry_at(0.0))
    send('path', path((0, 0), (1, 0)))
    send('odom', odometry_at(0.5))
    with pytest.raises(PropertyViolation, match='1 s after the path was published the robot is'):
        lockstep.run_for(1.1)


def test_the_end_must_be_reached_before_the_run_ends(lockstep, send):
    lockstep.require(StaysOnPath(0.1, within=1.0))
    send('path', path((0, 0), (1, 0)))
    send('odom', odometry_at(0.2))
    lockstep.run_for(0.5)
    with pytest.raises(PropertyViolation, match=r'the run ended 0.5 s after the path .* 0.2 m along'):
        lockstep.finish()


@pytest.mark.parametrize(
    ('pose', 'kept'), [((0.5, 0.1), True), ((0.5, -0.1001), False), ((math.nan, 0.0), False)]
)
def test_the_distance_counts_after_the_first_metre(lockstep, send, pose, kept):
    lockstep.require(StaysOnPath(0.1, after=0.25))
    send('path', path((0, 0), (1, 0)))
    send('odom', odometry_at(0.0, 1.0))
    send('odom', odometry_at(*pose))
    if kept:
        lockstep.run_for(0.1)
        lockstep.finish()
        return
    with pytest.raises(PropertyViolation, match='allowed: '):
        lockstep.run_for(0.1)


@pytest.mark.parametrize(
    ('topic', 'message'),
    [('goal_pose', goal_at(1.0)), ('path', path((0, 9), (1, 9))), ('path', path()), ('path', b'')],
)
def test_a_path_that_is_replaced_does_not_count(lockstep, send, topic, message):
    lockstep.require(StaysOnPath(0.1))
    send('path', path((0, 0), (1, 0)))
    if isinstance(message, bytes):
        lockstep.node.create_publisher(Path, topic, 10).publish(message)
    else:
        send(topic, message)
    send('odom', odometry_at(0.0, 9.0))
    lockstep.run_for(0.1)
    lockstep.finish()
