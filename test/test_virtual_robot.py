"""The node virtual_robot: its motion is a function of the commands and their instants alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from ros_messages import at_rest, covariance_of, pose_of, twist, twist_stamped
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.ros.messages import from_pose, from_time


def reproduce(applied, starts, instant):
    """Where `cmd_vel_out` and `start_pose` say that the robot is at an instant."""
    begin = max(
        (start for start in starts if from_time(start.header.stamp) <= instant),
        key=lambda start: from_time(start.header.stamp),
    )
    pose, now = from_pose(begin.pose.pose), from_time(begin.header.stamp)
    driven = (0.0, 0.0)
    for command in applied:
        at = from_time(command.header.stamp)
        if at > instant:
            break
        if at > now:
            pose, now = se2.integrate(pose, driven, (at - now) / 1e9), at
        driven = command.twist.linear.x, command.twist.angular.z
    return se2.integrate(pose, driven, (instant - now) / 1e9)


def test_idle_robot_reports_its_initial_pose(ros, executor_kind):
    odom = ros.listen(Odometry, 'odom')
    states = ros.listen(JointState, 'joint_states')
    ros.add(VirtualRobot, parameters={'x': 1.0, 'y': -2.0, 'theta': 4.0, 'odom_frame_id': 'o'})
    ros.until(lambda: len(odom) > 2 and states, 'odometry of an idle robot')
    assert pose_of(odom[0]) == pytest.approx([1.0, -2.0, 4.0 - math.tau])
    assert (odom[0].header.frame_id, odom[0].child_frame_id) == ('o', 'base_link')
    assert not np.any(odom[0].pose.covariance)
    assert list(states[0].name) == ['left_wheel_joint', 'right_wheel_joint']
    assert list(states[0].position) == [0.0, 0.0]
    late = ros.listen(PoseWithCovarianceStamped, 'start_pose', latched=True)
    ros.until(lambda: late, 'the latched start pose')
    assert from_pose(late[0].pose.pose) == pytest.approx([1.0, -2.0, 4.0 - math.tau])


def test_publish_rate_changes_neither_pose_nor_covariance(ros):
    rates, names = (10.0, 50.0, 1000.0), ('slow', 'usual', 'fast')
    robots = [
        ros.add(
            VirtualRobot,
            namespace=name,
            parameters={
                'publish_rate': rate,
                'enable_stamped_cmd_vel': True,
                'cmd_vel_timeout': 30.0,
            },
        )
        for name, rate in zip(names, rates, strict=True)
    ]
    odoms = [ros.listen(Odometry, f'/{name}/odom') for name in names]
    talkers = [ros.talk(TwistStamped, f'/{name}/cmd_vel') for name in names]
    starts = [robot.now() for robot in robots]
    random = np.random.default_rng(1)
    commands = [(random.uniform(-0.5, 0.5), random.uniform(-2, 2)) for _ in range(40)]
    instants = max(starts) + np.cumsum(random.integers(1_000_000, 30_000_000, 41))
    for index, command in enumerate([*commands, (0.0, 0.0)]):
        due = int(instants[index])
        ros.until(lambda due=due: min(robot.now() for robot in robots) >= due, 'its instant')
        for talker in talkers:
            talker.publish(twist_stamped(*command, due))
    end = int(instants[-1])
    ros.until(
        lambda: all(
            odom and at_rest(odom[-1]) and from_time(odom[-1].header.stamp) > end for odom in odoms
        ),
        'all robots are at rest',
    )
    expected = np.zeros(3)
    for index, command in enumerate(commands):
        held = int(instants[index + 1] - instants[index]) / 1e9
        expected = se2.integrate(expected, command, held)
    final = [odom[-1] for odom in odoms]
    for odometry in final:
        assert pose_of(odometry) == pytest.approx(expected, abs=1e-9)
        assert covariance_of(odometry) == pytest.approx(covariance_of(final[0]), abs=1e-9)
    assert np.all(np.diag(covariance_of(final[0])) > 0.0)


def test_cmd_vel_out_and_start_pose_tell_every_odometry_pose(ros, executor_kind):
    odom, applied = ros.listen(Odometry, 'odom'), ros.listen(TwistStamped, 'cmd_vel_out')
    starts = ros.listen(PoseWithCovarianceStamped, 'start_pose', latched=True)
    ros.add(
        VirtualRobot,
        parameters={'publish_rate': 200.0, 'cmd_vel_timeout': 0.06, 'linear.x.max_velocity': 0.4},
    )
    commands = ros.talk(Twist, 'cmd_vel')
    placements = ros.talk(PoseWithCovarianceStamped, 'initialpose')
    ros.until(lambda: starts and odom, 'the robot is there')
    random = np.random.default_rng(2)
    for index in range(30):
        commands.publish(twist(random.uniform(-1, 1), random.uniform(-3, 3)))
        # Now and then so long that the timeout strikes in between.
        wanted = len(odom) + (20 if index % 10 == 9 else random.integers(1, 5))
        ros.until(lambda wanted=wanted: len(odom) >= wanted, 'odometry goes on')
        if index % 7 == 6:
            placement = PoseWithCovarianceStamped()
            placement.pose.pose.position.x = random.uniform(-5, 5)
            placement.pose.covariance[0] = 0.1
            placements.publish(placement)
    ros.until(lambda: at_rest(odom[-1]) and applied[-1].twist == Twist() and len(starts) == 5, 'the end')
    stops = [command for command in applied if command.twist == Twist()]
    assert len(stops) >= 3
    errors = [
        np.abs(pose_of(one) - reproduce(applied, starts, from_time(one.header.stamp))) for one in odom
    ]
    assert np.max(errors) < 1e-9
    assert max(abs(one.twist.twist.linear.x) for one in odom) <= 0.4


def test_timeout_strikes_at_its_own_instant(ros, sim_time):
    odom, applied = ros.listen(Odometry, 'odom'), ros.listen(TwistStamped, 'cmd_vel_out')
    ros.add(VirtualRobot, parameters={'use_sim_time': True, 'publish_rate': 3.0})
    commands = ros.talk(Twist, 'cmd_vel')
    sim_time.set(10_000_000_000)
    commands.publish(twist(1.0, 0.0))
    ros.until(lambda: applied, 'the command is applied')
    sim_time.set(14_000_000_000)
    ros.until(lambda: odom and at_rest(odom[-1]) and pose_of(odom[-1])[0] > 0, 'the robot stops')
    ros.until(lambda: len(applied) == 2, 'the stop is told')
    assert [from_time(one.header.stamp) for one in applied] == [10_000_000_000, 10_500_000_000]
    assert applied[1].twist == Twist()
    assert pose_of(odom[-1]) == pytest.approx([0.5, 0.0, 0.0], abs=1e-12)


def test_sixty_second_arc_is_exact(ros, sim_time):
    odom, applied = ros.listen(Odometry, 'odom'), ros.listen(TwistStamped, 'cmd_vel_out')
    ros.add(VirtualRobot, parameters={'use_sim_time': True, 'cmd_vel_timeout': 0.0})
    commands = ros.talk(Twist, 'cmd_vel')
    begin = 1_000_000_000
    sim_time.set(begin)
    commands.publish(twist(0.22, 0.5))
    ros.until(lambda: applied, 'the command is applied')
    for second in range(1, 61):
        sim_time.set(begin + second * 1_000_000_000)
    ros.until(lambda: odom and from_time(odom[-1].header.stamp) == sim_time.now, 'the end')
    radius, turn = 0.22 / 0.5, 0.5 * 60.0
    expected = [radius * math.sin(turn), radius * (1.0 - math.cos(turn)), se2.wrap_angle(turn)]
    assert pose_of(odom[-1]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    'bad', [math.nan, math.inf, -math.inf, 1001.0, 1e308], ids=['nan', 'inf', '-inf', '1001', '1e308']
)
@pytest.mark.parametrize('component', ['linear', 'angular'])
def test_rubbish_is_dropped_and_named(ros, capfd, bad, component):
    odom, applied = ros.listen(Odometry, 'odom'), ros.listen(TwistStamped, 'cmd_vel_out')
    ros.add(VirtualRobot, parameters={'cmd_vel_timeout': 0.0})
    commands = ros.talk(Twist, 'cmd_vel')
    commands.publish(twist(bad, 0.0) if component == 'linear' else twist(0.0, bad))
    commands.publish(twist(0.25, 0.0))
    ros.until(lambda: applied and odom and pose_of(odom[-1])[0] > 0.0, 'the good command is driven')
    assert [one.twist.linear.x for one in applied] == [0.25]
    assert np.all(np.isfinite(pose_of(odom[-1])))
    error = capfd.readouterr().err
    assert 'command dropped: twist must be' in error
    assert f'{bad:g}' in error or str(bad) in error


def test_stamps_that_cannot_be_are_dropped_and_named(ros, sim_time, capfd):
    applied = ros.listen(TwistStamped, 'cmd_vel_out')
    ros.add(VirtualRobot, parameters={'use_sim_time': True, 'enable_stamped_cmd_vel': True})
    commands = ros.talk(TwistStamped, 'cmd_vel')
    now = 20_000_000_000
    sim_time.set(now - 2_000_000_000)
    sim_time.set(now)
    for v, at in [(0.1, now + 1), (0.2, now - 500_000_001), (0.3, now - 100), (0.4, now - 101)]:
        commands.publish(twist_stamped(v, 0.0, at))
    commands.publish(twist_stamped(0.5, 0.0, 0))
    ros.until(lambda: applied and applied[-1].twist.linear.x == 0.5, 'the last command')
    assert [(one.twist.linear.x, from_time(one.header.stamp)) for one in applied] == [
        (0.3, now - 100),
        (0.5, now),
    ]
    assert 'in the future' in capfd.readouterr().err


def test_reset_begins_anew(ros):
    odom = ros.listen(Odometry, 'odom')
    starts = ros.listen(PoseWithCovarianceStamped, 'start_pose', latched=True)
    ros.add(VirtualRobot, parameters={'x': 0.5})
    commands = ros.talk(Twist, 'cmd_vel')
    commands.publish(twist(1.0, 1.0))
    ros.until(lambda: odom and covariance_of(odom[-1])[0, 0] > 0.0, 'the robot drives')
    response = ros.call(Trigger, 'reset_odometry')
    assert response.success
    ros.until(lambda: len(starts) == 2, 'the new start')
    assert from_pose(starts[1].pose.pose) == pytest.approx([0.5, 0.0, 0.0])
    assert not np.any(starts[1].pose.covariance)
    begun = from_time(starts[1].header.stamp)
    ros.until(lambda: from_time(odom[-1].header.stamp) > begun, 'odometry after the reset')
    first = next(one for one in odom if from_time(one.header.stamp) > begun)
    # The command goes on, the pose and its covariance begin anew.
    assert np.hypot(*(pose_of(first)[:2] - [0.5, 0.0])) < 0.2
    assert covariance_of(first)[0, 0] < 1e-5


def test_initialpose_carries_its_covariance(ros):
    odom = ros.listen(Odometry, 'odom')
    ros.add(VirtualRobot)
    placements = ros.talk(PoseWithCovarianceStamped, 'initialpose')
    message = PoseWithCovarianceStamped()
    message.header.frame_id = 'odom'
    message.pose.pose.position.y = 3.0
    message.pose.covariance[0] = message.pose.covariance[7] = 0.25
    message.pose.covariance[35] = 0.07
    placements.publish(message)
    ros.until(lambda: odom and pose_of(odom[-1])[1] == 3.0, 'the robot is placed')
    assert covariance_of(odom[-1]) == pytest.approx(np.diag([0.25, 0.25, 0.07]))


def spoil_frame(message):
    message.header.frame_id = 'map'


def spoil_position(message):
    message.pose.pose.position.x = math.nan


def spoil_orientation(message):
    message.pose.pose.orientation.w = 0.0


def spoil_covariance(message):
    message.pose.covariance[0] = -1.0


def spoil_scale(message):
    message.pose.covariance[0] = 1e308


@pytest.mark.parametrize(
    ('spoil', 'words'),
    [
        (spoil_frame, "frame 'odom', got 'map'"),
        (spoil_position, 'position must be finite'),
        (spoil_orientation, 'quaternion of length 1'),
        (spoil_covariance, 'positive semidefinite'),
        (spoil_scale, 'at most 1e+12'),
    ],
)
def test_bad_initialpose_is_dropped_and_named(ros, capfd, spoil, words):
    starts = ros.listen(PoseWithCovarianceStamped, 'start_pose', latched=True)
    ros.add(VirtualRobot)
    placements = ros.talk(PoseWithCovarianceStamped, 'initialpose')
    message = PoseWithCovarianceStamped()
    message.pose.pose.position.x = 7.0
    spoil(message)
    placements.publish(message)
    good = PoseWithCovarianceStamped()
    good.pose.pose.position.x = 8.0
    placements.publish(good)
    ros.until(lambda: len(starts) == 2, 'the good pose is taken')
    assert [one.pose.pose.position.x for one in starts] == [0.0, 8.0]
    assert words in capfd.readouterr().err
