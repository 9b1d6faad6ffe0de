"""A change of the control law while the robot turns in place at the last waypoint."""

from __future__ import annotations

import itertools
import math

import pytest
from support.lockstep_nodes import QUICK, SUCCEEDED, Topics, arrives, change, make
from support.ros_messages import goal, pose_of

from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters.nodes import CONTROLLERS

OFFSET, TOLERANCE = 0.3, 0.02
HEADING = 3.0


def point(pose, controller):
    """Position of the point that a controller brings to the goal."""
    x, y, theta = pose
    offset = OFFSET if controller == 'offset_point' else 0.0
    return x + offset * math.cos(theta), y + offset * math.sin(theta)


@pytest.fixture
def turning(lockstep):
    """A function that starts a turn in place at a goal with a controller; gives topics, node, goal."""

    def start(controller):
        topics = Topics(lockstep)
        lockstep.add(make(VirtualRobot))
        # The robot turns slowly, so that there is time for a change.
        node = lockstep.add(
            make(
                GoToGoal,
                controller=controller,
                offset=OFFSET,
                xy_goal_tolerance=TOLERANCE,
                use_goal_heading=True,
                angular__z__max_velocity=1.0,
                **QUICK,
            )
        )
        target = point((0.0, 0.0, 0.0), controller)
        lockstep.publish('goal_pose', goal(*target, HEADING))
        lockstep.run_for(1.0)
        assert {(one.linear.x, one.angular.z) for one in topics.commands} == {(0.0, 1.0)}
        return topics, node, target

    return start


@pytest.mark.parametrize(('before', 'after'), list(itertools.permutations(CONTROLLERS, 2)))
def test_robot_is_driven_to_where_the_new_controller_arrives(lockstep, turning, before, after):
    topics, node, target = turning(before)
    changed = len(topics.odom)
    assert change(node, controller=after).successful
    arrives(lockstep, topics)
    distances = [math.dist(point(pose_of(one), after), target) for one in topics.odom[changed:]]
    assert min(distances) <= TOLERANCE
    assert abs(wrap_angle(pose_of(topics.odom[-1])[2] - HEADING)) <= 0.02 + 0.02
    if after != 'offset_point':
        # The axle centre stays where it is while the robot turns.
        assert distances[-1] <= TOLERANCE
    if {before, after} == {'go_to_goal', 'pose'}:
        # The same point arrives, and it is there.
        assert not any(one.linear.x for one in topics.commands)


def test_without_a_heading_the_position_of_the_new_controller_counts(lockstep, turning):
    topics, node, target = turning('offset_point')
    assert change(node, controller='go_to_goal', use_goal_heading=False).successful
    arrives(lockstep, topics)
    assert math.dist(point(pose_of(topics.odom[-1]), 'go_to_goal'), target) <= TOLERANCE


def test_another_offset_is_another_point_that_arrives(lockstep, turning):
    topics, node, target = turning('offset_point')
    changed = len(topics.odom)
    assert change(node, offset=0.1).successful
    arrives(lockstep, topics)
    poses = [pose_of(one) for one in topics.odom[changed:]]
    assert (
        min(
            math.dist((x + 0.1 * math.cos(theta), y + 0.1 * math.sin(theta)), target)
            for x, y, theta in poses
        )
        <= TOLERANCE
    )


@pytest.mark.parametrize('controller', CONTROLLERS)
def test_other_changes_do_not_interrupt_the_turn(lockstep, turning, controller):
    topics, node, _ = turning(controller)
    for values in ({'kp': 25.0}, {'odom_timeout': 0.4}, {'xy_goal_tolerance': 0.03}):
        assert change(node, **values).successful
        lockstep.run_for(0.1)
    arrives(lockstep, topics)
    assert topics.statuses[-1] == SUCCEEDED
    assert not any(one.linear.x for one in topics.commands)
