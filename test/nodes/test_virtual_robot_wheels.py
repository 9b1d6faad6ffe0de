"""The node virtual_robot driven by its wheels: the same motion as by twists."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from support.lockstep_nodes import SECOND, Topics, change
from support.ros_messages import (
    covariance_of,
    instants,
    joint_command,
    pose_message,
    pose_of,
    twist,
    twist_stamped,
    twists,
)

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.diff_drive import wheel_to_body
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge

UNEQUAL = {
    'left_wheel_radius_multiplier': 0.9,
    'right_wheel_radius_multiplier': 1.05,
    'wheel_separation_multiplier': 1.2,
}
"""Multipliers of the assumed dimensions, as a calibration finds them."""


@pytest.mark.parametrize(
    ('left', 'right'),
    [(0.0, 0.0), (5.0, 5.0), (-5.0, 5.0), (0.0, 10.0), (10.0, 0.0), (-3.0, -8.0), (100.0, -99.0)],
)
def test_wheel_speeds_give_the_exact_arc_of_their_twist(lockstep, robot_at, left, right):
    topics = Topics(lockstep)
    start = [1.0, -1.0, 0.5]
    robot_at(*start, command_interface='wheels')
    lockstep.publish('joint_command', joint_command(left, right))
    lockstep.run_for(0.48)
    expected = wheel_to_body(right, left, 0.033, 0.16)
    assert twists(topics.applied) == [expected]
    assert topics.odom[-1].pose.pose == pose_message(se2.integrate(start, expected, 0.48))
    assert list(topics.states[-1].velocity) == pytest.approx([left, right], abs=1e-13)
    assert list(topics.states[-1].position) == pytest.approx([0.48 * left, 0.48 * right], abs=1e-13)
    lockstep.run_for(0.52)
    assert topics.odom[-1].pose.pose == pose_message(se2.integrate(start, expected, 0.5))


def test_wheel_speeds_of_unequal_wheels_give_the_arc_of_both_rims(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(command_interface='wheels', **UNEQUAL)
    lockstep.publish('joint_command', joint_command(5.0, 8.0))
    lockstep.run_for(0.4)
    right, left, L = 8.0 * 0.033 * 1.05, 5.0 * 0.033 * 0.9, 0.16 * 1.2
    assert twists(topics.applied) == [pytest.approx(((right + left) / 2.0, (right - left) / L))]
    expected = se2.integrate([0.0, 0.0, 0.0], ((right + left) / 2.0, (right - left) / L), 0.4)
    assert pose_of(topics.odom[-1]) == pytest.approx(expected, abs=1e-12)
    assert list(topics.states[-1].velocity) == pytest.approx([5.0, 8.0])
    assert list(topics.states[-1].position) == pytest.approx([2.0, 3.2])


@pytest.mark.parametrize('command', [(1.0, 0.0), (0.0, 9.0), (1.0, 5.0), (1.0, -5.0)], ids=str)
def test_the_faster_of_unequal_wheels_has_the_limit(lockstep, robot_at, command):
    topics = Topics(lockstep)
    robot_at(max_wheel_velocity=9.0, **UNEQUAL)
    lockstep.publish('cmd_vel', twist(*command))
    lockstep.run_for(0.1)
    assert max(map(abs, topics.states[-1].velocity)) == pytest.approx(9.0)
    v, omega = twists(topics.applied)[-1]
    assert v * command[1] == pytest.approx(omega * command[0], abs=1e-12)


@pytest.mark.parametrize('multipliers', [{}, UNEQUAL], ids=['nominal', 'calibrated'])
@pytest.mark.parametrize('seed', range(3))
def test_wheels_and_twist_end_at_the_same_pose(lockstep, add, seed, multipliers):
    stamped, limits = {'enable_stamped_cmd_vel': True}, {'max_wheel_velocity': 9.0}
    add(VirtualRobot, 'a', **stamped, **limits, **multipliers)
    add(VirtualRobot, 'b', command_interface='wheels', **limits, **multipliers)
    add(WheelBridge, 'b', **stamped, **multipliers)
    one, other = (Topics(lockstep, name, command=TwistStamped) for name in 'ab')
    random = np.random.default_rng(seed)
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


@pytest.mark.parametrize(
    'command', [(0.2, 0.0), (0.0, 2.0), (-0.1, -1.0), (0.5, 3.0), (1e-9, 1e-9)], ids=str
)
@pytest.mark.parametrize('wheels', [(0.033, 0.16), (0.03575, 0.233), (0.5, 2.0)], ids=str)
def test_bridge_and_wheels_are_inverse_to_each_other(lockstep, add, wheels, command):
    radius, separation = wheels
    geometry = {'wheel_radius': radius, 'wheel_separation': separation}
    topics = Topics(lockstep)
    add(VirtualRobot, command_interface='wheels', **geometry)
    add(WheelBridge, **geometry)
    lockstep.publish('cmd_vel', twist(*command))
    (driven,) = twists(topics.applied)
    assert driven == pytest.approx(command, rel=1e-14, abs=1e-16)


def test_wheel_speeds_stay_when_the_wheels_change(lockstep, robot_at):
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


@pytest.mark.parametrize(('fastest', 'factor'), [(5.0, 0.5), (10.0, 1.0), (math.nan, 1.0), (1.0, 0.1)])
def test_wheel_limit_slows_both_wheels_alike(lockstep, robot_at, fastest, factor):
    topics = Topics(lockstep)
    robot_at(command_interface='wheels', max_wheel_velocity=fastest)
    lockstep.publish('joint_command', joint_command(-4.0, 10.0))
    lockstep.run_for(0.1)
    speeds = list(topics.states[-1].velocity)
    assert speeds == pytest.approx([-4.0 * factor, 10.0 * factor], rel=1e-14)


def test_stamped_wheel_speeds_act_from_their_stamp_on(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(command_interface='wheels')
    lockstep.run_for(1.0)
    now = lockstep.now
    lockstep.publish('joint_command', joint_command(5.0, 5.0, now - SECOND // 10))
    lockstep.publish('joint_command', joint_command(5.0, 5.0, now + 1))
    lockstep.publish('joint_command', joint_command(5.0, 5.0, now - SECOND // 5))
    lockstep.run_for(1.0)
    assert instants(topics.applied) == [now - SECOND // 10, now + 4 * (SECOND // 10)]
    assert pose_of(topics.odom[-1])[0] == pytest.approx(0.5 * 5.0 * 0.033, rel=1e-15)
