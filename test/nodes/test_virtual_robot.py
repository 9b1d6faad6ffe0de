"""The node virtual_robot: its motion is a function of the commands and their times alone."""

from __future__ import annotations

import math
from functools import reduce

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from support.lockstep_nodes import SECOND, Topics, change
from support.ros_messages import (
    WHEELS,
    covariance_of,
    instants,
    joint_command,
    placement,
    pose_message,
    pose_of,
    time_of,
    twist,
    twist_stamped,
    twists,
)

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge

UNEQUAL = {
    'left_wheel_radius_multiplier': 0.9,
    'right_wheel_radius_multiplier': 1.05,
    'wheel_separation_multiplier': 1.2,
}
"""Multipliers of the assumed dimensions, as a calibration finds them."""


def way(seed, count):
    """Random commands `(v, omega)`, and how long each is held (s): a whole number of nanoseconds."""
    random = np.random.default_rng(seed)
    return [
        ((random.uniform(-0.5, 0.5), random.uniform(-2.0, 2.0)), int(random.integers(1e6, 6e7)) / 1e9)
        for _ in range(count)
    ]


def drive(world, commands, topics=('cmd_vel',)):
    """Give the commands at their times, and zero at the end."""
    for command, held in commands:
        for topic in topics:
            world.publish(topic, twist(*command))
        world.run_for(held)
    for topic in topics:
        world.publish(topic, Twist())


@pytest.mark.parametrize(
    ('pose', 'theta'),
    [
        ((1.0, -2.0, 4.0), 4.0 - math.tau),
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
    assert topics.applied == []
    (start,) = topics.starts
    assert (start.pose.pose, time_of(start)) == (expected, SECOND)
    # It is latched.
    lockstep.publish('initialpose', placement(2.0))
    latched = lockstep.listen(type(start), 'start_pose', latched=True)
    assert [one.pose.pose.position.x for one in latched] == [pose[0], 2.0]


@pytest.mark.parametrize('rate', [0.1, 3.0, 50.0, 333.0])
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


@pytest.mark.parametrize(
    ('interface', 'multipliers'), [('twist', {}), ('wheels', {}), ('wheels', UNEQUAL)]
)
def test_every_pose_lies_on_the_exact_arc_of_the_command(lockstep, robot_at, interface, multipliers):
    topics, start = Topics(lockstep), np.array([-0.7, 2.0, 2.5])
    robot_at(*start, command_interface=interface, cmd_vel_timeout=0.0, **multipliers)
    lockstep.run_for(0.0123)
    wheel = {name: multipliers.get(name, 1.0) for name in UNEQUAL}
    left_radius, right_radius, separation = np.array([0.033, 0.033, 0.16]) * list(wheel.values())
    angles = np.zeros(2)
    for command in [
        *[(0.22, 0.0), (0.0, -7.3), (-0.5, 3.0 * math.pi / 4.0), (0.4, -1e-12), (1.0, 1e-5)],
        *[(1000.0, 1000.0), (0.0, 0.0)],
    ]:
        v, omega = command
        rims = v - omega * separation / 2.0, v + omega * separation / 2.0
        speeds = np.divide(rims, (left_radius, right_radius))
        begin = lockstep.now
        topics.odom.clear()
        topics.states.clear()
        if interface == 'twist':
            lockstep.publish('cmd_vel', twist(*command))
        else:
            lockstep.publish('joint_command', joint_command(*speeds))
        driven = twists(topics.applied)[-1]
        assert driven == (command if interface == 'twist' else pytest.approx(command, abs=1e-11))
        lockstep.run_for(0.2)
        assert len(topics.odom) == 10
        for odometry, states in zip(topics.odom, topics.states, strict=True):
            dt = (time_of(odometry) - begin) / 1e9
            # To the last bit where the robot does nothing else.
            expected = pose_message(se2.integrate(start, driven, dt))
            assert odometry.pose.pose == expected
            assert odometry.twist.twist == twist(*driven)
            assert list(states.velocity) == pytest.approx(speeds, rel=1e-12, abs=1e-11)
            assert list(states.position) == pytest.approx(angles + speeds * dt, rel=1e-12, abs=1e-10)
        start, angles = se2.integrate(start, driven, 0.2), angles + speeds * 0.2


def test_publish_rate_changes_no_bit_of_the_pose(lockstep, robot_at):
    names, commands = ['a', 'b', 'c'], way(1, 12)
    for name, rate in zip(names, (7.0, 50.0, 333.0), strict=True):
        robot_at(namespace=name, publish_rate=rate)
    one, *others = (Topics(lockstep, name) for name in names)
    drive(lockstep, commands, [f'{name}/cmd_vel' for name in names])
    lockstep.run_for(0.2)
    expected = reduce(lambda pose, one: se2.integrate(pose, *one), commands, np.zeros(3))
    assert one.odom[-1].pose.pose == pose_message(expected)
    assert np.all(np.diag(covariance_of(one.odom[-1])) > 0.0)
    for other in others:
        assert other.odom[-1].pose == one.odom[-1].pose
        assert other.states[-1].position == one.states[-1].position


def reproduce(applied, starts, instant):
    """Where `cmd_vel_out` and `start_pose` say that the robot is at a time."""
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


@pytest.mark.parametrize('seed', range(2))
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
    # A placement at the time of an odometry message comes after it.
    odom = [
        one for one in topics.odom if one.header.stamp not in [s.header.stamp for s in topics.starts]
    ]
    errors = [pose_of(one) - reproduce(topics.applied, topics.starts, time_of(one)) for one in odom]
    assert np.max(np.abs(errors)) < 1e-13
    assert max(abs(one.twist.twist.linear.x) for one in topics.odom) == 0.4


# --- Driven by its wheels


@pytest.mark.parametrize('multipliers', [{}, UNEQUAL], ids=['nominal', 'calibrated'])
def test_wheels_and_twist_end_at_the_same_pose(lockstep, add, multipliers):
    stamped, limits = {'enable_stamped_cmd_vel': True}, {'max_wheel_velocity': 9.0}
    add(VirtualRobot, 'a', **stamped, **limits, **multipliers)
    add(VirtualRobot, 'b', command_interface='wheels', **limits, **multipliers)
    add(WheelBridge, 'b', **stamped, **multipliers)
    one, other = (Topics(lockstep, name, command=TwistStamped) for name in 'ab')
    random = np.random.default_rng(3)
    lockstep.run_for(0.3)
    for _ in range(15):
        lockstep.run_for(int(random.integers(10_000_000, 300_000_000)) / 1e9)
        command = twist_stamped(
            random.uniform(-1, 1), random.uniform(-4, 4), lockstep.now - int(random.integers(1e7))
        )
        sent = lockstep.now
        for name in 'ab':
            lockstep.publish(f'{name}/cmd_vel', command)
    lockstep.run_for(1.2)
    # The bridge sends a zero of its own; the timeout of the robot counts from the stamp, and is first.
    ours, theirs = instants(one.applied), instants(other.applied)
    assert theirs == [*ours, sent + SECOND // 2]
    assert len(ours) == 16
    assert np.hypot(*pose_of(one.odom[-1])[:2]) > 0.01
    assert pose_of(one.odom[-1]) == pytest.approx(pose_of(other.odom[-1]), abs=1e-14)
    assert covariance_of(one.odom[-1]) == pytest.approx(covariance_of(other.odom[-1]), abs=1e-14)


def test_wheel_speeds_stay_when_the_wheels_change_and_are_limited_alike(lockstep, robot_at):
    topics = Topics(lockstep)
    robot = robot_at(command_interface='wheels')
    lockstep.publish('joint_command', joint_command(5.0, 10.0))
    lockstep.run_for(0.2)
    assert change(robot, wheel_radius=0.066).successful
    lockstep.run_for(1.0)
    first, second, zero = twists(topics.applied)
    assert second == pytest.approx((2.0 * first[0], 2.0 * first[1]), rel=1e-15)
    assert zero == (0.0, 0.0)
    # The timeout counts from the command.
    assert instants(topics.applied) == [SECOND, SECOND + SECOND // 5, SECOND + SECOND // 2]
    assert list(topics.states[-1].position) == pytest.approx([2.5, 5.0], rel=1e-14)
    for fastest, factor in ((5.0, 0.5), (10.0, 1.0), (math.nan, 1.0), (1.0, 0.1)):
        assert change(robot, max_wheel_velocity=fastest).successful
        lockstep.publish('joint_command', joint_command(-4.0, 10.0))
        lockstep.run_for(0.1)
        speeds = list(topics.states[-1].velocity)
        assert speeds == pytest.approx([-4.0 * factor, 10.0 * factor], rel=1e-14)


def test_the_faster_of_unequal_wheels_has_the_limit(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(max_wheel_velocity=9.0, **UNEQUAL)
    for command in [(1.0, 0.0), (0.0, 9.0), (1.0, 5.0), (1.0, -5.0)]:
        lockstep.publish('cmd_vel', twist(*command))
        lockstep.run_for(0.1)
        assert max(map(abs, topics.states[-1].velocity)) == pytest.approx(9.0)
        v, omega = twists(topics.applied)[-1]
        assert v * command[1] == pytest.approx(omega * command[0], abs=1e-12)


def test_other_wheels_turn_otherwise_and_the_robot_drives_on(lockstep, robot_at):
    topics = Topics(lockstep)
    robot = robot_at()
    lockstep.publish('cmd_vel', twist(1.0, 2.0))
    lockstep.run_for(0.2)
    assert change(robot, wheel_radius=0.1, wheel_separation=0.08).successful
    lockstep.run_for(0.2)
    (right_before, left_before), (right, left) = (
        body_to_wheel(1.0, 2.0, *wheels) for wheels in ((0.033, 0.16), (0.1, 0.08))
    )
    assert list(topics.states[-1].velocity) == [left, right]
    expected = [0.2 * (left_before + left), 0.2 * (right_before + right)]
    assert list(topics.states[-1].position) == pytest.approx(expected, rel=1e-14)
    assert pose_of(topics.odom[-1]) == pytest.approx(se2.integrate([0, 0, 0], [1, 2], 0.4), abs=1e-15)
    assert len(topics.applied) == 1
