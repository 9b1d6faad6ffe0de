"""All three nodes together: goal to wheels to odometry, the whole Jacobian chain, in lockstep."""

from __future__ import annotations

import itertools
import math

import pytest
from geometry_msgs.msg import Twist
from std_srvs.srv import Trigger
from support.lockstep_nodes import (
    ACCEPTED,
    CANCELED,
    EXECUTING,
    QUICK,
    SUCCEEDED,
    Topics,
    add_team,
    arrives,
)
from support.ros_messages import at_rest, goal, goals, instants, pose_of, twists

from diffdrive_jacobian.control import go_to_goal
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.testing import Lockstep

STARTS = [(0.0, 0.0, 0.0), (0.0, 0.0, math.pi), (-1.0, 0.5, -2.0)]
GOALS = [(1.0, 1.0), (-1.0, 0.0), (0.3, -1.2), (-1.0, -1.0)]


def distances(topics, target):
    return [math.dist(pose_of(one)[:2], target) for one in topics.odom]


def test_golden_case_of_document_a_through_the_topics(lockstep):
    topics = Topics(lockstep)
    add_team(lockstep)
    lockstep.publish('goal_pose', goal(1.0, 1.0))
    lockstep.step()
    (command,) = twists(topics.commands)
    assert (round(command[0], 3), round(command[1], 3)) == (0.500, 2.356)
    left, right = topics.states[-1].velocity
    assert (left, right) == (0.0, 0.0)
    lockstep.step()
    left, right = topics.states[-1].velocity
    assert (round(right, 3), round(left, 3)) == (20.864, 9.440)


@pytest.mark.parametrize(('start', 'target'), list(itertools.product(STARTS, GOALS)), ids=str)
def test_robot_arrives_and_stands(lockstep, start, target):
    topics = Topics(lockstep)
    add_team(lockstep, pose=start, **QUICK)
    topics.odom.clear()
    lockstep.publish('goal_pose', goal(*target))
    arrives(lockstep, topics)
    assert topics.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
    # Each odometry on the way is answered by one command; only the last of them is zero.
    there = next(i for i, distance in enumerate(distances(topics, target)) if distance <= 0.02)
    assert len(topics.commands) == there + 1
    assert [i for i, command in enumerate(topics.commands) if command == Twist()] == [there]
    # And there it stands.
    assert all(one.pose == topics.odom[there].pose for one in topics.odom[there:])
    assert all(map(at_rest, topics.odom[there + 1 :]))
    assert len(topics.odom) > there + 5
    # The axle's centre goes as far as the mean wheel rolls forth and back: hardly less than straight.
    velocities = [sum(one.velocity) / 2.0 * 0.033 / 50.0 for one in topics.states]
    assert sum(map(abs, velocities)) >= math.dist(start[:2], target) - 0.02


@pytest.mark.parametrize('rate', [20.0, 100.0])
@pytest.mark.parametrize('target', GOALS, ids=str)
def test_the_nodes_drive_the_loop_of_the_pure_functions(lockstep, target, rate):
    topics = Topics(lockstep)
    add_team(lockstep, rate=rate, kp=8.0, kv=2.0)
    topics.odom.clear()
    lockstep.publish('goal_pose', goal(*target))
    lockstep.run_for(1.0)
    assert len(topics.odom) == rate
    pose = [0.0, 0.0, 0.0]
    for odometry in topics.odom:
        assert pose_of(odometry) == pytest.approx(pose, abs=1e-12)
        pose = se2.integrate(pose, go_to_goal(pose, target, 8.0, 2.0), 1.0 / rate)


@pytest.mark.parametrize('target', GOALS, ids=str)
def test_the_distance_never_grows(lockstep, target):
    topics = Topics(lockstep)
    add_team(lockstep, pose=(0.0, 0.0, math.pi), rate=100.0, kp=6.0, kv=3.0)
    topics.odom.clear()
    lockstep.publish('goal_pose', goal(*target))
    arrives(lockstep, topics)
    along = distances(topics, target)
    assert along[0] > 0.9
    # v = 0 when the goal is abeam: the held command may then lose what the heading changes meanwhile.
    assert all(later <= sooner + 1e-4 for sooner, later in itertools.pairwise(along))
    assert along[-1] <= 0.02


def test_goal_behind_is_reached_by_driving_backwards_first(lockstep, team):
    lockstep.publish('goal_pose', goal(-1.0, 0.01))
    arrives(lockstep, team)
    v = [speed for speed, _ in twists(team.commands)]
    assert v[0] < 0.0 < max(v)


@pytest.mark.parametrize('start', STARTS, ids=str)
def test_goal_at_the_robot_moves_nothing(lockstep, start):
    topics = Topics(lockstep)
    add_team(lockstep, pose=start)
    lockstep.publish('goal_pose', goal(*start))
    lockstep.run_for(1.0)
    assert topics.commands == [Twist()]
    assert topics.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
    assert {str(one.pose) for one in topics.odom} == {str(topics.odom[0].pose)}


@pytest.mark.parametrize('heading', [0.0, 2.0, math.pi, -1.5])
def test_final_heading_is_taken(lockstep, heading):
    topics = Topics(lockstep)
    add_team(lockstep, use_goal_heading=True, yaw_goal_tolerance=0.01, **QUICK)
    lockstep.publish('goal_pose', goal(0.5, 0.5, heading))
    arrives(lockstep, topics)
    x, y, theta = pose_of(topics.odom[-1])
    assert math.dist((x, y), (0.5, 0.5)) <= 0.02
    assert abs(se2.wrap_angle(theta - heading)) <= 0.01


@pytest.mark.parametrize(
    'waypoints',
    [
        [(0.5, 0.0), (0.5, 0.5)],
        [(0.5, 0.0), (0.5, 0.5), (0.0, 0.5), (0.0, 0.0)],
        [(0.3, 0.3), (-0.3, -0.3), (0.3, 0.3)],
    ],
    ids=len,
)
def test_waypoints_are_passed_in_order(lockstep, team, waypoints):
    team.odom.clear()
    lockstep.publish('goals', goals(*[goal(*one) for one in waypoints], stamp=9))
    arrives(lockstep, team)
    poses = iter(pose_of(one)[:2] for one in team.odom)
    # An iterator that goes on: each is passed after the one before.
    for waypoint in waypoints:
        assert any(math.dist(pose, waypoint) <= 0.02 for pose in poses)
    assert [one.goal_info.stamp.sec for one in team.status] == [9, 9, 9]
    assert team.commands.count(Twist()) == 1


@pytest.mark.parametrize('moment', [0.005, 0.1, 0.2])
def test_new_goal_takes_over_without_a_stop(lockstep, team, moment):
    lockstep.publish('goal_pose', goal(2.0, 0.0))
    lockstep.run_for(moment)
    lockstep.publish('goal_pose', goal(0.0, 1.0))
    arrives(lockstep, team)
    begun = [ACCEPTED] if moment < 0.01 else [ACCEPTED, EXECUTING]
    assert team.statuses == [*begun, CANCELED, ACCEPTED, EXECUTING, SUCCEEDED]
    assert pose_of(team.odom[-1])[:2] == pytest.approx((0.0, 1.0), abs=0.02)
    assert team.commands.count(Twist()) == 1


@pytest.mark.parametrize('moment', [0.005, 0.1, 0.2])
def test_cancel_stops_the_robot_at_once(lockstep, team, moment):
    lockstep.publish('goal_pose', goal(2.0, 1.0))
    lockstep.run_for(moment)
    assert lockstep.call(Trigger, 'cancel_goal').success
    assert instants(team.applied)[-1] == lockstep.now
    lockstep.run_for(0.02)
    here = team.odom[-1].pose
    assert at_rest(team.odom[-1])
    lockstep.run_for(2.0)
    assert team.odom[-1].pose == here
    assert team.statuses[-1] == CANCELED


# --- Several


def driven(names, targets):
    """Drive teams in a world of their own; give all that they say."""
    with Lockstep() as world:
        topics = [Topics(world, name) for name in names]
        for name in names:
            add_team(world, name, **QUICK)
        for name, target in zip(names, targets, strict=True):
            world.publish(f'{name}/goal_pose', goal(*target))
        world.run_for(1.0)
        return [(one.odom, one.states, one.applied, one.commands, one.statuses) for one in topics]


@pytest.mark.parametrize('count', [2, 5])
def test_robots_in_company_drive_as_each_drives_alone(count):
    names = [f'robot_{index}' for index in range(count)]
    targets = [(math.cos(index), math.sin(index) - 0.5) for index in range(count)]
    together = driven(names, targets)
    assert [one[-1][-1] for one in together] == [SUCCEEDED] * count
    assert len({str(one[0][-1].pose) for one in together}) == count
    for name, target, said in zip(names, targets, together, strict=True):
        assert driven([name], [target]) == [said]


@pytest.mark.parametrize('target', GOALS[:2], ids=str)
def test_two_runs_say_the_same_to_the_last_bit(target):
    first = driven(['a'], [target])
    assert len(first[0][0]) == 51
    assert driven(['a'], [target]) == first
