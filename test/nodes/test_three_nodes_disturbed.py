"""All three nodes together when something comes in between: placements, losses, jumps."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import Twist
from std_srvs.srv import Trigger
from support.lockstep_nodes import ACCEPTED, EXECUTING, SUCCEEDED, arrives, change, comes_after
from support.ros_messages import at_rest, goal, instants, placement, pose_of, twists

from diffdrive_jacobian.control import go_to_goal


@pytest.mark.parametrize('x', [-2.0, 0.0, 3.0])
def test_placement_while_driving_is_driven_on_from(lockstep, team, x):
    lockstep.publish('goal_pose', goal(1.0, 1.0))
    lockstep.run_for(0.2)
    lockstep.publish('initialpose', placement(x, 1.5, 1.0))
    team.odom.clear()
    arrives(lockstep, team)
    assert pose_of(team.odom[0])[:2] == pytest.approx((x, 1.5), abs=0.1)
    assert pose_of(team.odom[-1])[:2] == pytest.approx((1.0, 1.0), abs=0.02)


def test_reset_while_driving_is_driven_on_from(lockstep, team):
    lockstep.publish('goal_pose', goal(1.0, 1.0))
    lockstep.run_for(0.2)
    assert lockstep.call(Trigger, 'reset_odometry').success
    arrives(lockstep, team)
    assert len(team.starts) == 2
    assert pose_of(team.odom[-1])[:2] == pytest.approx((1.0, 1.0), abs=0.02)


@pytest.mark.parametrize(('kp', 'kv'), [(12.0, 6.0), (6.0, 1.0), (3.0, 2.0)])
def test_gains_changed_underway_count_at_once(lockstep, team, kp, kv):
    lockstep.publish('goal_pose', goal(2.0, 1.0))
    lockstep.run_for(0.1)
    assert change(team.controller, kp=kp, kv=kv).successful
    lockstep.step()
    pose = pose_of(team.odom[-1])
    assert twists(team.commands)[-1] == pytest.approx(go_to_goal(pose, [2.0, 1.0], kp, kv), rel=1e-12)


@pytest.mark.parametrize('rate', [2.5, 10.0, 1000.0])
def test_odometry_at_another_rate_is_answered_as_often(lockstep, team, rate):
    assert change(team.robot, publish_rate=rate).successful
    assert change(team.controller, kp=2.0, kv=0.5).successful
    lockstep.publish('goal_pose', goal(0.5, 0.0))
    team.odom.clear()
    lockstep.run_for(0.4)
    assert len(team.commands) == len(team.odom) == pytest.approx(0.4 * rate, abs=1.0)
    assert instants(team.applied) == instants(team.odom)


def test_removed_robot_stops_the_controller_within_the_timeout(lockstep, team):
    lockstep.publish('goal_pose', goal(5.0, 0.0))
    lockstep.run_for(0.3)
    seen = instants(team.odom)[-1]
    lockstep.remove(team.robot)
    lockstep.run_for(0.2)
    assert Twist() not in team.commands
    command = comes_after(lockstep, team.commands, 0.5 - (lockstep.now - seen) / 1e9)
    assert command == Twist()


def test_removed_controller_lets_the_robot_stop(lockstep, team):
    lockstep.publish('goal_pose', goal(5.0, 0.0))
    lockstep.run_for(0.3)
    lockstep.remove(team.controller)
    last = instants(team.applied)[-1]
    lockstep.run_for(2.0)
    # The bridge and the robot itself both see to that, in one instant.
    driven = zip(instants(team.applied), twists(team.applied), strict=True)
    assert {at for at, command in driven if command == (0.0, 0.0)} == {last + 500_000_000}
    assert at_rest(team.odom[-1])


def test_removed_bridge_lets_the_robot_stop(lockstep, team):
    assert change(team.controller, kp=3.0, kv=0.5).successful
    lockstep.publish('goal_pose', goal(5.0, 0.0))
    lockstep.run_for(0.3)
    lockstep.remove(team.bridge)
    last = instants(team.applied)[-1]
    lockstep.run_for(2.0)
    assert instants(team.applied)[-1] == last + 500_000_000
    assert at_rest(team.odom[-1])
    # Its controller is seen and sees: it goes on to command.
    assert team.commands[-1] != Twist()


@pytest.mark.lockstep(start=100.0)
@pytest.mark.parametrize('seconds', [-90.0, -1.0, -0.1, 0.05, 0.4, 2.0, 1e6])
def test_time_jumps_while_driving_and_the_robot_arrives(lockstep, team, seconds):
    lockstep.publish('goal_pose', goal(1.0, 1.0))
    lockstep.run_for(0.3)
    lockstep.jump(seconds)
    lockstep.run_for(0.05)
    assert len(team.starts) == (2 if seconds < 0.0 else 1)
    arrives(lockstep, team)
    assert team.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
    assert pose_of(team.odom[-1])[:2] == pytest.approx((1.0, 1.0), abs=0.02)
