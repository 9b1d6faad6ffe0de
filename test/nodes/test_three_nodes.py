"""All three nodes together, in lockstep: the whole Jacobian chain, several robots, and lost nodes."""

from __future__ import annotations

import math

import pytest
from geometry_msgs.msg import Twist
from std_srvs.srv import Trigger
from support.lockstep_nodes import (
    ACCEPTED,
    EXECUTING,
    QUICK,
    SUCCEEDED,
    Topics,
    add_team,
    arrives,
    change,
)
from support.ros_messages import at_rest, goal, instants, placement, pose_of, twists

from diffdrive_jacobian.testing import Lockstep


def test_golden_case_of_document_a_through_the_topics(lockstep):
    topics = Topics(lockstep)
    add_team(lockstep)
    lockstep.publish('goal_pose', goal(1.0, 1.0))
    lockstep.step()
    (command,) = twists(topics.commands)
    assert (round(command[0], 3), round(command[1], 3)) == (0.500, 2.356)
    assert list(topics.states[-1].velocity) == [0.0, 0.0]
    lockstep.step()
    left, right = topics.states[-1].velocity
    assert (round(right, 3), round(left, 3)) == (20.864, 9.440)


def test_robot_arrives_and_stands(lockstep):
    topics, start, target = Topics(lockstep), (-1.0, 0.5, -2.0), (-1.0, -1.0)
    add_team(lockstep, pose=start, **QUICK)
    topics.odom.clear()
    lockstep.publish('goal_pose', goal(*target))
    arrives(lockstep, topics)
    assert topics.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
    # Each odometry on the way is answered by one command; only the last of them is zero.
    along = [math.dist(pose_of(one)[:2], target) for one in topics.odom]
    there = next(i for i, distance in enumerate(along) if distance <= 0.02)
    assert len(topics.commands) == there + 1
    assert [i for i, command in enumerate(topics.commands) if command == Twist()] == [there]
    # And there it stands.
    assert all(one.pose == topics.odom[there].pose for one in topics.odom[there:])
    assert all(map(at_rest, topics.odom[there + 1 :]))
    assert len(topics.odom) > there + 3


def driven(names, targets):
    """Drive teams in a world of their own; return all that they publish."""
    with Lockstep() as world:
        topics = [Topics(world, name) for name in names]
        for name in names:
            add_team(world, name, **QUICK)
        for name, target in zip(names, targets, strict=True):
            world.publish(f'{name}/goal_pose', goal(*target))
        world.run_for(0.6)
        return [(one.odom, one.states, one.applied, one.commands, one.statuses) for one in topics]


def test_robots_in_company_drive_as_each_drives_alone_to_the_last_bit():
    names, targets = ['robot_0', 'robot_1'], [(0.3, 0.1), (-0.2, 0.3)]
    together = driven(names, targets)
    assert [one[-1][-1] for one in together] == [SUCCEEDED] * 2
    assert len(together[0][0]) == 31
    assert together[0][0][-1].pose != together[1][0][-1].pose
    for name, target, published in zip(names, targets, together, strict=True):
        assert driven([name], [target]) == [published]


@pytest.mark.lockstep(start=100.0)
def test_a_robot_that_is_placed_or_reset_or_whose_time_jumps_is_driven_on(lockstep, team):
    lockstep.publish('goal_pose', goal(1.0, 1.0))
    lockstep.run_for(0.2)
    lockstep.publish('initialpose', placement(3.0, 1.5, 1.0))
    lockstep.run_for(0.1)
    assert lockstep.call(Trigger, 'reset_odometry').success
    lockstep.run_for(0.1)
    lockstep.jump(-90.0)
    arrives(lockstep, team)
    assert len(team.starts) == 4
    assert team.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
    assert pose_of(team.odom[-1])[:2] == pytest.approx((1.0, 1.0), abs=0.02)


@pytest.mark.parametrize('removed', ['controller', 'bridge', 'robot'])
def test_when_a_node_is_removed_the_others_stop_within_the_timeout(lockstep, team, removed):
    assert change(team.controller, kp=3.0, kv=0.5).successful
    lockstep.publish('goal_pose', goal(5.0, 0.0))
    lockstep.run_for(0.3)
    lockstep.remove(getattr(team, removed))
    last = instants(team.applied)[-1]
    lockstep.run_for(0.7)
    if removed == 'robot':
        assert team.commands[-1] == Twist()
        return
    # The robot sees to that, and the bridge that is left, at the same time.
    applied = zip(instants(team.applied), twists(team.applied), strict=True)
    assert {at for at, command in applied if command == (0.0, 0.0)} == {last + 500_000_000}
    assert at_rest(team.odom[-1])
    # The controller without its bridge goes on to command.
    assert removed == 'controller' or team.commands[-1] != Twist()
