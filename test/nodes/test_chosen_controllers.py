"""The control laws of the node go_to_goal: chosen at the start and live, refused, warned about."""

from __future__ import annotations

import itertools
import math

import pytest
from support.lockstep_nodes import (
    ACCEPTED,
    EXECUTING,
    SUCCEEDED,
    Controller,
    change,
    make,
)
from support.ros_messages import goal, goals, path

from diffdrive_jacobian.control import (
    VelocityLimits,
    go_to_goal,
    go_to_pose,
    offset_point,
    saturate,
    turn_in_place,
)
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal

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


@pytest.mark.parametrize(
    ('before', 'changes', 'goes_on'),
    [
        ('go_to_goal', {'controller': 'offset_point'}, False),
        ('offset_point', {'controller': 'pose'}, False),
        ('offset_point', {'offset': 0.1}, False),
        ('offset_point', {'odom_timeout': 0.4, 'xy_goal_tolerance': 0.03}, True),
    ],
    ids=str,
)
def test_only_another_driven_point_interrupts_the_turn_at_the_end(lockstep, before, changes, goes_on):
    controller = Controller(lockstep, controller=before, offset=0.3, use_goal_heading=True)
    x = 0.7 if before == 'offset_point' else 1.0
    controller.send(goal(1.0, 0.0, 2.0))
    turn = pytest.approx((0.0, 6.0))
    assert controller.at(x, 0.0) == turn
    assert controller.at(x, 0.1) == turn
    assert change(controller.node, **changes).successful
    assert (controller.at(x, 0.1) == turn) == goes_on


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
def test_what_does_not_fit_a_law_is_warned_about_with_the_first_goal_and_live(
    lockstep, capfd, name, values, others, expected
):
    def warned():
        said = capfd.readouterr().err
        return {words for words in (SPIRAL, COAST, BACK) if words in said}

    node = lockstep.add(make(GoToGoal, controller=name, **values))
    assert warned() == set()
    for warnings in ({expected}, set()):
        lockstep.publish('goal_pose', goal(1.0, 0.0))
        assert warned() == warnings
    # Another law has no such limit, or another one.
    other = 'offset_point' if name != 'offset_point' else 'go_to_goal'
    steps = [({'controller': other}, set()), ({'controller': name}, {expected})]
    for changes, warnings in [*steps, (others, set()), (values, {expected})]:
        assert change(node, **changes).successful
        assert warned() == warnings


def test_only_the_law_that_drives_is_warned_about(lockstep, capfd):
    """That of goals does not drive along a path, nor that of paths to a goal."""
    weaving = {'path_controller': 'kanayama', 'k_theta': 1.0}
    lockstep.add(make(GoToGoal, kp=0.5, kv=0.5, **weaving))
    for topic, message, heard, unheard in (
        ('path', path((0.0, 0.0), (1.0, 0.0)), 'the robot weaves about the path', SPIRAL),
        ('goal_pose', goal(1.0, 0.0), SPIRAL, 'weaves'),
    ):
        lockstep.publish(topic, message)
        said = capfd.readouterr().err
        assert heard in said
        assert unheard not in said


def test_a_robot_that_may_not_drive_forward_or_turn_is_warned_about(lockstep, capfd):
    node = lockstep.add(make(GoToGoal, linear__x__max_velocity=0.0))
    assert 'linear.x.max_velocity is 0: the robot may not drive forward' in capfd.readouterr().err
    assert change(node, angular__z__min_velocity=0.0).successful
    assert 'the robot may turn in one direction only or not at all' in capfd.readouterr().err
