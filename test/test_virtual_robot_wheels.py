"""The node virtual_robot driven by its wheels: the same motion as by twists."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from ros_messages import covariance_of, pose_of, twist_stamped
from sensor_msgs.msg import JointState

from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros.messages import from_time


def test_wheels_and_twist_end_at_the_same_pose(ros, sim_time):
    stamped = {'use_sim_time': True, 'enable_stamped_cmd_vel': True}
    limits = {'max_wheel_velocity': 9.0}
    ros.add(VirtualRobot, namespace='a', parameters={**stamped, **limits})
    ros.add(
        VirtualRobot,
        namespace='b',
        parameters={'use_sim_time': True, 'command_interface': 'wheels', **limits},
    )
    ros.add(WheelBridge, namespace='b', parameters=stamped)
    odoms = [ros.listen(Odometry, f'/{name}/odom') for name in 'ab']
    talkers = [ros.talk(TwistStamped, f'/{name}/cmd_vel') for name in 'ab']
    applied = [ros.listen(TwistStamped, f'/{name}/cmd_vel_out') for name in 'ab']
    sim_time.set(5_000_000_000)
    random = np.random.default_rng(3)
    for _ in range(50):
        sim_time.set(sim_time.now + int(random.integers(10_000_000, 300_000_000)))
        command = twist_stamped(
            random.uniform(-1, 1), random.uniform(-4, 4), sim_time.now - int(random.integers(1e7))
        )
        counts = [len(one) for one in applied]
        for talker in talkers:
            talker.publish(command)
        ros.until(lambda counts=counts: all(len(a) > n for a, n in zip(applied, counts, strict=True)))
    sim_time.advance(1.0, step=0.1)
    ros.until(lambda: all(from_time(odom[-1].header.stamp) == sim_time.now for odom in odoms))
    one, other = (odom[-1] for odom in odoms)
    assert np.hypot(*pose_of(one)[:2]) > 0.01
    assert pose_of(one) == pytest.approx(pose_of(other), abs=1e-9)
    assert covariance_of(one) == pytest.approx(covariance_of(other), abs=1e-9)


def test_joint_commands_that_cannot_be_are_dropped_and_named(ros, capfd):
    applied = ros.listen(TwistStamped, 'cmd_vel_out')
    ros.add(VirtualRobot, parameters={'command_interface': 'wheels'})
    commands = ros.talk(JointState, 'joint_command')
    names = ['left_wheel_joint', 'right_wheel_joint']
    for bad in (
        JointState(name=names, velocity=[1.0]),
        JointState(name=['left_wheel_joint', 'other'], velocity=[1.0, 1.0]),
        JointState(name=names, velocity=[1.0, math.nan]),
        JointState(name=names, velocity=[1e6, 1e6]),
        JointState(name=[*names, names[0]], velocity=[1.0, 1.0, -1.0]),
    ):
        commands.publish(bad)
    commands.publish(JointState(name=['arm', *names], velocity=[5.0, 1.0, 3.0]))
    ros.until(lambda: applied, 'the good command')
    assert applied[0].twist.linear.x == pytest.approx(0.033 * 2.0)
    assert applied[0].twist.angular.z == pytest.approx(0.033 * 2.0 / 0.16)
    assert len(applied) == 1
    assert 'a velocity for each name, got 2 names and 1 velocities' in capfd.readouterr().err


def test_wheel_speeds_stay_when_the_wheels_change(ros, sim_time):
    odom, applied = ros.listen(Odometry, 'odom'), ros.listen(TwistStamped, 'cmd_vel_out')
    robot = ros.add(VirtualRobot, parameters={'use_sim_time': True, 'command_interface': 'wheels'})
    commands = ros.talk(JointState, 'joint_command')
    sim_time.set(5_000_000_000)
    commands.publish(JointState(name=['left_wheel_joint', 'right_wheel_joint'], velocity=[5.0, 10.0]))
    ros.until(lambda: applied, 'the command')
    sim_time.set(5_200_000_000)
    assert robot.set_parameters([Parameter('wheel_radius', value=0.066)])[0].successful
    ros.until(lambda: len(applied) == 2, 'the twist of the larger wheels')
    assert applied[1].twist.linear.x == pytest.approx(2.0 * applied[0].twist.linear.x)
    assert applied[1].twist.angular.z == pytest.approx(2.0 * applied[0].twist.angular.z)
    sim_time.set(9_000_000_000)
    ros.until(lambda: len(applied) == 3 and odom, 'the timeout counts from the command')
    assert from_time(applied[2].header.stamp) == 5_500_000_000
