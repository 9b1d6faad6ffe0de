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

"""The node virtual_robot: its motion is a function of the commands and their times alone. Its parameters
change while it drives."""

from __future__ import annotations

import math
from importlib.util import find_spec

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from std_srvs.srv import Trigger
from support.lockstep_nodes import SECOND, Topics, change, comes_after
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
    value_of,
)

from diffdrive_jacobian.control import VelocityLimits, saturate
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.messages.codecs import ODOMETRY
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot, transform_of
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge

UNEQUAL = {
    'left_wheel_radius_multiplier': 0.9,
    'right_wheel_radius_multiplier': 1.05,
    'wheel_separation_multiplier': 1.2,
}
"""Multipliers of the assumed dimensions, as a calibration finds them."""


@pytest.fixture
def driving(lockstep, add):
    """A robot that is told at t = 1 s to drive at 1 m/s, with its topics."""
    topics = Topics(lockstep)
    topics.robot = add(VirtualRobot)
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    return topics


# --- Motion


def test_an_idle_robot_reports_its_initial_pose(lockstep, add):
    topics = Topics(lockstep)
    add(VirtualRobot, x=1.0, y=-2.0, theta=4.0, odom_frame_id='o')
    lockstep.run_for(0.1)
    assert instants(topics.odom) == [SECOND + SECOND // 50 * k for k in range(6)]
    assert instants(topics.states) == instants(topics.odom)
    odometry, states = topics.odom[-1], topics.states[-1]
    expected = pose_message([1.0, -2.0, 4.0 - math.tau])
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
    assert [one.pose.pose.position.x for one in latched] == [1.0, 2.0]


def test_publish_rate_sets_the_times_of_odometry_and_changes_no_bit_of_the_pose(lockstep, add):
    rates = {'a': 7.0, 'b': 333.0}
    robots = {name: Topics(lockstep, name) for name in rates}
    for name, rate in rates.items():
        add(VirtualRobot, name, publish_rate=rate)
    random, pose = np.random.default_rng(1), np.zeros(3)
    for _ in range(12):
        command = random.uniform(-0.5, 0.5), random.uniform(-2.0, 2.0)
        # A whole number of nanoseconds.
        held = int(random.integers(1e6, 6e7)) / 1e9
        for name in rates:
            lockstep.publish(f'{name}/cmd_vel', twist(*command))
        lockstep.run_for(held)
        pose = se2.integrate(pose, command, held)
    for name in rates:
        lockstep.publish(f'{name}/cmd_vel', Twist())
    lockstep.run_for(0.2)
    one = robots['a']
    assert one.odom[-1].pose.pose == pose_message(pose)
    assert np.all(np.diag(covariance_of(one.odom[-1])) > 0.0)
    for name, topics in robots.items():
        period = int(SECOND / rates[name])
        # The node was made at time zero, before it learnt the time: the first one is overdue.
        counted = range(SECOND // period + 1, lockstep.now // period + 1)
        assert instants(topics.odom) == [SECOND, *(period * k for k in counted)]
        assert topics.odom[-1].pose == one.odom[-1].pose
        assert topics.states[-1].position == one.states[-1].position


def test_wheels_and_twist_end_at_the_same_pose_and_the_faster_wheel_has_the_limit(lockstep, add):
    stamped, limits = {'enable_stamped_cmd_vel': True}, {'max_wheel_velocity': 9.0}
    add(VirtualRobot, 'a', **stamped, **limits, **UNEQUAL)
    add(VirtualRobot, 'b', command_interface='wheels', **limits, **UNEQUAL)
    add(WheelBridge, 'b', **stamped, **UNEQUAL)
    one, other = (Topics(lockstep, name, command=TwistStamped) for name in 'ab')
    random = np.random.default_rng(3)
    lockstep.run_for(0.3)
    for _ in range(8):
        lockstep.run_for(int(random.integers(10_000_000, 300_000_000)) / 1e9)
        command = twist_stamped(
            random.uniform(-1, 1), random.uniform(-4, 4), lockstep.now - int(random.integers(1e7))
        )
        sent = lockstep.now
        for name in 'ab':
            lockstep.publish(f'{name}/cmd_vel', command)
    lockstep.run_for(0.7)
    # The bridge sends a zero of its own; the timeout of the robot counts from the stamp, and is first.
    ours, theirs = instants(one.applied), instants(other.applied)
    assert theirs == [*ours, sent + SECOND // 2]
    assert len(ours) == 9
    assert np.hypot(*pose_of(one.odom[-1])[:2]) > 0.01
    assert pose_of(one.odom[-1]) == pytest.approx(pose_of(other.odom[-1]), abs=1e-14)
    assert covariance_of(one.odom[-1]) == pytest.approx(covariance_of(other.odom[-1]), abs=1e-14)
    speeds = np.abs([states.velocity for states in one.states])
    assert speeds.max() == pytest.approx(9.0)


def test_the_transform_repeats_the_odometry_where_tf2_ros_is_installed(lockstep, add, capfd):
    """Elsewhere that is logged once, and the rest works."""
    topics, installed, received = Topics(lockstep), find_spec('tf2_ros') is not None, []
    if installed:
        from tf2_msgs.msg import TFMessage

        received = lockstep.listen(TFMessage, '/tf')
    add(VirtualRobot)
    add(VirtualRobot, 'silent', enable_odom_tf=False)
    lockstep.publish('cmd_vel', twist(1.0, 2.0))
    lockstep.run_for(0.1)
    words = 'tf2_ros is not installed: no transform is published'
    assert capfd.readouterr().err.count(words) == (0 if installed else 1)
    assert len(received) == (len(topics.odom) if installed else 0)
    odometry = topics.odom[-1]
    computed = transform_of(value_of(ODOMETRY, odometry), 'odom', 'base_link')
    for transform in (computed, *(one.transforms[0] for one in received[-1:])):
        assert transform.header == odometry.header
        assert transform.child_frame_id == odometry.child_frame_id
        moved, position = transform.transform.translation, odometry.pose.pose.position
        assert (moved.x, moved.y) == (position.x, position.y)
        rotation, orientation = transform.transform.rotation, odometry.pose.pose.orientation
        assert (rotation.z, rotation.w) == pytest.approx((orientation.z, orientation.w), rel=1e-14)


# --- Changes


def test_limits_keep_the_curvature(lockstep, driving):
    values = {'linear__x__max_velocity': 0.5, 'linear__x__min_velocity': 0.0, 'max_wheel_velocity': 9.0}
    limits = VelocityLimits(max_v=0.5, min_v=0.0, max_wheel_speed=9.0)
    assert change(driving.robot, **values).successful
    for command in ((1.0, 3.0), (-1.0, 3.0), (0.1, 3.0)):
        lockstep.publish('cmd_vel', twist(*command))
        assert twists(driving.applied)[-1] == saturate(*command, limits, 0.033, 0.16)


def test_wheel_speeds_stay_when_the_wheels_change(lockstep, add):
    topics = Topics(lockstep)
    robot = add(VirtualRobot, command_interface='wheels')
    lockstep.publish('joint_command', joint_command(5.0, 10.0))
    lockstep.run_for(0.2)
    assert list(topics.states[-1].velocity) == pytest.approx([5.0, 10.0], rel=1e-14)
    assert list(topics.states[-1].position) == pytest.approx([1.0, 2.0], rel=1e-14)
    assert change(robot, wheel_radius=0.066).successful
    lockstep.run_for(0.5)
    first, second, zero = twists(topics.applied)
    assert second == pytest.approx((2.0 * first[0], 2.0 * first[1]), rel=1e-15)
    assert zero == (0.0, 0.0)
    # The timeout counts from the command.
    assert instants(topics.applied) == [SECOND, SECOND + SECOND // 5, SECOND + SECOND // 2]
    assert list(topics.states[-1].position) == pytest.approx([2.5, 5.0], rel=1e-14)


@pytest.mark.parametrize('rate', [0.5, 1000.0])
def test_the_rate_changes_at_once(lockstep, driving, rate):
    lockstep.run_for(0.013)
    changed, period = lockstep.now, round(SECOND / rate)
    assert change(driving.robot, publish_rate=rate).successful
    driving.odom.clear()
    lockstep.run_for(5.0 / rate)
    # A tick that is due sooner stays due.
    first = min(SECOND + SECOND // 50, changed + period)
    expected = range(first, lockstep.now + 1, period)
    assert instants(driving.odom) == list(expected)
    assert len(expected) in (5, 6)


def test_initial_pose_counts_from_the_next_reset_on_and_names_from_the_next_message(lockstep, driving):
    names = {'odom_frame_id': 'o', 'base_frame_id': 'b', 'left_wheel_name': 'l', 'right_wheel_name': 'r'}
    assert change(driving.robot, x=3.0, y=4.0, theta=5.0, **names).successful
    odometry = comes_after(lockstep, driving.odom, 0.02)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ('o', 'b')
    assert driving.states[-1].name == ['l', 'r']
    assert pose_of(odometry).tolist() == [0.02, 0.0, 0.0]
    lockstep.publish('cmd_vel', Twist())
    assert driving.applied[-1].header.frame_id == 'b'
    assert lockstep.call(Trigger, 'reset_odometry').success
    expected = pose_message([3.0, 4.0, 5.0 - math.tau])
    assert driving.starts[-1].pose.pose == expected
    assert comes_after(lockstep, driving.odom, 0.02).pose.pose == expected
