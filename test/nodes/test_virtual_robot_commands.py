"""The node virtual_robot: invalid commands and placements, stamps, timeouts, and time that jumps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from sensor_msgs.msg import JointState
from support.lockstep_nodes import SECOND, Topics, change
from support.ros_messages import (
    WHEELS,
    at_rest,
    covariance_of,
    instants,
    joint_command,
    placement,
    pose_message,
    pose_of,
    spoiled,
    twist,
    twist_stamped,
    twists,
    value_of,
)

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.messages.codecs import POSE_WITH_COVARIANCE
from diffdrive_jacobian.messages.conversion import from_covariance
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot

BEGIN = 100 * SECOND
late = pytest.mark.lockstep(start=100.0)
"""Late enough that time may go back."""


@pytest.fixture
def driving(lockstep, add):
    """The topics of a robot that is told to drive at 1 m/s."""
    topics = Topics(lockstep)
    add(VirtualRobot)
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    return topics


# --- Commands


def test_what_a_differential_drive_cannot_do_is_ignored(lockstep, add):
    topics = Topics(lockstep)
    add(VirtualRobot, cmd_vel_timeout=0.0)
    for name in ('linear.y', 'linear.z', 'angular.x', 'angular.y'):
        lockstep.publish('cmd_vel', spoiled(twist(0.5, 0.25), name, 1e300))
        assert twists(topics.applied)[-1] == (0.5, 0.25)
        lockstep.publish('cmd_vel', spoiled(twist(0.1, 0.1), name, math.nan))
    assert len(topics.applied) == 4
    # The largest that is plausible.
    lockstep.publish('cmd_vel', twist(-1000.0, 1000.0))
    assert twists(topics.applied)[-1] == (-1000.0, 1000.0)


BAD_COMMANDS = [
    (twist(math.nan, 0.0), 'twist must be finite, got linear'),
    (twist(0.0, 1001.0), 'twist must be within 1000 m/s and 1000 rad/s'),
    (JointState(name=WHEELS, velocity=[1.0]), 'for each joint, got 2 joints and 1 velocities'),
    (JointState(name=WHEELS), 'got 2 joints and 0 velocities'),
    (JointState(name=['left_wheel_joint', 'other'], velocity=[1.0, 1.0]), "'other']"),
    (JointState(name=[*WHEELS, WHEELS[0]], velocity=[1.0, 1.0, -1.0]), 'must name each of'),
    (JointState(), 'must name each of'),
    (joint_command(1.0, math.nan), 'wheel speeds must be finite, got left 1.0, right nan'),
    (joint_command(-math.inf, 1.0), 'wheel speeds must be finite, got left -inf'),
    (joint_command(1e6, 1e6), 'twist must be within 1000 m/s'),
    (joint_command(-5e3, 5e3), 'omega 2062.5'),
]


def test_an_invalid_command_is_dropped_and_named(lockstep, add, capfd):
    applied = lockstep.listen(TwistStamped, 'cmd_vel_out')
    for message, words in BAD_COMMANDS:
        wheels = isinstance(message, JointState)
        # A new one for each, as warnings are throttled.
        robot = add(VirtualRobot, command_interface='wheels' if wheels else 'twist')
        lockstep.publish('joint_command' if wheels else 'cmd_vel', message)
        error = capfd.readouterr().err
        assert 'command dropped: ' in error
        assert words in error
        assert applied == []
        if message is not BAD_COMMANDS[-1][0]:
            lockstep.remove(robot)
    lockstep.publish('joint_command', JointState(name=['arm', *WHEELS], velocity=[5.0, 1.0, 3.0]))
    assert twists(applied) == [pytest.approx((0.033 * 2.0, 0.033 * 2.0 / 0.16))]


# --- Stamps


@pytest.mark.parametrize('timeout', [0.5, 0.0])
def test_a_stamp_counts_unless_it_is_in_the_future_or_too_old(lockstep, add, timeout):
    topics = Topics(lockstep, command=TwistStamped)
    add(VirtualRobot, enable_stamped_cmd_vel=True, cmd_vel_timeout=timeout)
    lockstep.run_for(4.0)
    now, held = lockstep.now, round((timeout or 3.0) * SECOND)
    stamps = [now + 1, now + held, now - held - 1, now - held + 1, now - held, now - 101, now - 100]
    for index, at in enumerate([*stamps, now - 101, now - 100, 0, now - 1, now]):
        lockstep.publish('cmd_vel', twist_stamped(index, 0.0, at))
    # Without a timeout none is too old.
    old = [] if timeout else [((2.0, 0.0), now - held - 1)]
    assert list(zip(twists(topics.applied), instants(topics.applied), strict=True)) == [
        *old,
        ((3.0, 0.0), now - held + 1),
        ((5.0, 0.0), now - 101),
        ((6.0, 0.0), now - 100),
        ((8.0, 0.0), now - 100),
        ((9.0, 0.0), now),
        ((11.0, 0.0), now),
    ]


def test_late_wheel_speeds_act_from_their_stamp_on(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(1.0, 1.0, 1.0, command_interface='wheels')
    stamp = lockstep.now
    lockstep.run_for(0.31)
    for at in (stamp, lockstep.now + 1, stamp - 1):
        lockstep.publish('joint_command', joint_command(5.0, 4.0, at))
    lockstep.run_for(0.4)
    # As if it had come in time: the timeout counts from the stamp, too.
    assert instants(topics.applied) == [stamp, stamp + SECOND // 2]
    (driven, _) = twists(topics.applied)
    assert topics.odom[-1].pose.pose == pose_message(se2.integrate([1, 1, 1], driven, 0.5))


# --- Timeouts


@late
def test_a_command_at_the_time_of_the_timeout_loses_no_distance_and_zero_stops_at_once(
    lockstep, driving
):
    lockstep.run_for(0.5)
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    lockstep.run_for(0.123)
    lockstep.publish('cmd_vel', Twist())
    lockstep.run_for(1.0)
    half = BEGIN + SECOND // 2
    # No timeout follows a zero.
    assert instants(driving.applied) == [BEGIN, half, half, half + 123_000_000]
    assert pose_of(driving.odom[-1]).tolist() == [0.623, 0.0, 0.0]


# --- Time that jumps


@late
@pytest.mark.parametrize('seconds', [0.25, 0.5, 1e9])
def test_jump_forward_drives_on_to_the_timeout_only(lockstep, driving, seconds):
    lockstep.jump(seconds)
    odometry = driving.odom[-1]
    assert instants([odometry]) == [lockstep.now]
    assert pose_of(odometry).tolist() == [min(seconds, 0.5), 0.0, 0.0]
    assert at_rest(odometry) == (seconds >= 0.5)
    lockstep.run_for(0.5)
    assert pose_of(driving.odom[-1]).tolist() == [0.5, 0.0, 0.0]
    assert instants(driving.applied) == [BEGIN, BEGIN + SECOND // 2]


@late
@pytest.mark.parametrize('seconds', [1e-9, 99.0])
def test_time_that_goes_back_leaves_the_robot_where_it_is(lockstep, driving, capfd, seconds):
    lockstep.run_for(0.24)
    before = driving.states[-1].position
    lockstep.jump(-seconds)
    back = lockstep.now
    assert instants(driving.starts) == [BEGIN, back]
    assert driving.starts[1].pose.pose.position.x == 0.24
    # The stop is reported at once, on the new time line.
    assert instants(driving.applied) == [BEGIN, back]
    assert twists(driving.applied)[1] == (0.0, 0.0)
    driving.odom.clear()
    lockstep.run_for(0.4)
    assert {tuple(pose_of(one)) for one in driving.odom} == {(0.24, 0.0, 0.0)}
    assert len(driving.odom) in (19, 20)
    assert list(driving.states[-1].position) == pytest.approx(before, abs=1e-12)
    lockstep.publish('cmd_vel', twist(-1.0, 0.0))
    again = lockstep.now
    lockstep.run_for(0.6)
    assert pose_of(driving.odom[-1]).tolist() == [-0.26, 0.0, 0.0]
    assert instants(driving.applied)[2:] == [again, again + SECOND // 2]
    assert f'time went back by {seconds:.3f} s' in capfd.readouterr().err


# --- Placements


def test_initialpose_while_driving_carries_its_covariance(lockstep, add):
    topics, target = Topics(lockstep), [2.0, 3.0, math.pi / 2]
    add(VirtualRobot, odom_frame_id='elsewhere', wheel_travel_variance=0.0)
    lockstep.publish('cmd_vel', twist(0.5, 0.0))
    lockstep.run_for(0.25)
    # The index of the diagonal is that of z, roll or pitch, which the plane fixes.
    for index in (14, 21, 28):
        message = placement(
            *target, variances=(0.25, 0.5, 0.07), frame='' if index > 14 else 'elsewhere'
        )
        lockstep.publish('initialpose', spoiled(message, f'pose.covariance.{index}', math.nan))
    assert len(topics.starts) == 4
    assert value_of(POSE_WITH_COVARIANCE, topics.starts[-1]).pose == pytest.approx(target)
    lockstep.run_for(0.4)
    assert pose_of(topics.odom[-1]) == pytest.approx([2.0, 3.125, math.pi / 2], abs=1e-15)
    # The uncertain heading makes the position more uncertain.
    variances = np.diag(covariance_of(topics.odom[-1]))
    assert variances == pytest.approx([0.25 + 0.07 * 0.125**2, 0.5, 0.07], rel=1e-3)


BAD_PLACEMENTS = [
    ('header.frame_id', 'map', "frame must be 'odom', got 'map'"),
    ('pose.pose.position.x', math.nan, 'position must be finite'),
    ('pose.pose.position.y', -math.inf, 'y -inf'),
    ('pose.pose.position.x', 1.1e6, 'x 1.1e+06'),
    ('pose.pose.orientation.w', 0.0, 'quaternion of length 1'),
    ('pose.pose.orientation.w', 2.0, 'w 2'),
    ('pose.pose.orientation.z', math.nan, 'z nan'),
    ('pose.covariance.0', -1.0, 'positive semidefinite'),
    ('pose.covariance.1', 0.5, 'symmetric'),
    ('pose.covariance.7', 1e308, 'at most 1e+12'),
    ('pose.covariance.35', math.nan, 'must be finite'),
]


def test_bad_initialpose_is_dropped_and_named(lockstep, add, capfd):
    robot = Topics(lockstep)
    for field, value, words in BAD_PLACEMENTS:
        # A new one for each, as warnings are throttled.
        node = add(VirtualRobot)
        lockstep.publish('cmd_vel', twist(1.0, 0.0))
        lockstep.publish('initialpose', spoiled(placement(7.0), field, value))
        lockstep.run_for(0.02)
        # Neither the pose nor the command took note of it.
        assert len(robot.starts) == 1
        assert pose_of(robot.odom[-1]).tolist() == [0.02, 0.0, 0.0]
        error = capfd.readouterr().err
        assert 'initialpose dropped: ' in error
        assert words in error
        lockstep.remove(node)
        robot.starts.clear()


def test_a_rounded_covariance_does_not_grow_into_a_negative_variance(lockstep, add):
    """Variances that are slightly negative would grow with the distance, and end the node later."""
    topics = Topics(lockstep)
    robot = add(VirtualRobot, cmd_vel_timeout=0.0, wheel_travel_variance=0.0)
    lockstep.publish('initialpose', placement(0.0, variances=(1.0, 1.0, -9e-10)))
    lockstep.publish('cmd_vel', twist(10.0, 0.0))
    lockstep.jump(6e4)
    lockstep.run_for(0.1)
    assert change(robot, wheel_radius=0.04).successful
    lockstep.run_for(0.1)
    assert len(topics.starts) == 2
    assert min(np.diag(covariance_of(topics.odom[-1]))) >= 0.0


def test_variances_that_rounding_made_negative_are_set_to_zero():
    message, direction = placement(7.0), np.array([0.6, 0.0, 0.8])
    exact = np.outer(direction, direction)
    covariance = np.zeros((6, 6))
    covariance[np.ix_((0, 1, 5), (0, 1, 5))] = exact - 1e-12 * np.eye(3)
    message.pose.covariance = covariance.ravel()
    found = from_covariance(value_of(POSE_WITH_COVARIANCE, message).covariance)
    np.testing.assert_allclose(found, exact, atol=1e-11)
    assert np.linalg.eigvalsh(found)[0] > -1e-15
