"""Goals, canceling and paths with nodes that keep their protocols, and others that do not."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from property_nodes import Scene, Student, goal_at, odometry_at, status, twist
from std_srvs.srv import Trigger
from support.lockstep_nodes import (
    ABORTED,
    ACCEPTED,
    CANCELED,
    EXECUTING,
    SUCCEEDED,
    change,
    make,
)
from support.ros_messages import path

from diffdrive_jacobian.control import figure_eight_path
from diffdrive_jacobian.faults import Duplicate, Reorder
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.properties import (
    NeverFasterThan,
    NoCommandAfterCancel,
    NoStaleGoals,
    StatusProtocol,
    StaysOnPath,
)
from diffdrive_jacobian.testing import LockstepError, PropertyViolation


@pytest.fixture
def scene(lockstep):
    return Scene(lockstep)


# --- Status


def test_a_goal_without_identifier_may_be_accepted_again_when_it_is_received_again(lockstep, scene):
    def answer(goal):
        for number in (ACCEPTED, EXECUTING, SUCCEEDED):
            scene.send(status(number, goal.header.stamp.sec, uuid=0))

    lockstep.node.create_subscription(PoseStamped, 'goal_pose', answer, 10)
    lockstep.require(StatusProtocol())
    goal = goal_at(0.0, stamp=3)
    for _ in range(3):
        lockstep.publish('goal_pose', goal)
    answer(goal)
    with pytest.raises(
        PropertyViolation, match=r'ACCEPTED of the goal with stamp 3.0+ s, which was SUC'
    ):
        lockstep.settle()


def test_the_controller_of_this_package_keeps_the_status_protocol(lockstep, team):
    lockstep.require(StatusProtocol(), NeverFasterThan(5.0, 30.0))
    goal = goal_at(0.1)
    for _ in range(2):
        lockstep.publish('goal_pose', goal)
        lockstep.run_for(0.05)
    lockstep.run_until(lambda: team.statuses[-1] == SUCCEEDED, 10.0)
    goal.header.frame_id = 'map'
    lockstep.publish('goal_pose', goal)
    lockstep.finish()
    assert team.statuses == [ACCEPTED, EXECUTING, CANCELED, ACCEPTED, EXECUTING, SUCCEEDED, ABORTED]


# --- Canceling


def test_no_command_after_cancel(lockstep, robot_at, scene):
    robot_at()
    student = lockstep.add(Student())
    lockstep.require(NoCommandAfterCancel())
    lockstep.run_for(0.1)
    student.command = twist(0.0)
    lockstep.call(Trigger, 'cancel_goal')
    # Of another one.
    scene.send(twist(0.5))
    lockstep.run_for(0.1)
    lockstep.publish('goal_pose', goal_at(1.0))
    student.command = twist(0.2)
    lockstep.run_for(0.1)
    lockstep.call(Trigger, 'cancel_goal')
    words = r'/cmd_vel: v 0.2 m/s, .* 0.02 s after /student has responded to /cancel_goal; allowed'
    with pytest.raises(PropertyViolation, match=words):
        lockstep.run_for(0.1)


def test_a_service_that_no_node_has_is_an_error_at_the_end(lockstep, robot_at):
    robot_at()
    lockstep.add(Student())
    lockstep.require(NoCommandAfterCancel(cancel='cancel'))
    lockstep.run_for(0.1)
    with pytest.raises(LockstepError, match=r'observes /cancel, which no .* /cancel_goal, /cmd_vel'):
        lockstep.finish()


# --- Goals that are out of date


def test_goals_after_a_jump_of_the_clock_are_not_old(lockstep, scene):
    lockstep.require(NoStaleGoals())
    scene.send(status(ACCEPTED, stamp=5))
    lockstep.run_for(2.0)
    lockstep.jump(-1.0)
    scene(status(ACCEPTED, stamp=2))


@pytest.mark.parametrize('late', [Duplicate('goal_pose', seconds=0.5), Reorder('goal_pose', 1.0, 0.5)])
def test_a_late_goal_is_accepted_by_the_controller_of_this_package(lockstep, late):
    """It takes goals in the order of arrival, also without stamps."""
    lockstep.add(make(GoToGoal))
    lockstep.require(NoStaleGoals())
    lockstep.inject(late)
    lockstep.publish('goal_pose', goal_at(1.0, stamp=1))
    lockstep.run_for(0.1)
    lockstep.publish('goal_pose', goal_at(2.0, stamp=2))
    if isinstance(late, Reorder):
        lockstep.run_for(1.0)
        lockstep.finish()
        return
    with pytest.raises(PropertyViolation, match='ACCEPTED of the goal with stamp 1'):
        lockstep.run_for(1.0)


# --- Paths


@pytest.mark.slow
@pytest.mark.parametrize('lookahead', [None, 0.8])
def test_go_to_goal_stays_on_an_eight_unless_it_looks_far_ahead(lockstep, robot_at, lookahead):
    robot_at()
    node = lockstep.add(make(GoToGoal))
    lockstep.require(StaysOnPath(0.03, within=24.0))
    if lookahead:
        change(node, lookahead_distance=lookahead)
    lockstep.publish('path', path(*figure_eight_path(0.6).poses.tolist()))
    if lookahead is None:
        lockstep.run_for(24.0)
        lockstep.finish()
        return
    with pytest.raises(PropertyViolation, match=r'm from the path and .* allowed: 0.03 m from'):
        lockstep.run_for(30.0)


def test_bytes_that_are_no_path_replace_one(lockstep, scene):
    lockstep.require(StaysOnPath(0.1))
    scene.send(path((0, 0), (1, 0)))
    lockstep.node.create_publisher(Path, 'path', 10).publish(b'')
    scene(odometry_at(0.0, 9.0), 0.1)
