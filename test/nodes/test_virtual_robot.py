"""The node virtual_robot: its motion is a function of the commands and their instants alone."""

from __future__ import annotations

import math
from functools import reduce

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from support.lockstep_nodes import SECOND, Topics, make
from support.ros_messages import (
    WHEELS,
    covariance_of,
    instants,
    placement,
    pose_message,
    pose_of,
    time_of,
    twist,
    twists,
)

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.testing import Lockstep

TWISTS = [
    (0.0, 0.0),
    (0.22, 0.0),
    (-0.5, 0.0),
    (0.0, 1.0),
    (0.0, -7.3),
    (0.5, 3.0 * math.pi / 4.0),
    (-0.3, 1.7),
    (0.4, -1e-12),
    (1.0, 1e-5),
    (12.0, -40.0),
    (1000.0, 1000.0),
]


def way(seed, count):
    """Random commands `(v, omega)`, and how long each is held (s): a whole number of nanoseconds."""
    random = np.random.default_rng(seed)
    return [
        ((random.uniform(-0.5, 0.5), random.uniform(-2.0, 2.0)), int(random.integers(1e6, 6e7)) / 1e9)
        for _ in range(count)
    ]


def drive(world, commands):
    """Give the commands at their instants, and zero at the end."""
    for command, held in commands:
        world.publish('cmd_vel', twist(*command))
        world.run_for(held)
    world.publish('cmd_vel', Twist())


@pytest.mark.parametrize(
    ('pose', 'theta'),
    [
        ((1.0, -2.0, 4.0), 4.0 - math.tau),
        ((0.0, 0.0, 0.0), 0.0),
        ((-3.0, 5.0, math.pi), math.pi),
        ((-3.0, 5.0, -math.pi), math.pi),
        ((1e6, -1e6, math.tau), 0.0),
    ],
    ids=str,
)
def test_idle_robot_reports_its_initial_pose(lockstep, robot_at, pose, theta):
    topics = Topics(lockstep)
    robot_at(*pose, odom_frame_id='o')
    lockstep.run_for(0.1)
    assert instants(topics.odom) == [SECOND + SECOND // 50 * k for k in range(6)]
    assert instants(topics.states) == instants(topics.odom)
    expected = pose_message([*pose[:2], theta])
    for odometry, states in zip(topics.odom, topics.states, strict=True):
        assert odometry.pose.pose == expected
        assert (odometry.header.frame_id, odometry.child_frame_id) == ('o', 'base_link')
        assert not np.any(odometry.pose.covariance)
        assert odometry.twist.twist == Twist()
        assert list(states.name) == WHEELS
        assert list(states.position) == list(states.velocity) == [0.0, 0.0]
    late = Topics(lockstep)
    assert topics.applied == late.starts == []
    (start,) = topics.starts
    assert (start.pose.pose, time_of(start)) == (expected, SECOND)


def test_start_pose_is_latched(lockstep, robot_at):
    robot_at(1.0)
    lockstep.publish('initialpose', placement(2.0))
    latched = lockstep.listen(type(placement(0.0)), 'start_pose', latched=True)
    assert [one.pose.pose.position.x for one in latched] == [1.0, 2.0]


@pytest.mark.parametrize('rate', [0.1, 1.0, 3.0, 30.0, 50.0, 333.0, 1000.0])
def test_odometry_comes_at_the_multiples_of_its_period(lockstep, robot_at, rate):
    topics = Topics(lockstep)
    robot_at(publish_rate=rate)
    lockstep.run_for(20.0 / rate)
    period = int(SECOND / rate)
    # The node was made at time zero, before it learnt the time: one that was due by then comes at once.
    overdue = [SECOND] * (period <= SECOND)
    counted = range(SECOND // period + 1, lockstep.now // period + 1)
    assert instants(topics.odom) == overdue + [period * k for k in counted]
    assert len(counted) in (19, 20)


@pytest.mark.parametrize('command', TWISTS, ids=str)
def test_every_pose_lies_on_the_exact_arc_of_the_command(lockstep, robot_at, command):
    topics = Topics(lockstep)
    start = (-0.7, 2.0, 2.5)
    robot_at(*start, cmd_vel_timeout=0.0)
    lockstep.run_for(0.0123)
    begin = lockstep.now
    topics.odom.clear()
    topics.states.clear()
    lockstep.publish('cmd_vel', twist(*command))
    lockstep.run_for(1.0)
    assert len(topics.odom) == 50
    speeds = body_to_wheel(*command, 0.033, 0.16)
    for odometry, states in zip(topics.odom, topics.states, strict=True):
        dt = (time_of(odometry) - begin) / 1e9
        assert odometry.pose.pose == pose_message(se2.integrate(start, command, dt))
        assert odometry.twist.twist == twist(*command)
        right, left = speeds
        assert list(states.velocity) == [left, right]
        assert list(states.position) == [left * dt, right * dt]


def test_sixty_second_arc_is_exact(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(cmd_vel_timeout=0.0, publish_rate=1.0)
    lockstep.publish('cmd_vel', twist(0.22, 0.5))
    lockstep.run_for(60.0)
    radius, turn = 0.22 / 0.5, 0.5 * 60.0
    expected = [radius * math.sin(turn), radius * (1.0 - math.cos(turn)), se2.wrap_angle(turn)]
    assert pose_of(topics.odom[-1]) == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize('rate', [1.0, 3.0, 7.0, 10.0, 50.0, 100.0, 333.0, 1000.0])
def test_publish_rate_changes_no_bit_of_the_pose(lockstep, robot_at, rate):
    topics, usual = Topics(lockstep), Topics(lockstep, 'usual')
    robot_at(publish_rate=rate)
    robot_at(namespace='usual')
    commands = way(1, 20)
    for command, held in commands:
        for topic in ('cmd_vel', 'usual/cmd_vel'):
            lockstep.publish(topic, twist(*command))
        lockstep.run_for(held)
    for topic in ('cmd_vel', 'usual/cmd_vel'):
        lockstep.publish(topic, Twist())
    end = lockstep.now
    lockstep.run_until(
        lambda: min(instants([topics.odom[-1], usual.odom[-1]])) >= end, 1.02, 'both are at rest'
    )
    expected = reduce(lambda pose, one: se2.integrate(pose, *one), commands, np.zeros(3))
    assert topics.odom[-1].pose.pose == pose_message(expected)
    assert topics.odom[-1].pose == usual.odom[-1].pose
    assert np.all(np.diag(covariance_of(topics.odom[-1])) > 0.0)
    assert topics.states[-1].position == usual.states[-1].position


@pytest.mark.parametrize('seed', range(5))
def test_a_way_there_and_back_ends_where_it_began(lockstep, robot_at, seed):
    topics = Topics(lockstep)
    robot_at(1.0, 2.0, 3.0, cmd_vel_timeout=0.0)
    there = way(seed, 10)
    drive(lockstep, there)
    lockstep.run_for(0.02)
    assert math.dist(pose_of(topics.odom[-1])[:2], [1.0, 2.0]) > 0.002
    drive(lockstep, [((-v, -omega), held) for (v, omega), held in reversed(there)])
    lockstep.run_for(0.02)
    assert pose_of(topics.odom[-1]) == pytest.approx([1.0, 2.0, 3.0], abs=1e-14)
    assert list(topics.states[-1].position) == pytest.approx([0.0, 0.0], abs=1e-12)


def reproduce(applied, starts, instant):
    """Where `cmd_vel_out` and `start_pose` say that the robot is at an instant."""
    begin = max(
        (start for start in starts if time_of(start) <= instant),
        key=lambda start: time_of(start),
    )
    pose, now = pose_of(begin), time_of(begin)
    driven = (0.0, 0.0)
    for at, command in zip(instants(applied), twists(applied), strict=True):
        if at > instant:
            break
        if at > now:
            pose, now = se2.integrate(pose, driven, (at - now) / 1e9), at
        driven = command
    return se2.integrate(pose, driven, (instant - now) / 1e9)


@pytest.mark.parametrize('seed', range(4))
def test_cmd_vel_out_and_start_pose_tell_every_odometry_pose(lockstep, robot_at, seed):
    topics = Topics(lockstep)
    robot_at(cmd_vel_timeout=0.06, linear__x__max_velocity=0.4)
    random = np.random.default_rng(seed)
    for index in range(30):
        lockstep.publish('cmd_vel', twist(random.uniform(-1, 1), random.uniform(-3, 3)))
        # Now and then so long that the timeout strikes in between.
        lockstep.run_for(0.1 if index % 10 == 9 else random.uniform(0.001, 0.05))
        if index % 7 == 6:
            lockstep.publish('initialpose', placement(random.uniform(-5, 5), variances=(0.1, 0.0, 0.0)))
    lockstep.run_for(0.1)
    assert twists(topics.applied).count((0.0, 0.0)) == 3
    assert len(topics.applied) == 33
    assert len(topics.starts) == 5
    # A placement at the instant of an odometry message comes after it.
    odom = [
        one for one in topics.odom if one.header.stamp not in [s.header.stamp for s in topics.starts]
    ]
    errors = [pose_of(one) - reproduce(topics.applied, topics.starts, time_of(one)) for one in odom]
    assert np.max(np.abs(errors)) < 1e-13
    assert max(abs(one.twist.twist.linear.x) for one in topics.odom) == 0.4


def recorded(seed):
    """Drive a way in a world of its own; give all that the robot says."""
    with Lockstep() as world:
        topics = Topics(world)
        world.add(make(VirtualRobot, cmd_vel_timeout=0.03, wheel_travel_variance=1e-3))
        drive(world, way(seed, 20))
        world.run_for(0.5)
        return [*topics.odom, *topics.applied, *topics.states, *topics.starts]


@pytest.mark.parametrize('seed', range(3))
def test_the_same_commands_give_the_same_messages(seed):
    first = recorded(seed)
    assert len(first) > 100
    assert recorded(seed) == first
    assert recorded(seed + 1) != first


def test_heading_and_pose_stay_sound_over_many_commands(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(publish_rate=10.0)
    random = np.random.default_rng(4)
    for _ in range(500):
        lockstep.publish('cmd_vel', twist(*random.uniform(-1000, 1000, 2)))
        lockstep.run_for(0.1)
    poses = np.array([pose_of(one) for one in topics.odom])
    assert len(poses) == 501
    assert np.all(np.isfinite(poses))
    assert np.all(np.abs(poses[:, 2]) <= math.pi)
    assert [one.twist.linear.x for one in topics.applied] == [v for v, _ in twists(topics.commands)]
