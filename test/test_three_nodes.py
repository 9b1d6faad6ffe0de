"""All three nodes together, in one process: goal to wheels to odometry, the whole Jacobian chain."""

from __future__ import annotations

import math

import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Goals, Odometry
from ros_messages import at_rest, goal, goals, pose_of
from sensor_msgs.msg import JointState

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge

QUICK = {'kp': 12.0, 'kv': 6.0}


def team(ros, namespace='', **gains):
    """A robot driven by its wheels, its controller and its bridge."""
    ros.add(
        VirtualRobot,
        namespace=namespace,
        parameters={'command_interface': 'wheels', 'publish_rate': 100.0},
    )
    ros.add(WheelBridge, namespace=namespace)
    return ros.add(GoToGoal, namespace=namespace, parameters=gains)


def succeeded(statuses):
    return bool(statuses) and statuses[-1].status == GoalStatus.STATUS_SUCCEEDED


def test_golden_case_of_document_a_through_the_topics(ros, executor_kind):
    commands = ros.listen(Twist, 'cmd_vel')
    wheels = ros.listen(JointState, 'joint_command')
    team(ros)
    ros.talk(PoseStamped, 'goal_pose').publish(goal(1.0, 1.0))
    ros.until(lambda: commands and wheels, 'the first commands')
    assert round(commands[0].linear.x, 3) == 0.500
    assert round(commands[0].angular.z, 3) == 2.356
    speeds = dict(zip(wheels[0].name, wheels[0].velocity, strict=True))
    assert round(speeds['right_wheel_joint'], 3) == 20.864
    assert round(speeds['left_wheel_joint'], 3) == 9.440


def test_robot_arrives_and_stands(ros, executor_kind):
    odom = ros.listen(Odometry, 'odom')
    statuses = ros.listen(GoalStatus, 'goal_status', latched=True)
    states = ros.listen(JointState, 'joint_states')
    team(ros, **QUICK)
    ros.talk(PoseStamped, 'goal_pose').publish(goal(1.0, 1.0))
    ros.until(lambda: succeeded(statuses) and at_rest(odom[-1]), 'arrival')
    x, y, _ = pose_of(odom[-1])
    assert math.hypot(x - 1.0, y - 1.0) <= 0.02
    # The axle's centre goes as far as the mean wheel rolls, and a little farther than straight.
    rolled = sum(states[-1].position) / 2.0 * 0.033
    assert math.sqrt(2.0) - 0.02 < rolled < 1.6


def test_two_robots_in_two_namespaces_do_not_disturb_each_other(ros):
    targets = {'one': (1.0, 0.5), 'two': (-0.5, -1.0)}
    odoms, statuses = {}, {}
    for name in targets:
        team(ros, name, **QUICK)
        odoms[name] = ros.listen(Odometry, f'/{name}/odom')
        statuses[name] = ros.listen(GoalStatus, f'/{name}/goal_status', latched=True)
    for name, target in targets.items():
        ros.talk(PoseStamped, f'/{name}/goal_pose').publish(goal(*target))
    ros.until(
        lambda: all(succeeded(statuses[name]) and at_rest(odoms[name][-1]) for name in targets),
        'both arrive',
    )
    for name, target in targets.items():
        assert pose_of(odoms[name][-1])[:2] == pytest.approx(target, abs=0.021)


def test_waypoints_are_passed_in_order(ros):
    odom = ros.listen(Odometry, 'odom')
    statuses = ros.listen(GoalStatus, 'goal_status', latched=True)
    team(ros, **QUICK)
    ros.talk(Goals, 'goals').publish(goals(goal(0.5, 0.0), goal(0.5, 0.5), stamp=9))
    ros.until(lambda: succeeded(statuses) and at_rest(odom[-1]), 'arrival')
    near = [
        min(math.dist(pose_of(one)[:2], waypoint) for one in odom)
        for waypoint in ([0.5, 0.0], [0.5, 0.5])
    ]
    assert near == pytest.approx([0.0, 0.0], abs=0.02)
    first = next(i for i, one in enumerate(odom) if math.dist(pose_of(one)[:2], [0.5, 0.0]) <= 0.02)
    assert all(pose_of(one)[1] < 0.1 for one in odom[:first])
    assert [one.goal_info.stamp.sec for one in statuses] == [9, 9, 9]
