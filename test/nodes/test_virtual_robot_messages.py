"""The node virtual_robot and messages that cannot be meant: dropped, with the reason; and placements."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.lockstep_nodes import SECOND, Topics
from support.ros_messages import (
    WHEELS,
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
from diffdrive_jacobian.messages.covariances import from_covariance

# --- Commands


@pytest.mark.parametrize('bad', [math.nan, -math.inf], ids=str)
@pytest.mark.parametrize('field', [f'{part}.{axis}' for part in ('linear', 'angular') for axis in 'xyz'])
def test_twist_that_is_not_finite_anywhere_is_dropped_and_named(lockstep, robot_at, capfd, field, bad):
    topics = Topics(lockstep)
    robot_at()
    lockstep.publish('cmd_vel', spoiled(twist(0.5, 0.5), field, bad))
    lockstep.run_for(0.1)
    assert topics.applied == []
    assert pose_of(topics.odom[-1]).tolist() == [0.0, 0.0, 0.0]
    error = capfd.readouterr().err
    assert 'command dropped: twist must be finite, got linear' in error
    assert str(bad) in error


@pytest.mark.parametrize('field', ['linear.x', 'angular.z'])
@pytest.mark.parametrize('bad', [1000.0000001, -1000.0000001, 1e308])
def test_twist_that_is_not_plausible_is_dropped_and_named(lockstep, robot_at, capfd, field, bad):
    topics = Topics(lockstep)
    robot_at()
    lockstep.publish('cmd_vel', twist(0.25, 0.0))
    lockstep.publish('cmd_vel', spoiled(twist(0.5, 0.5), field, bad))
    lockstep.publish('cmd_vel', spoiled(twist(0.5, 0.5), field, math.copysign(1000.0, bad)))
    assert len(topics.applied) == 2
    assert math.copysign(1000.0, bad) in twists(topics.applied)[1]
    assert 'command dropped: twist must be within 1000 m/s and 1000 rad/s' in capfd.readouterr().err


@pytest.mark.parametrize('field', ['linear.y', 'linear.z', 'angular.x', 'angular.y'])
def test_what_a_differential_drive_cannot_do_is_passed_over(lockstep, robot_at, field):
    topics = Topics(lockstep)
    robot_at()
    lockstep.publish('cmd_vel', spoiled(twist(0.5, 0.25), field, 1e300))
    assert twists(topics.applied) == [(0.5, 0.25)]


@pytest.mark.parametrize(
    ('message', 'words'),
    [
        (JointState(name=WHEELS, velocity=[1.0]), 'for each name, got 2 names and 1 velocities'),
        (JointState(name=WHEELS), 'got 2 names and 0 velocities'),
        (JointState(name=['left_wheel_joint', 'other'], velocity=[1.0, 1.0]), "'other']"),
        (JointState(name=[*WHEELS, WHEELS[0]], velocity=[1.0, 1.0, -1.0]), 'must name each of'),
        (JointState(), 'must name each of'),
        (joint_command(1.0, math.nan), 'wheel speeds must be finite, got left 1.0, right nan'),
        (joint_command(-math.inf, 1.0), 'wheel speeds must be finite, got left -inf'),
        (joint_command(1e6, 1e6), 'twist must be within 1000 m/s'),
        (joint_command(-5e3, 5e3), 'omega 2062.5'),
    ],
    ids=['short', 'none', 'stranger', 'twice', 'empty', 'nan', 'inf', 'fast', 'whirl'],
)
def test_joint_command_that_cannot_be_is_dropped_and_named(lockstep, robot_at, capfd, message, words):
    topics = Topics(lockstep)
    robot_at(command_interface='wheels')
    lockstep.publish('joint_command', message)
    assert topics.applied == []
    lockstep.publish('joint_command', JointState(name=['arm', *WHEELS], velocity=[5.0, 1.0, 3.0]))
    assert twists(topics.applied) == [pytest.approx((0.033 * 2.0, 0.033 * 2.0 / 0.16))]
    error = capfd.readouterr().err
    assert 'command dropped: ' in error
    assert words in error


# --- Stamps


@pytest.mark.parametrize('timeout', [0.001, 0.5, 3.0])
def test_stamps_that_cannot_be_are_dropped(lockstep, robot_at, timeout):
    topics = Topics(lockstep, command=type(twist_stamped(0, 0, 0)))
    robot_at(enable_stamped_cmd_vel=True, cmd_vel_timeout=timeout)
    lockstep.run_for(5.0)
    now, held = lockstep.now, round(timeout * SECOND)
    sent = [now + 1, now + held, now - held - 1, now - held + 1, now - held, now - 101, now - 100]
    for index, at in enumerate([*sent, now - 101, now - 100, 0, now - 1, now]):
        lockstep.publish('cmd_vel', twist_stamped(index, 0.0, at))
    assert list(zip(twists(topics.applied), instants(topics.applied), strict=True)) == [
        ((3.0, 0.0), now - held + 1),
        ((5.0, 0.0), now - 101),
        ((6.0, 0.0), now - 100),
        ((8.0, 0.0), now - 100),
        ((9.0, 0.0), now),
        ((11.0, 0.0), now),
    ]


@pytest.mark.parametrize(
    ('offset', 'words'),
    [
        (1, 'its stamp is 0.000000 s in the future'),
        (SECOND, 'its stamp is 1.000000 s in the future'),
        (-SECOND // 2 - 1, 's old, more than the timeout of 0.5 s'),
        (-SECOND // 5, 'its stamp is 0.100000 s older than the last command, stop, reset'),
    ],
)
def test_invalid_stamp_is_reported(lockstep, robot_at, capfd, offset, words):
    robot_at(enable_stamped_cmd_vel=True)
    lockstep.run_for(1.0)
    now = lockstep.now
    lockstep.publish('cmd_vel', twist_stamped(0.1, 0.0, now - SECOND // 10))
    lockstep.publish('cmd_vel', twist_stamped(0.2, 0.0, now + offset))
    error = capfd.readouterr().err
    assert error.count('command dropped') == 1
    assert words in error


@pytest.mark.parametrize('lateness', [1e-9, 0.007, 0.02, 0.31, 0.5])
def test_late_command_acts_from_its_stamp_on(lockstep, robot_at, lateness):
    topics = Topics(lockstep, command=type(twist_stamped(0, 0, 0)))
    robot_at(1.0, 1.0, 1.0, enable_stamped_cmd_vel=True)
    lockstep.run_for(1.0)
    stamp = lockstep.now
    lockstep.run_for(lateness)
    lockstep.publish('cmd_vel', twist_stamped(0.3, -2.0, stamp))
    lockstep.run_for(1.0)
    # As if it had come in time: the timeout counts from the stamp, too.
    assert instants(topics.applied) == [stamp, stamp + SECOND // 2]
    assert topics.odom[-1].pose.pose == pose_message(se2.integrate([1, 1, 1], [0.3, -2.0], 0.5))


def test_commands_late_by_less_than_their_distance_give_the_path_of_their_stamps(lockstep, robot_at):
    topics = [Topics(lockstep, name, command=type(twist_stamped(0, 0, 0))) for name in ('due', 'late')]
    for name in ('due', 'late'):
        robot_at(namespace=name, enable_stamped_cmd_vel=True)
    random = np.random.default_rng(5)
    for _ in range(20):
        command = twist_stamped(*random.uniform(-1, 1, 2), lockstep.now)
        lockstep.publish('due/cmd_vel', command)
        lockstep.run_for(random.uniform(0.001, 0.1))
        lockstep.publish('late/cmd_vel', command)
        lockstep.run_for(random.uniform(0.001, 0.1))
    lockstep.run_for(1.0)
    due, late = topics
    assert due.applied == late.applied
    assert due.odom[-1] == late.odom[-1]


# --- Placements


def test_reset_while_driving_resets_the_pose_and_keeps_the_command(lockstep, robot_at):
    topics = Topics(lockstep)
    robot_at(0.5, -1.0, 2.0)
    lockstep.publish('cmd_vel', twist(1.0, 1.0))
    lockstep.run_for(0.25)
    assert covariance_of(topics.odom[-1])[0, 0] > 0.0
    response = lockstep.call(Trigger, 'reset_odometry')
    assert (response.success, response.message[:21]) == (True, 'odometry was reset to')
    assert topics.starts[1].pose == topics.starts[0].pose
    assert instants(topics.starts) == [SECOND, lockstep.now]
    lockstep.run_for(1.0)
    # The timeout still counts from the command.
    assert topics.odom[-1].pose.pose == pose_message(se2.integrate([0.5, -1, 2], [1, 1], 0.25))
    assert instants(topics.applied) == [SECOND, SECOND + SECOND // 2]


@pytest.mark.parametrize('frame', ['', 'odom', 'elsewhere'])
def test_initialpose_while_driving_carries_its_covariance(lockstep, robot_at, frame):
    topics = Topics(lockstep)
    robot_at(odom_frame_id=frame or 'odom', wheel_travel_variance=0.0)
    lockstep.publish('cmd_vel', twist(0.5, 0.0))
    lockstep.run_for(0.25)
    lockstep.publish(
        'initialpose', placement(2.0, 3.0, math.pi / 2, variances=(0.25, 0.5, 0.07), frame=frame)
    )
    assert value_of(POSE_WITH_COVARIANCE, topics.starts[-1]).pose == pytest.approx(
        [2.0, 3.0, math.pi / 2]
    )
    lockstep.run_for(1.0)
    assert pose_of(topics.odom[-1]) == pytest.approx([2.0, 3.125, math.pi / 2], abs=1e-15)
    # Only the uncertain heading makes the pose more uncertain: the path ends on a circle, at an angle
    # that is Gaussian with variance 0.07.
    lever, mean, double = 0.125, math.exp(-0.07 / 2.0), math.exp(-2.0 * 0.07)
    sideways, ahead = (1.0 - double) / 2.0, (1.0 + double) / 2.0 - 2.0 * mean + 1.0
    expected = np.diag([0.25 + lever**2 * sideways, 0.5 + lever**2 * ahead, 0.07])
    expected[0, 2] = expected[2, 0] = -lever * 0.07 * mean
    assert covariance_of(topics.odom[-1]) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize(
    ('field', 'value', 'words'),
    [
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
    ],
)
def test_bad_initialpose_is_dropped_and_named(lockstep, robot_at, capfd, field, value, words):
    topics = Topics(lockstep)
    robot_at()
    lockstep.publish('cmd_vel', twist(1.0, 0.0))
    lockstep.run_for(0.25)
    lockstep.publish('initialpose', spoiled(placement(7.0), field, value))
    lockstep.run_for(1.0)
    # Neither the pose nor the command took note of it.
    assert len(topics.starts) == 1
    assert pose_of(topics.odom[-1]).tolist() == [0.5, 0.0, 0.0]
    error = capfd.readouterr().err
    assert 'initialpose dropped: ' in error
    assert words in error


@pytest.mark.parametrize('index', [2, 14, 28])
def test_what_the_plane_fixes_may_have_any_covariance(lockstep, robot_at, index):
    topics = Topics(lockstep)
    robot_at()
    lockstep.publish('initialpose', spoiled(placement(7.0), f'pose.covariance.{index}', math.nan))
    assert [one.pose.pose.position.x for one in topics.starts] == [0.0, 7.0]
    assert not np.any(topics.starts[1].pose.covariance)


def test_variances_that_rounding_made_negative_are_set_to_zero():
    message, direction = placement(7.0), np.array([0.6, 0.0, 0.8])
    exact = np.outer(direction, direction)
    covariance = np.zeros((6, 6))
    covariance[np.ix_((0, 1, 5), (0, 1, 5))] = exact - 1e-12 * np.eye(3)
    message.pose.covariance = covariance.ravel()
    found = from_covariance(value_of(POSE_WITH_COVARIANCE, message).covariance)
    np.testing.assert_allclose(found, exact, atol=1e-11)
    assert np.linalg.eigvalsh(found)[0] > -1e-15
