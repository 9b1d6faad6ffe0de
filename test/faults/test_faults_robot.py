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

"""Faults of the robot: what its motors, wheels and encoders do, and where it truly is."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_srvs.srv import Trigger
from support.lockstep_nodes import Topics, change, make
from support.ros_messages import instants, pose_of, twist, twists

from diffdrive_jacobian.control import VelocityLimits
from diffdrive_jacobian.faults.world import Kill
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.kinematics.se2 import compose, integrate, inverse, wrap_angle
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.robot_testing.faults import (
    ActuatorLag,
    DeadWheel,
    EncoderSteps,
    Push,
    SaturatedWheel,
    Slip,
    WrongGeometry,
)
from diffdrive_jacobian.simulation import Robot, RobotModel
from diffdrive_jacobian.simulation.actuators import SETTLING, Actuators
from diffdrive_jacobian.simulation.encoders import Encoders
from diffdrive_jacobian.simulation.slip import Drift
from diffdrive_jacobian.testing import LockstepError

SECOND = 1_000_000_000
R, L = 0.033, 0.16
START = (0.3, -0.2, 2.9)


def at_rest(**model):
    return Robot(model=RobotModel(wheel_radius=R, wheel_separation=L, **model), stamp=0, pose=START)


def reached(tau, seconds):
    """Return the angle of a wheel that approaches 1 rad/s from rest, after a time."""
    return seconds - tau * (1.0 - math.exp(-seconds / tau))


def close(pose, expected, tolerance=1e-12):
    difference = np.asarray(pose) - np.asarray(expected)
    assert np.abs(difference[:2]).max() < tolerance
    assert abs(wrap_angle(difference[2])) < tolerance


# --- The robot as a value


def test_a_weak_motor_limits_its_own_wheel_after_the_limits_of_the_robot():
    limits = VelocityLimits(max_v=0.3)
    robot = at_rest(limits=limits, actuators=Actuators(max_right_speed=2.0)).commanded((5.0, 0.0), 0)
    assert robot.wheel_speeds == pytest.approx((2.0, 0.3 / R))
    back = robot.commanded((-5.0, 0.0), SECOND)
    assert back.wheel_speeds == pytest.approx((-2.0, -5.0 / R))
    slow = robot.commanded((0.03, 0.1), SECOND)
    # To the bit: what the motors can do is not touched.
    assert slow.twist == (0.03, 0.1)


def test_a_lagging_robot_reaches_the_command_and_is_then_an_ordinary_one():
    robot = at_rest(actuators=Actuators(lag=0.1)).commanded((0.2, 1.0), 0)
    assert robot.settles_at == round(SETTLING * 0.1 * SECOND)
    assert robot.at(robot.settles_at - 1).twist == pytest.approx((0.2, 1.0), rel=1e-15)
    assert robot.at(robot.settles_at).twist == robot.target == (0.2, 1.0)
    with pytest.raises(ValueError, match='cannot go back'):
        robot.at(SECOND).at(SECOND - 1)


def test_coarse_odometry_stays_within_an_increment_of_the_truth():
    rng = np.random.default_rng(4)
    increment = math.tau / 20
    robot = first = at_rest().commanded((0.3, 1.0), 0).at(SECOND // 7)
    start = np.floor(np.array(first.wheel_angles) / increment) * increment
    encoders, distance, worst = Encoders.at(first, 20), 0.0, 0.0
    for v, omega in rng.normal(0.0, [0.3, 2.0], (40, 2)):
        robot = robot.commanded((v, omega), robot.stamp)
        for _ in range(3):
            robot = robot.at(robot.stamp + SECOND // 50)
            encoders = encoders.read(robot)
            distance += abs(v) / 50.0
            seen = encoders.reported(robot)
            turned = np.subtract(robot.wheel_angles, first.wheel_angles)
            assert np.abs(seen.wheel_angles - start - turned).max() < increment
            assert abs(wrap_angle(seen.pose[2] - robot.pose[2])) < 2.0 * R * increment / L
            apart = math.dist(seen.pose[:2], robot.pose[:2])
            assert apart < 2.0 * R * increment + 2.0 * R * increment / L * distance
            worst = max(worst, apart)
    # The bound is not idle.
    assert worst > R * increment / 2.0


def test_a_slow_wheel_is_seen_as_bursts_of_whole_increments():
    robot = at_rest().commanded((R * 1.0, 0.0), 0)
    encoders = Encoders.at(robot, 10)
    speeds = []
    for tick in range(1, 51):
        encoders = encoders.read(robot.at(tick * SECOND // 50))
        speeds.append(encoders.speeds[0])
    # 1 rad in 1 s: one increment of 0.628 rad, seen in one period of 0.02 s.
    assert sorted(set(speeds)) == pytest.approx([0.0, math.tau / 10 * 50])
    assert speeds.count(0.0) == 49
    # Four increments in the next 3 s.
    assert encoders.read(robot.at(4 * SECOND)).speeds == pytest.approx((math.tau / 10 * 5 / 3.0,) * 2)
    assert encoders.read(robot.at(4 * SECOND).restarted(SECOND)).speeds == (0.0, 0.0)


@pytest.mark.parametrize('noticed', [False, True])
def test_a_push_is_a_motion_in_the_body_frame(noticed):
    push = (0.1, -0.05, 0.7)
    robot = at_rest(drift=Drift(left_wheel_radius_multiplier=1.2))
    robot = robot.placed(START, np.diag([1e-4, 2e-4, 3e-4]), 0).commanded((0.2, 0.4), 0)
    before = robot.at(SECOND)
    after = robot.pushed(push, SECOND, noticed=noticed)
    close(compose(inverse(before.true_pose), after.true_pose), push)
    close(after.pose, compose(before.pose, push) if noticed else before.pose)
    assert (after.twist, after.wheel_angles) == (before.twist, before.wheel_angles)
    assert after.covariance_tuple == before.covariance_tuple
    # Who reads the start_pose of a push can compute all that follows from it.
    anew = before.placed(after.pose, after.covariance, SECOND)
    assert (after.moments == anew.moments) == noticed
    # It drives on from there.
    driven = compose(inverse(before.true_pose), before.at(2 * SECOND).true_pose)
    close(after.at(2 * SECOND).true_pose, compose(after.true_pose, driven))


def test_a_push_that_the_odometry_does_not_notice_needs_a_truth():
    with pytest.raises(ValueError, match='model must have a drift'):
        at_rest().pushed((0.1, 0.0, 0.0), 0)


# --- The robot in a world


def drive(world, v=0.2, omega=0.0, topic='cmd_vel'):
    world.publish(topic, twist(v, omega))


def measured(topics):
    """Return the last twist of the odometry."""
    return twists([topics.odom[-1].twist])[0]


def test_a_motor_dies_under_a_command_and_lives_again(lockstep, robot_at):
    robot = robot_at(cmd_vel_timeout=0.0)
    topics = Topics(lockstep)
    lockstep.inject(DeadWheel('left', start=0.5, duration=0.5))
    drive(lockstep)
    lockstep.run_for(1.5)
    np.testing.assert_allclose(
        twists(topics.applied), [(0.2, 0.0), (0.1, 0.2 / L), (0.2, 0.0)], atol=1e-12
    )
    assert instants(topics.applied) == [SECOND, 3 * SECOND // 2, 2 * SECOND]
    expected = compose(integrate((0.1, 0.0, 0.0), (0.1, 0.2 / L), 0.5), (0.1, 0.0, 0.0))
    close(pose_of(topics.odom[-1]), expected, 1e-9)
    close(robot.truth, expected, 1e-9)
    assert topics.states[-1].position.tolist() == pytest.approx([0.2 / R, 0.2 / R * 1.5])


def test_a_lagging_robot_is_seen_in_its_odometry_and_commands(lockstep, robot_at):
    tau = 0.05
    robot_at(publish_rate=50.0)
    topics = Topics(lockstep)
    # The longest one counts.
    lockstep.inject(ActuatorLag(tau), ActuatorLag(0.01))
    drive(lockstep)
    began = lockstep.now
    lockstep.run_for(0.4)
    travelled = 0.2 * reached(tau, (lockstep.now - began) / SECOND)
    assert topics.odom[-1].pose.pose.position.x == pytest.approx(travelled, rel=1e-9)
    # Its timeout of 0.5 s is one of the commands, not of the steps.
    lockstep.run_for(0.6)
    assert topics.odom[-1].pose.pose.position.x == pytest.approx(0.2 * 0.5, abs=1e-4)
    # cmd_vel_out has the targets.
    assert [one.twist.linear.x for one in topics.applied][-2:] == [0.2, 0.0]
    assert np.diff(instants(topics.applied))[-1] == SECOND // 2


def test_coarse_encoders_are_seen_by_the_odometry_alone(lockstep, robot_at):
    robot_at(cmd_vel_timeout=0.0)
    topics = Topics(lockstep)
    truths = lockstep.listen(Odometry, 'ground_truth')
    lockstep.inject(EncoderSteps(16, start=0.2, duration=0.5))
    increment = math.tau / 16
    drive(lockstep, 0.2, 1.0)
    lockstep.run_for(0.9)
    exact = integrate((0.0, 0.0, 0.0), (0.2, 1.0), 0.9)
    close(pose_of(truths[-1]), exact, 1e-9)
    assert 1e-4 < math.dist(pose_of(topics.odom[-1])[:2], exact[:2]) < R * increment * (1.0 + 0.3 / L)
    # During the fault the angles are whole increments, and the twist is what was counted.
    during = slice(*np.searchsorted(instants(topics.states), [13 * SECOND // 10, 16 * SECOND // 10]))
    angles = np.array([one.position for one in topics.states[during]]) / increment
    assert np.abs(angles - np.round(angles)).max() < 1e-9
    assert len(set(angles[:, 0])) > 2
    velocities = np.array([one.velocity for one in topics.states[during]])[1:]
    np.testing.assert_allclose(velocities, np.diff(angles, axis=0) * increment * 50.0, atol=1e-9)
    # Afterwards the odometry goes on from where it was.
    jumps = np.diff([pose_of(one)[:2] for one in topics.odom], axis=0)
    assert np.hypot(*jumps.T).max() < R * increment + 0.2 / 50.0


def test_coarse_odometry_can_be_reset(lockstep, robot_at):
    robot = robot_at(x=0.5)
    lockstep.inject(EncoderSteps(16))
    drive(lockstep)
    lockstep.run_for(0.3)
    assert robot.pose[0] > 0.52
    drive(lockstep, 0.0)
    lockstep.call(Trigger, 'reset_odometry')
    close(robot.pose, (0.5, 0.0, 0.0))
    close(robot.truth, (0.56, 0.0, 0.0), 1e-9)


@pytest.mark.parametrize('noticed', [False, True])
def test_a_push_moves_the_odometry_only_if_it_is_noticed(lockstep, robot_at, noticed):
    robot = robot_at(x=1.0, theta=math.pi / 2.0)
    topics = Topics(lockstep)
    truths = lockstep.listen(Odometry, 'ground_truth')
    starts = lockstep.listen(PoseWithCovarianceStamped, 'start_pose')
    lockstep.inject(Push(0.1, 0.2, 0.3, start=0.1, noticed=noticed))
    lockstep.run_for(0.2)
    assert [(event.time_ns, event.what) for event in lockstep.fault_events] == [
        (100_000_000, 'begins'),
        (100_000_000, 'ends'),
    ]
    moved = (0.8, 0.1, math.pi / 2.0 + 0.3)
    close(robot.truth, moved)
    close(pose_of(topics.odom[-1]), moved if noticed else (1.0, 0.0, math.pi / 2.0))
    assert (len(starts), bool(truths)) == (noticed, not noticed)
    close(pose_of((starts or truths)[-1]), moved)


def test_wrong_geometry_multiplies_and_is_seen_by_the_truth_alone(lockstep, robot_at):
    robot = robot_at(cmd_vel_timeout=0.0, true_wheel_separation_multiplier=3.0)
    topics = Topics(lockstep)
    half = {'wheel_separation_multiplier': 0.5, 'start': 0.5, 'duration': 0.5}
    lockstep.inject(WrongGeometry(left_wheel_radius_multiplier=0.5, **half), WrongGeometry(**half))
    drive(lockstep)
    lockstep.run_for(1.4)
    # Half a second with 0.2 m/s at the right and 0.1 m/s at the left wheel.
    separation = 3.0 * 0.5 * 0.5 * L
    expected = integrate(integrate((0.1, 0.0, 0.0), (0.15, 0.1 / separation), 0.5), (0.2, 0.0), 0.4)
    close(robot.truth, expected, 1e-9)
    close(pose_of(topics.odom[-1]), (0.28, 0.0, 0.0), 1e-9)


def test_the_slip_follows_from_the_seed_of_the_injection(lockstep, robot_at):
    names = ('/a', '/b', '/c')
    robots = [robot_at(namespace=name) for name in names]
    for name, seed in zip(names, (1, 1, 2), strict=True):
        lockstep.inject(Slip(robot=f'{name}/virtual_robot', duration=0.1), seed=seed)
        drive(lockstep, topic=f'{name}/cmd_vel')
    lockstep.run_for(0.1)
    first = [robot.truth for robot in robots]
    assert all(np.abs(one - (0.02, 0.0, 0.0)).max() > 1e-6 for one in first)
    assert len({tuple(one) for one in first}) == 3
    lockstep.run_for(0.1)
    for robot, before in zip(robots, first, strict=True):
        close(robot.truth, compose(before, (0.02, 0.0, 0.0)), 1e-9)


def test_the_weakest_motor_counts_and_parameters_still_change(lockstep, robot_at):
    robot = robot_at(cmd_vel_timeout=0.0)
    topics = Topics(lockstep)
    lockstep.inject(
        SaturatedWheel('left', 2.0, start=0.1, duration=0.9),
        SaturatedWheel('left', 2.5, start=0.5),
        DeadWheel('right', start=0.7),
    )
    drive(lockstep)
    change(robot, linear__x__max_velocity=0.1)
    seen = []
    for _ in range(4):
        lockstep.run_for(0.3)
        seen.append(body_to_wheel(*measured(topics), R, L))
    full = 0.1 / R
    expected = np.array([(full, 2.0), (full, 2.0), (0.0, 2.0), (0.0, 2.5)])
    assert np.array(seen) == pytest.approx(expected, abs=1e-9)


def test_a_fault_applies_to_a_robot_that_comes_later_or_again(lockstep):
    lockstep.inject(DeadWheel('left'), Push(0.5), Kill('virtual_robot', start=0.2, duration=0.2))
    topics = Topics(lockstep)
    lockstep.create(lambda: make(VirtualRobot, cmd_vel_timeout=0.0))
    for expected in (0.5, 0.0):
        robot = lockstep.find('virtual_robot')
        close(robot.truth, (expected, 0.0, 0.0))
        drive(lockstep)
        lockstep.run_for(0.1)
        assert measured(topics) == pytest.approx((0.1, 0.2 / L))
        lockstep.run_for(0.3)
    lockstep.check_faults()


def test_a_fault_needs_a_robot_of_its_name(lockstep):
    lockstep.inject(DeadWheel('left', robot='robot'))
    lockstep.run_for(0.1)
    with pytest.raises(LockstepError, match=r'DeadWheel.*no node /robot was seen'):
        lockstep.check_faults()
    with pytest.raises(LockstepError, match='needs a VirtualRobot, but node /robot is a Node'):
        lockstep.add(Node('robot'))
