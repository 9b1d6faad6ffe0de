"""Document B's offset point: straight to its goal, like exp(-k t), as a law and through the nodes."""

from __future__ import annotations

import math

import numpy as np
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
from support.ros_messages import goal, goals, pose_of

from diffdrive_jacobian.control import Arrival, offset_point, saturate
from diffdrive_jacobian.kinematics import diff_drive, se2
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.simulation import closed_loops

COUNT = 10_000
STARTS = [(0.0, 0.0, math.pi), (-0.5, 0.3, -2.0)]
NODE = {'controller': 'offset_point', 'kv': 4.0}


def random_cases(seed, count=COUNT):
    """States, goals, gains, and points in front of the axle and behind it."""
    rng = np.random.default_rng(seed)
    states = rng.uniform([-5.0, -5.0, -np.pi], [5.0, 5.0, np.pi], (count, 3))
    goals = rng.uniform(-5.0, 5.0, (count, 2))
    k = 10.0 ** rng.uniform(-1.0, 1.0, count)
    d = rng.choice([-1.0, 1.0], count) * 10.0 ** rng.uniform(-2.0, 0.5, count)
    return states, goals, k, d


def point(poses, d):
    """The point, written out."""
    x, y, theta = np.moveaxis(np.asarray(poses), -1, 0)
    return np.stack([x + d * np.cos(theta), y + d * np.sin(theta)], -1)


# --- The law


def test_the_law_is_the_inverse_of_document_bs_jacobian():
    states, targets, k, d = random_cases(1)
    r, L = np.random.default_rng(2).uniform([[0.01], [0.1]], [[0.1], [0.6]], (2, COUNT))
    J_d = diff_drive.offset_point_jacobian(states[:, 2], r, L, d)
    wanted = k[:, np.newaxis] * (targets - diff_drive.offset_point(states, d))
    wheels = np.linalg.solve(J_d, wanted[..., np.newaxis])[..., 0]
    law = np.array(offset_point(states, targets, k, d))
    twist = np.array(diff_drive.wheel_to_body(*wheels.T, r, L))
    np.testing.assert_allclose(law, twist, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        np.array(diff_drive.body_to_wheel(*law, r, L)).T, wheels, rtol=1e-9, atol=1e-7
    )


def test_the_point_moves_straight_towards_its_goal_whatever_the_heading():
    states, targets, k, d = random_cases(3)
    v, omega = offset_point(states, targets, k, d)
    c, s = np.cos(states[:, 2]), np.sin(states[:, 2])
    moves = np.stack([v * c - d * omega * s, v * s + d * omega * c], -1)
    wanted = k[:, np.newaxis] * (targets - point(states, d))
    np.testing.assert_allclose(moves, wanted, rtol=1e-11, atol=1e-11)


def test_states_goals_gains_and_offsets_broadcast():
    states, targets, k, d = random_cases(4, 5)
    v, omega = offset_point(states[:, np.newaxis], targets[:4], k[:, np.newaxis], d[:4])
    assert v.shape == omega.shape == (5, 4)
    for i, j in np.ndindex(5, 4):
        one = offset_point(states[i], targets[j], k[i], d[j])
        np.testing.assert_allclose([v[i, j], omega[i, j]], one, rtol=1e-12, atol=1e-14)
        assert type(one[0]) is type(one[1]) is float


def test_with_the_point_on_the_goal_it_rests():
    states, _, k, d = random_cases(5)
    v, omega = offset_point(states, point(states, d), k, d)
    assert np.abs(v / k).max() < 1e-14
    assert np.abs(omega * d / k).max() < 1e-14
    assert offset_point([1.0, 2.0, 0.0], [1.5, 2.0], 3.0, 0.5) == (0.0, 0.0)


def test_the_error_of_the_sampled_path_is_of_first_order_in_the_sampling_time():
    """From the straight line, and from exp(-k t) of the distance, over three decades."""
    rng = np.random.default_rng(6)
    count, k, duration = 20, 1.0, 0.5
    start = rng.uniform([-1.0, -1.0, -np.pi], [1.0, 1.0, np.pi], (count, 3))
    d = rng.choice([-1.0, 1.0], count) * rng.uniform(0.5, 1.0, count)
    bearing = rng.uniform(-np.pi, np.pi, count)
    along = np.stack([np.cos(bearing), np.sin(bearing)], -1)
    target = point(start, d) + along
    errors = []
    for steps in (5, 50, 500, 5000):
        here, aside, decay = start, np.zeros(count), np.zeros(count)
        for step in range(1, steps + 1):
            here = se2.integrate(here, np.stack(offset_point(here, target, k, d), -1), duration / steps)
            left = target - point(here, d)
            aside = np.maximum(aside, np.abs(along[:, 0] * left[:, 1] - along[:, 1] * left[:, 0]))
            exact = math.exp(-k * step * duration / steps)
            decay = np.maximum(decay, np.abs(np.hypot(*left.T) - exact))
        errors.append([aside.max(), decay.max()])
    dt = duration / np.array([5, 50, 500, 5000])
    slopes = np.polyfit(np.log(dt), np.log(errors), 1)[0]
    assert slopes == pytest.approx([1.0, 1.0], abs=0.05), errors
    assert np.max(errors[-1]) < 1e-4


def test_from_10000_starts_the_point_arrives_when_it_should_with_the_axle_beside_the_goal():
    states, targets, _, d = random_cases(7)
    k, d = 1.0, d + np.copysign(0.2, d)
    states[:1000, 2] = np.pi
    targets[:500] = states[:500, :2] + [3.0, 0.0]  # exactly behind
    found = closed_loops(offset_point, states, targets, k, d, duration=15.0, arrival=Arrival(offset=d))
    failed = np.flatnonzero(~found.arrived)
    assert not failed.size, [(*states[i], *targets[i], d[i]) for i in failed[:10]]
    assert np.hypot(*(point(found.pose, d) - targets).T).max() <= 0.02
    axle = np.hypot(*(found.pose[:, :2] - targets).T)
    assert np.abs(axle - np.abs(d)).max() <= 0.02
    expected = np.log(np.maximum(np.hypot(*(point(states, d) - targets).T) / 0.02, 1.0)) / k
    assert np.abs(found.time - expected).max() < 0.3


@pytest.mark.parametrize('d', [0.0, -0.0, 0, False, [0.1, 0.0], np.zeros((2, 2))], ids=str)
def test_the_axle_centre_itself_is_refused_with_the_reason(d):
    with pytest.raises(ValueError, match=r'^d must be .*not 0.* rank 1.*got -?0'):
        offset_point([0.0, 0.0, 0.0], [1.0, 1.0], 1.0, d)


GOOD = {'state': np.zeros((2, 3)), 'goal': [1.0, 1.0], 'k': 1.0, 'd': 0.1}


@pytest.mark.parametrize(
    ('name', 'bad', 'message'),
    [
        ('state', np.zeros(2), r'^state must have shape \(\.\.\., 3\), got \(2,\)$'),
        ('state', 0.0, r'^state must have shape \(\.\.\., 3\), got \(\)$'),
        ('state', [[0.0, 0.0, np.nan]], r'^state must be finite, got nan'),
        ('state', 'here', r'^state must be an array of real numbers, got here'),
        ('goal', np.zeros(3), r'^goal must have shape \(\.\.\., 2\), got \(3,\)$'),
        ('goal', [0.0, -np.inf], r'^goal must be finite, got .*-inf'),
        ('goal', np.zeros((3, 2)), r'^state and goal .*broadcast, got state \(2,\), goal \(3,\)$'),
        ('k', np.ones(3), r'^state and k .*broadcast, got state \(2,\), k \(3,\)$'),
        ('k', np.nan, r'^k must be finite, got nan$'),
        ('k', [1.0, np.inf], r'^k must be finite, got inf at index 1$'),
        ('k', 1j, r'^k must be an array of real numbers'),
        ('d', np.ones(3), r'^state and d .*broadcast, got state \(2,\), d \(3,\)$'),
        ('d', np.nan, r'^d must be finite and not 0.*got nan$'),
        ('d', [np.inf, 1.0], r'^d must be finite and not 0.*got inf at index 0$'),
    ],
)
def test_invalid_arguments_are_named(name, bad, message):
    with pytest.raises(ValueError, match=message):
        offset_point(**{**GOOD, name: bad})


# --- The node


@pytest.mark.parametrize('offset', [0.1, -0.25, 3.0])
def test_each_odometry_is_answered_by_the_law_and_arrival_is_judged_at_the_point(lockstep, offset):
    controller = Controller(lockstep, controller='offset_point', offset=offset, kv=0.7)
    controller.send(goal(2.0, -1.0, 1.0))
    limits = VelocityLimits(min_v=-1e3, max_v=1e3, min_omega=-1e3, max_omega=1e3)
    for pose in [(0.0, 0.0, 0.0), (1.0, 1.0, math.pi), (5.0, -1.0, -2.0), (2.0, -1.03, math.pi / 2.0)]:
        law = saturate(*offset_point(pose, [2.0, -1.0], 0.7, offset), limits, 1.0, 1.0)
        assert controller.at(*pose) == pytest.approx(law, rel=1e-12, abs=1e-12)
    # The axle centre on the goal is not the point on the goal.
    assert controller.at(2.0, -1.0, 0.5) != (0.0, 0.0)
    assert controller.statuses[-1] == (0, EXECUTING)
    away = offset + math.copysign(0.019, offset)
    assert controller.at(2.0, -1.0 - away, math.pi / 2.0) == (0.0, 0.0)
    assert controller.statuses == [(0, ACCEPTED), (0, EXECUTING), (0, SUCCEEDED)]


def test_with_several_goals_the_point_reaches_each(lockstep):
    controller = Controller(lockstep, controller='offset_point', offset=0.5)
    controller.send(goals(goal(1, 0), goal(1, 1)))
    controller.at(1.0, 0.0)
    assert controller.node.waypoint == 0
    assert controller.at(0.5, 0.0) == pytest.approx(offset_point([0.5, 0.0, 0.0], [1.0, 1.0], 0.5, 0.5))
    assert controller.node.waypoint == 1
    assert controller.at(1.0, 0.5, math.pi / 2.0) == (0.0, 0.0)


@pytest.mark.parametrize('offset', [0.2, -0.2])
@pytest.mark.parametrize('start', STARTS, ids=str)
@pytest.mark.parametrize('wheels', [False, True], ids=['twist', 'wheels'])
def test_the_point_arrives_on_a_straight_line_and_the_axle_stays_beside(lockstep, wheels, start, offset):
    topics, target = Topics(lockstep), (1.0, 0.4)
    x, y, theta = start
    if wheels:
        add_team(lockstep, pose=start, offset=offset, **NODE)
    else:
        lockstep.add(make(VirtualRobot, x=x, y=y, theta=theta))
        lockstep.add(make(GoToGoal, offset=offset, **NODE))
    topics.odom.clear()
    lockstep.publish('goal_pose', goal(*target))
    arrives(lockstep, topics)
    assert topics.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
    poses = np.array([pose_of(one) for one in topics.odom])
    assert math.dist(point(poses[-1], offset), target) <= 0.02
    assert math.dist(poses[-1, :2], target) == pytest.approx(0.2, abs=0.02)
    # What is driven is the loop of the pure functions.
    here = np.array(start)
    for pose in poses[: len(topics.commands)]:
        np.testing.assert_allclose(pose, here, atol=1e-9)
        here = se2.integrate(here, offset_point(here, target, 4.0, offset), 0.02)


@pytest.mark.parametrize('rates', [(50.0, 200.0)])
def test_through_the_nodes_the_line_is_the_straighter_the_faster_they_run(lockstep, rates):
    """By first order, to the straight line and to exp(-k t)."""
    errors = []
    for namespace, rate in zip('ab', rates, strict=True):
        topics = Topics(lockstep, namespace)
        add_team(lockstep, namespace, rate=rate, controller='offset_point', kv=1.0, offset=0.4)
        topics.odom.clear()
        lockstep.publish(f'{namespace}/goal_pose', goal(-0.2, 0.5))
        lockstep.run_for(1.0)
        left = np.array([-0.2, 0.5]) - [point(pose_of(one), 0.4) for one in topics.odom]
        along = left[0] / np.hypot(*left[0])
        way = np.hypot(*left[0]) * np.exp(-np.arange(len(left)) / rate)
        errors.append([np.abs(left @ [-along[1], along[0]]).max(), np.abs(left @ along - way).max()])
    ratio = np.divide(*errors)
    assert ratio == pytest.approx(rates[1] / rates[0], rel=0.2), errors
    assert np.max(errors[0]) < 0.02


@pytest.mark.parametrize('bad', [0.0, -0.0, 0.0009, -0.0009, math.nan, math.inf, 101.0])
def test_an_invalid_offset_is_refused_with_the_reason_at_the_start_and_live(lockstep, bad):
    tiny = abs(bad) < 1e-3
    with pytest.raises(ParameterError, match="'offset' must be " + ('.*rank 1' if tiny else 'in')):
        make(GoToGoal, controller='offset_point', offset=bad)
    controller = Controller(lockstep, controller='offset_point', offset=-0.3)
    controller.send(goal(1.0, 1.0))
    before = controller.at(0.0, 0.0, 1.0)
    result = change(controller.node, offset=bad, kv=5.0)
    assert not result.successful
    assert 'offset' in result.reason
    assert not tiny or 'rank 1' in result.reason
    assert controller.node.get_parameter('offset').value == -0.3
    assert controller.at(0.0, 0.0, 1.0) == before


def test_the_offset_changes_live_and_so_does_where_it_arrives(lockstep):
    controller = Controller(lockstep, controller='offset_point')
    controller.send(goal(1.0, 0.0))
    pose = (0.0, 0.2, 0.3)
    for offset in (0.1, -0.4, 0.001, -0.001, 2.0):
        assert change(controller.node, offset=offset).successful
        assert controller.at(*pose) == pytest.approx(offset_point(pose, [1.0, 0.0], 0.5, offset))
    assert change(controller.node, offset=0.5).successful
    assert controller.at(0.5, 0.0) == (0.0, 0.0)
    assert controller.statuses[-1] == (0, SUCCEEDED)
