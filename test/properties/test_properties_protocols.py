"""The status of goals, goals that are out of date, and canceling."""

from __future__ import annotations

import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Twist
from property_nodes import Sender, Student, goal_at, twist
from std_srvs.srv import Trigger
from support.lockstep_nodes import ABORTED, ACCEPTED, CANCELED, EXECUTING, SUCCEEDED, make

from diffdrive_jacobian.faults import Duplicate, Reorder
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.properties import (
    NeverFasterThan,
    NoCommandAfterCancel,
    NoStaleGoals,
    StatusProtocol,
)
from diffdrive_jacobian.testing import LockstepError, PropertyViolation


@pytest.fixture
def send(lockstep):
    return Sender(lockstep)


# --- Status


def status(number, stamp=1, uuid=1):
    message = GoalStatus(status=number)
    message.goal_info.stamp.sec = stamp
    message.goal_info.goal_id.uuid[0] = uuid
    return message


KEPT = [
    [ACCEPTED],
    [ACCEPTED, EXECUTING, SUCCEEDED],
    [ACCEPTED, ACCEPTED, EXECUTING, EXECUTING, ABORTED],
    [ACCEPTED, CANCELED],
    [ABORTED],
    [ACCEPTED, EXECUTING, CANCELED, (ACCEPTED, 2), (EXECUTING, 2), (SUCCEEDED, 2)],
    [ACCEPTED, EXECUTING, (ABORTED, 2), EXECUTING, SUCCEEDED],
]
BROKEN = [
    ([EXECUTING], 'EXECUTING of the goal with stamp 1.000000000 s .* as its first status; allowed: ACC'),
    ([ACCEPTED, SUCCEEDED], 'SUCCEEDED of .* after ACCEPTED; allowed: ACCEPTED, EXECUTING, CANCELING'),
    ([ACCEPTED, EXECUTING, ACCEPTED], 'ACCEPTED of .* after EXECUTING'),
    (
        [ACCEPTED, EXECUTING, SUCCEEDED, SUCCEEDED],
        'SUCCEEDED of .* was SUCCEEDED already; allowed: noth',
    ),
    ([ACCEPTED, EXECUTING, SUCCEEDED, CANCELED], 'CANCELED of .* was SUCCEEDED already'),
    ([ABORTED, ACCEPTED], 'ACCEPTED of .* was ABORTED already'),
    ([ACCEPTED, (ACCEPTED, 2)], 'while the goal before is ACCEPTED; allowed: after its terminal status'),
    ([0], '0 of .* as its first status'),
    ([17], '17 of .* as its first status'),
]


def publish_statuses(lockstep, send, sequence, **kwargs):
    for one in sequence:
        number, *stamp = one if isinstance(one, tuple) else (one,)
        send('goal_status', status(number, *stamp, **kwargs))
        lockstep.settle()
    lockstep.finish()


def test_status_protocol(lockstep, send):
    for sequence in KEPT:
        lockstep.require(StatusProtocol())
        publish_statuses(lockstep, send, sequence)


def test_status_protocol_broken(lockstep, send):
    for sequence, words in BROKEN:
        lockstep.require(StatusProtocol())
        with pytest.raises(PropertyViolation, match=words):
            publish_statuses(lockstep, send, sequence)


def test_a_goal_without_identifier_may_be_accepted_again_when_it_is_received_again(lockstep, send):
    publisher = lockstep.node.create_publisher(GoalStatus, 'goal_status', 10)

    def answer(goal):
        for number in (ACCEPTED, EXECUTING, SUCCEEDED):
            message = status(number, uuid=0)
            message.goal_info.stamp = goal.header.stamp
            publisher.publish(message)

    lockstep.node.create_subscription(PoseStamped, 'goal_pose', answer, 10)
    lockstep.require(StatusProtocol())
    goal = PoseStamped()
    goal.header.stamp = Time(sec=3)
    for _ in range(3):
        lockstep.publish('goal_pose', goal)
    with pytest.raises(
        PropertyViolation, match=r'ACCEPTED of the goal with stamp 3.0+ s, which was SUCC'
    ):
        answer(goal) or lockstep.settle()


def test_the_controller_of_this_package_keeps_the_status_protocol(lockstep, robot_at, team):
    lockstep.require(StatusProtocol(), NeverFasterThan(5.0, 30.0))
    goal = PoseStamped()
    goal.pose.position.x = 0.1
    for _ in range(2):
        lockstep.publish('goal_pose', goal)
        lockstep.run_for(0.05)
    lockstep.run_until(lambda: team.statuses[-1] == SUCCEEDED, 10.0)
    goal.header.frame_id = 'map'
    lockstep.publish('goal_pose', goal)
    lockstep.finish()
    assert team.statuses == [ACCEPTED, EXECUTING, CANCELED, ACCEPTED, EXECUTING, SUCCEEDED, ABORTED]


# --- Canceling


def test_no_command_after_cancel(lockstep, robot_at):
    robot_at()
    student = lockstep.add(Student())
    other = lockstep.node.create_publisher(Twist, 'cmd_vel', 10)
    lockstep.require(NoCommandAfterCancel())
    lockstep.run_for(0.1)
    student.command = twist(0.0)
    lockstep.call(Trigger, 'cancel_goal')
    other.publish(twist(0.5))
    lockstep.run_for(0.1)
    lockstep.publish('goal_pose', PoseStamped())
    student.command = twist(0.2)
    lockstep.run_for(0.1)
    lockstep.call(Trigger, 'cancel_goal')
    with pytest.raises(
        PropertyViolation,
        match=r'/cmd_vel: v 0.2 m/s, .* 0.02 s after /student has responded to /cancel_goal; allowed',
    ):
        lockstep.run_for(0.1)


def test_a_service_that_no_node_has_is_an_error_at_the_end(lockstep, robot_at):
    robot_at()
    lockstep.add(Student())
    lockstep.require(NoCommandAfterCancel(cancel='cancel'))
    lockstep.run_for(0.1)
    with pytest.raises(LockstepError, match=r'observes /cancel, which no .* /cancel_goal, /cmd_vel'):
        lockstep.finish()


# --- Goals that are out of date


@pytest.mark.parametrize(
    ('stamps', 'old'),
    [((1, 2, 3), None), ((0, 0, 2, 0, 3), None), ((1, 3, 2), 2), ((1, 2, 2), 2)],
)
def test_no_stale_goals(lockstep, send, stamps, old):
    lockstep.require(NoStaleGoals())
    for number, stamp in enumerate(stamps):
        send('goal_status', status(EXECUTING, stamp=1, uuid=number))
        send('goal_status', status(ACCEPTED, stamp=stamp, uuid=number))
    if old is None:
        lockstep.finish()
        return
    with pytest.raises(
        PropertyViolation, match=rf'ACCEPTED of the goal with stamp {old}\.0+ s, after one'
    ):
        lockstep.finish()


def test_goals_after_a_jump_of_the_clock_are_not_old(lockstep, send):
    lockstep.require(NoStaleGoals())
    send('goal_status', status(ACCEPTED, stamp=5))
    lockstep.run_for(2.0)
    lockstep.jump(-1.0)
    send('goal_status', status(ACCEPTED, stamp=2))
    lockstep.finish()


@pytest.mark.parametrize('fault', [Duplicate('goal_pose', seconds=0.5), Reorder('goal_pose', 1.0, 0.5)])
def test_a_late_goal_is_accepted_by_the_controller_of_this_package(lockstep, fault):
    """It takes goals in the order of arrival, also without stamps."""
    lockstep.add(make(GoToGoal))
    lockstep.require(NoStaleGoals())
    lockstep.inject(fault)
    lockstep.publish('goal_pose', goal_at(1.0, stamp=1))
    lockstep.run_for(0.1)
    lockstep.publish('goal_pose', goal_at(2.0, stamp=2))
    if isinstance(fault, Reorder):
        lockstep.run_for(1.0)
        lockstep.finish()
        return
    with pytest.raises(PropertyViolation, match='ACCEPTED of the goal with stamp 1'):
        lockstep.run_for(1.0)
