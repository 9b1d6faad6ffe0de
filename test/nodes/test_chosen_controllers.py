"""The control laws of the node go_to_goal: chosen at the start and live, refused, warned about."""

from __future__ import annotations

import itertools
import math

import pytest
from support.lockstep_nodes import (
    ACCEPTED,
    EXECUTING,
    QUICK,
    SUCCEEDED,
    Controller,
    Topics,
    arrives,
    change,
    make,
)
from support.ros_messages import goal, goals, pose_of, twists

from diffdrive_jacobian.control import (
    VelocityLimits,
    go_to_goal,
    go_to_pose,
    offset_point,
    saturate,
    turn_in_place,
)
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot

LAWS = {
    'go_to_goal': lambda pose, to, kp, kv, d: go_to_goal(pose, to[:2], kp, kv),
    'offset_point': lambda pose, to, kp, kv, d: offset_point(pose, to[:2], kv, d),
    'pose': lambda pose, to, kp, kv, d: go_to_pose(pose, to, kp, kv),
}
POSES = [(0.0, 0.0, 0.0), (2.0, 0.5, math.pi), (-1.0, -0.3, 1.5), (0.9, 1.2, -2.5), (-1e5, 1e5, 1.0)]
PLAUSIBLE = VelocityLimits(min_v=-1e3, max_v=1e3, min_omega=-1e3, max_omega=1e3)


def point(pose, offset):
    """Position of the point that a law brings to its goal."""
    x, y, theta = pose
    return x + offset * math.cos(theta), y + offset * math.sin(theta)


# --- Commands


@pytest.mark.parametrize('name', LAWS)
def test_each_odometry_is_answered_by_the_law_chosen_at_the_start(lockstep, name):
    gains = {'kp': 5.0, 'kv': 1.5, 'offset': -0.2}
    controller = Controller(lockstep, controller=name, **gains)
    target, following = (1.0, 0.4, 2.0), (3.0, 3.0, 1.0)
    controller.send(goals(goal(*target), goal(*following)))
    for pose in POSES:
        law = LAWS[name](pose, target, *gains.values())
        expected = saturate(*law, PLAUSIBLE, 1.0, 1.0)
        assert controller.at(*pose) == pytest.approx(expected, rel=1e-9, abs=1e-12)
    # A waypoint counts by its position.
    assert controller.node.waypoint == 0
    here = (*point((*target[:2], 0.3), 0.2 if name == 'offset_point' else 0.0), 0.3)
    expected = LAWS[name](here, following, *gains.values())
    assert controller.at(*here) == pytest.approx(expected, rel=1e-9)
    assert controller.node.waypoint == 1


def test_the_command_after_a_switch_is_the_new_laws_and_the_goal_goes_on(lockstep):
    controller = Controller(lockstep)
    controller.send(goal(1.0, 0.4, 2.0))
    for names in itertools.permutations(LAWS, 2):
        for name, gains in zip(names, ((3.0, 0.5, 0.1), (7.0, 2.0, -0.4)), strict=True):
            values = dict(zip(('kp', 'kv', 'offset'), gains, strict=True))
            assert change(controller.node, controller=name, **values).successful
            expected = LAWS[name](POSES[2], (1.0, 0.4, 2.0), *gains)
            assert controller.at(*POSES[2]) == pytest.approx(expected, rel=1e-9)
    assert controller.statuses == [(0, ACCEPTED), (0, EXECUTING)]


def test_gains_and_limits_at_the_ends_of_their_range_give_finite_commands(lockstep):
    """Where the equation overflows, zero, and the goal is aborted."""
    controller, smallest = Controller(lockstep, offset=0.001), 5e-324
    none = {'linear__x__max_velocity': math.nan, 'angular__z__max_velocity': math.nan}
    limits = [none, *({**none, name: smallest} for name in none)]
    gains = [(100.0, smallest), (smallest, 100.0), (100.0, 100.0)]
    for name, (kp, kv), limit in itertools.product(LAWS, gains, limits):
        controller.send(goal(1e6, -1e6, 2.0))
        assert change(controller.node, controller=name, kp=kp, kv=kv, **limit).successful
        assert all(map(math.isfinite, controller.at(-1e6, 1e6, 1.0))), (name, kp, kv, limit)


# --- Where a goal is reached


def test_what_counts_as_arrived_is_switched_too(lockstep):
    controller = Controller(lockstep, offset=0.5)
    axle, ahead = (1.0, 0.0, 0.0), (0.5, 0.0, 0.0)
    for first, second in itertools.permutations(LAWS, 2):
        assert change(controller.node, controller=first).successful
        controller.send(goal(*axle))
        assert controller.at(*(axle if first == 'offset_point' else ahead)) != (0.0, 0.0)
        assert change(controller.node, controller=second).successful
        arrived = controller.at(*(ahead if second == 'offset_point' else axle)) == (0.0, 0.0)
        assert arrived, (first, second)
        assert controller.statuses[-1] == (0, SUCCEEDED)


@pytest.mark.parametrize('name', LAWS)
def test_where_the_heading_counts_the_robot_turns_in_place_at_the_end(lockstep, name):
    controller = Controller(lockstep, controller=name, offset=0.5, yaw_goal_tolerance=0.1)
    x = 0.5 if name == 'offset_point' else 1.0
    for use, heading in itertools.product((True, False), (-2.0, math.pi)):
        assert change(controller.node, use_goal_heading=use).successful
        controller.send(goals(goal(0.0, 9.0, 1.0), goal(1.0, 0.0, heading)))
        controller.at(*point((0.0, 9.0, math.pi / 2.0), x - 1.0), math.pi / 2.0)
        assert controller.node.waypoint == 1
        # Pose always takes the heading.
        if use or name == 'pose':
            assert controller.at(x, 0.0, 0.0) == pytest.approx(turn_in_place(0.0, heading, 3.0))
            # The position is not looked at any more, though the point swings off the goal.
            assert controller.at(x, 0.1, heading - 0.2) == pytest.approx((0.0, 0.6))
            assert controller.at(x, 0.1, heading - 0.09) == (0.0, 0.0)
        else:
            assert controller.at(x, 0.0, 0.0) == (0.0, 0.0)
        assert controller.statuses[-1] == (0, SUCCEEDED)


# --- Changes during the turn in place at the end

HEADING = 3.0


@pytest.mark.parametrize(
    ('before', 'changes'),
    [
        ('go_to_goal', {'controller': 'offset_point'}),
        ('go_to_goal', {'controller': 'pose'}),
        ('offset_point', {'controller': 'pose'}),
        ('offset_point', {'controller': 'go_to_goal', 'use_goal_heading': False}),
        ('offset_point', {'offset': 0.1}),
        ('offset_point', {'kp': 25.0, 'odom_timeout': 0.4, 'xy_goal_tolerance': 0.03}),
    ],
    ids=str,
)
def test_the_robot_is_driven_to_where_it_arrives_after_a_change(lockstep, before, changes):
    topics = Topics(lockstep)
    lockstep.add(make(VirtualRobot, publish_rate=25.0))
    # The robot turns slowly, so that there is time for a change.
    slowly = {'use_goal_heading': True, 'angular__z__max_velocity': 2.0}
    node = lockstep.add(make(GoToGoal, controller=before, offset=0.3, **slowly, **QUICK))
    target = point((0.0, 0.0, 0.0), 0.3 if before == 'offset_point' else 0.0)
    lockstep.publish('goal_pose', goal(*target, HEADING))
    lockstep.run_for(0.5)
    assert set(twists(topics.commands)) == {(0.0, 2.0)}
    changed = len(topics.odom)
    assert change(node, **changes).successful
    arrives(lockstep, topics)
    after = changes.get('controller', before)
    offset = changes.get('offset', 0.3) if after == 'offset_point' else 0.0
    poses = [pose_of(one) for one in topics.odom[changed:]]
    distances = [math.dist(point(one, offset), target) for one in poses]
    if 'kp' in changes or {before, after} == {'go_to_goal', 'pose'}:
        # The same point arrives, and it is there: the turn is not interrupted.
        assert not any(one.linear.x for one in topics.commands)
    else:
        assert min(distances) <= 0.02
    assert (abs(se2.wrap_angle(poses[-1][2] - HEADING)) <= 0.05) == ('use_goal_heading' not in changes)
    if after != 'offset_point':
        # The axle centre stays where it is while the robot turns.
        assert distances[-1] <= 0.02


# --- Warnings

SPIRAL, COAST, BACK = 'is not larger than kv', 'choose kp > 2 kv', 'may not back up'


@pytest.mark.parametrize(
    ('name', 'values', 'others', 'expected'),
    [
        ('go_to_goal', {'kp': 0.5, 'kv': 0.5}, {'kp': 0.6}, SPIRAL),
        ('pose', {'kp': 1.0, 'kv': 0.5}, {'kp': 1.1}, COAST),
        ('offset_point', {'linear__x__min_velocity': 0.0}, {'linear__x__min_velocity': -0.1}, BACK),
    ],
)
def test_what_does_not_fit_a_law_is_warned_about_at_the_start_and_live(
    lockstep, capfd, name, values, others, expected
):
    def warned():
        said = capfd.readouterr().err
        return {words for words in (SPIRAL, COAST, BACK) if words in said}

    node = lockstep.add(make(GoToGoal, controller=name, **values))
    assert warned() == {expected}
    # Another law has no such limit, or another one.
    other = 'offset_point' if name != 'offset_point' else 'go_to_goal'
    steps = [({'controller': other}, set()), ({'controller': name}, {expected})]
    for changes, warnings in [*steps, (others, set()), (values, {expected})]:
        assert change(node, **changes).successful
        assert warned() == warnings


def test_a_robot_that_may_not_drive_forward_is_warned_about(lockstep, capfd):
    controller = Controller(lockstep, linear__x__max_velocity=0.0)
    controller.send(goal(1, 1))
    assert controller.at(0, 0) == pytest.approx((0.0, 3.0 * math.pi / 4))
    assert 'linear.x.max_velocity is 0: the robot may not drive forward' in capfd.readouterr().err
