"""The built-in controllers of the node go_to_goal, chosen at the start and changed during a drive."""

from __future__ import annotations

import itertools
import math

import pytest
from support.lockstep_nodes import (
    ACCEPTED,
    EXECUTING,
    SUCCEEDED,
    Controller,
    Topics,
    add_team,
    arrives,
    change,
    make,
)
from support.ros_messages import goal, goals, pose_of, twists

from diffdrive_jacobian.control import go_to_goal, go_to_pose, offset_point, turn_in_place
from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.parameters.declaration import ParameterError

LAWS = {
    'go_to_goal': lambda pose, to, kp, kv, d: go_to_goal(pose, to[:2], kp, kv),
    'offset_point': lambda pose, to, kp, kv, d: offset_point(pose, to[:2], kv, d),
    'pose': lambda pose, to, kp, kv, d: go_to_pose(pose, to, kp, kv),
}
PAIRS = list(itertools.permutations(LAWS, 2))
POSES = [(0.0, 0.0, 0.0), (2.0, 0.5, math.pi), (-1.0, -0.3, 1.5), (0.9, 1.2, -2.5)]
SPIRAL, COAST, BACK = 'spirals in', 'choose kp > 2 kv', 'may not back up'


@pytest.mark.parametrize('name', LAWS)
def test_each_law_answers_when_it_is_chosen_at_the_start(lockstep, name):
    controller = Controller(lockstep, controller=name, kp=5.0, kv=1.5, offset=-0.2)
    controller.send(goal(1.0, 0.4, 2.0))
    for pose in POSES:
        expected = LAWS[name](pose, (1.0, 0.4, 2.0), 5.0, 1.5, -0.2)
        assert controller.at(*pose) == pytest.approx(expected, rel=1e-9)


def test_document_as_law_and_a_point_in_front_are_the_defaults(lockstep):
    node = Controller(lockstep).node
    assert [node.get_parameter(name).value for name in ('controller', 'offset')] == ['go_to_goal', 0.1]


@pytest.mark.parametrize(('first', 'second'), PAIRS)
def test_the_command_after_a_switch_is_exactly_the_new_laws(lockstep, first, second):
    controller = Controller(lockstep, controller=first, kv=0.5)
    controller.send(goals(goal(1.0, 0.4, 2.0), goal(3.0, 3.0, 1.0)))
    for pose in POSES:
        for name in (first, second, first):
            assert change(controller.node, controller=name).successful
            expected = LAWS[name](pose, (1.0, 0.4, 2.0), 3.0, 0.5, 0.1)
            assert controller.at(*pose) == pytest.approx(expected, rel=1e-9)
    # With gains and offset at once; and the goal goes on.
    changes = {'controller': second, 'kp': 7.0, 'kv': 2.0, 'offset': 0.4}
    assert change(controller.node, **changes).successful
    expected = LAWS[second](POSES[0], (1.0, 0.4, 2.0), 7.0, 2.0, 0.4)
    assert controller.at(*POSES[0]) == pytest.approx(expected, rel=1e-9)
    assert controller.statuses == [(0, ACCEPTED), (0, EXECUTING)]


@pytest.mark.parametrize(('first', 'second'), PAIRS)
def test_a_robot_whose_law_is_switched_in_the_middle_of_a_drive_arrives_by_the_new_one(
    lockstep, first, second
):
    topics, target = Topics(lockstep), (0.8, 0.5, -2.0)
    gains = {'kp': 10.0, 'kv': 4.0, 'offset': 0.3}
    *_, controller = add_team(lockstep, pose=(0.0, 0.0, 2.0), controller=first, **gains)
    topics.odom.clear()
    lockstep.publish('goal_pose', goal(*target))
    lockstep.run_for(0.2)
    sent = len(topics.commands)
    assert change(controller, controller=second).successful
    arrives(lockstep, topics)
    for index, name in ((sent - 1, first), (sent, second), (sent + 1, second)):
        expected = LAWS[name](pose_of(topics.odom[index]), target, 10.0, 4.0, 0.3)
        assert twists(topics.commands)[index] == pytest.approx(expected, rel=1e-9)
    assert topics.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
    x, y, theta = pose_of(topics.odom[-1])
    ahead = 0.3 if second == 'offset_point' else 0.0
    there = (x + ahead * math.cos(theta), y + ahead * math.sin(theta))
    assert math.dist(there, target[:2]) <= 0.02
    assert second != 'pose' or abs(wrap_angle(theta - target[2])) <= 0.02


@pytest.mark.parametrize(('first', 'second'), PAIRS)
def test_what_counts_as_arrived_is_switched_too(lockstep, first, second):
    controller = Controller(lockstep, controller=first, offset=0.5)
    axle, point = (1.0, 0.0, 0.0), (0.5, 0.0, 0.0)
    controller.send(goal(*axle))
    assert controller.at(*(axle if first == 'offset_point' else point)) != (0.0, 0.0)
    assert change(controller.node, controller=second).successful
    assert controller.at(*(point if second == 'offset_point' else axle)) == (0.0, 0.0)
    assert controller.statuses[-1] == (0, SUCCEEDED)


@pytest.mark.parametrize('bad', ['', 'Pose', 'go-to-goal', 'mpc'])
def test_a_law_that_does_not_exist_is_refused_with_the_choices(lockstep, bad):
    choices = "'controller' must be one of 'go_to_goal', 'offset_point', 'pose', got"
    with pytest.raises(ParameterError) as caught:
        make(GoToGoal, controller=bad)
    assert f'{choices} {bad!r}' in str(caught.value)
    controller = Controller(lockstep, controller='pose')
    controller.send(goal(1.0, 0.4, 2.0))
    before = controller.at(0.0, 0.0)
    result = change(controller.node, controller=bad, kp=9.0)
    assert not result.successful
    assert f'{choices} {bad!r}' in result.reason
    assert controller.node.get_parameter('controller').value == 'pose'
    assert controller.at(0.0, 0.0) == before


@pytest.mark.parametrize('bad', [1, 2.0, True, ['pose']], ids=str)
def test_a_law_that_is_no_name_is_refused(lockstep, bad):
    with pytest.raises(ParameterError, match="'controller'"):
        make(GoToGoal, controller=bad)
    controller = Controller(lockstep)
    assert not change(controller.node, controller=bad).successful
    assert controller.node.get_parameter('controller').value == 'go_to_goal'


@pytest.mark.parametrize('gains', [(100.0, 5e-324), (5e-324, 100.0), (100.0, 100.0)], ids=str)
@pytest.mark.parametrize('name', LAWS)
def test_gains_at_the_ends_of_their_range_give_finite_commands(lockstep, name, gains):
    kp, kv = gains
    controller = Controller(lockstep, controller=name, kp=kp, kv=kv, offset=0.001)
    controller.send(goal(1e6, -1e6, 2.0))
    assert all(map(math.isfinite, controller.at(-1e6, 1e6, 1.0)))


# --- The heading at the end


@pytest.mark.parametrize('heading', [-2.0, math.pi, 0.5])
@pytest.mark.parametrize('name', ['go_to_goal', 'offset_point'])
def test_laws_without_a_heading_turn_in_place_at_the_end_where_it_counts(lockstep, name, heading):
    controller = Controller(
        lockstep, controller=name, offset=0.5, use_goal_heading=True, yaw_goal_tolerance=0.1
    )
    x = 0.5 if name == 'offset_point' else 1.0
    controller.send(goals(goal(0.0, 9.0, 1.0), goal(1.0, 0.0, heading)))
    controller.at(0.0, 8.5 if x == 0.5 else 9.0, math.pi / 2.0)
    assert controller.node.waypoint == 1
    assert controller.at(x, 0.0, 0.0) == pytest.approx(turn_in_place(0.0, heading, 3.0))
    # The position is not looked at any more, though the point swings off the goal.
    assert controller.at(x, 0.0, heading - 0.2) == pytest.approx((0.0, 0.6))
    assert controller.at(x, 0.0, heading - 0.09) == (0.0, 0.0)
    assert controller.statuses[-1] == (0, SUCCEEDED)


@pytest.mark.parametrize('name', LAWS)
def test_whether_the_heading_counts_changes_live_and_pose_always_takes_it(lockstep, name):
    controller = Controller(lockstep, controller=name, offset=0.5)
    x = 0.5 if name == 'offset_point' else 1.0
    for use in (True, False):
        assert change(controller.node, use_goal_heading=use).successful
        controller.send(goal(1.0, 0.0, 2.0))
        turns = use or name == 'pose'
        assert controller.at(x, 0.0) == (pytest.approx((0.0, 6.0)) if turns else (0.0, 0.0))


@pytest.mark.parametrize('heading', [-1.0, 1.5])
@pytest.mark.parametrize('name', ['go_to_goal', 'offset_point'])
def test_through_the_nodes_the_heading_is_there_at_the_end(lockstep, name, heading):
    topics = Topics(lockstep)
    gains = {'kp': 10.0, 'kv': 4.0, 'offset': 0.1}
    add_team(lockstep, controller=name, use_goal_heading=True, **gains)
    lockstep.publish('goal_pose', goal(-0.5, 0.2, heading))
    arrives(lockstep, topics)
    x, y, theta = pose_of(topics.odom[-1])
    assert abs(wrap_angle(theta - heading)) <= 0.02
    v, omega = twists(topics.commands)[-2]
    assert v == 0.0 != omega
    assert math.dist((x, y), (-0.5, 0.2)) <= 0.02 + (0.1 if name == 'offset_point' else 0.0)


# --- Warnings


def warned(capfd):
    said = capfd.readouterr().err
    return {words for words in (SPIRAL, COAST, BACK) if words in said}


@pytest.mark.parametrize(
    ('name', 'kp', 'kv', 'expected'),
    [
        ('go_to_goal', 0.5, 0.5, {SPIRAL}),
        ('go_to_goal', 0.4, 0.5, {SPIRAL}),
        ('go_to_goal', 0.6, 0.5, set()),
        ('offset_point', 0.1, 5.0, set()),
        ('pose', 1.0, 0.5, {COAST}),
        ('pose', 0.4, 0.5, {COAST}),
        ('pose', 1.1, 0.5, set()),
        ('pose', 3.0, 0.5, set()),
    ],
)
def test_gains_are_warned_about_only_with_the_law_they_do_not_fit(
    lockstep, capfd, name, kp, kv, expected
):
    controller = Controller(lockstep, controller=name, kp=kp, kv=kv)
    assert warned(capfd) == expected
    # And when they come, or the law comes, live.
    other = 'offset_point' if name != 'offset_point' else 'go_to_goal'
    change(controller.node, controller=other, kp=9.0, kv=1.0)
    assert warned(capfd) == set()
    assert change(controller.node, controller=name).successful
    assert warned(capfd) == set()
    assert change(controller.node, kp=kp, kv=kv).successful
    assert warned(capfd) == expected


@pytest.mark.parametrize('name', ['go_to_goal', 'offset_point', 'pose'])
@pytest.mark.parametrize('limit', ['linear__x__max_velocity', 'angular__z__max_velocity'])
def test_the_tiniest_limit_kills_no_node(lockstep, name, limit):
    controller = Controller(lockstep, controller=name, kp=100.0, kv=50.0, **{limit: 5e-324})
    controller.send(goal(5.0, 3.0))
    v, omega = controller.at(0.0, 0.0)
    assert math.isfinite(v)
    assert math.isfinite(omega)


@pytest.mark.parametrize(
    ('name', 'limit', 'expected'),
    [
        ('offset_point', 0.0, {BACK}),
        ('offset_point', -0.1, set()),
        ('go_to_goal', 0.0, set()),
        ('pose', 0.0, set()),
    ],
)
def test_a_robot_that_may_not_back_up_is_warned_about_with_offset_point(
    lockstep, capfd, name, limit, expected
):
    controller = Controller(lockstep, controller=name, linear__x__min_velocity=limit)
    assert warned(capfd) == expected
    assert change(controller.node, linear__x__min_velocity=-1.0).successful
    assert warned(capfd) == set()
    assert change(controller.node, linear__x__min_velocity=limit).successful
    assert warned(capfd) == expected
    assert change(controller.node, controller='offset_point').successful
    assert warned(capfd) == ({BACK} if limit == 0.0 else set())
