"""Inverse kinematics beyond one search from q0: singular starts, restarts, joint limits, no Jacobian."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ik_tasks import (
    DOWNHILL,
    FIVE,
    LONG_FIRST,
    THREE,
    TOLERANCE,
    TWO,
    Task,
    anywhere,
    assert_same,
    at,
    configurations,
    unreachable,
)

from diffdrive_jacobian.kinematics.inverse_kinematics import METHODS, pose_difference, solve
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

# --- Nearly singular and singular


def rim(short, count=5_000):
    """Return targets from random joints that need both long links aligned, and random starts."""
    arm = PlanarArm([1.0, short, 1.0])
    target, q0 = Task(arm).forward(anywhere(arm, count, 13)), anywhere(arm, count, 14)
    near = np.linalg.norm(target, axis=1) > 1.999
    return Task(arm), target[near], q0[near]


@pytest.mark.parametrize('short', [1e-2, 1e-4])
@pytest.mark.parametrize('numeric', [False, True], ids=['jacobian', 'no jacobian'])
def test_a_short_link_does_not_slow_levenberg_marquardt_down(short, numeric):
    # The long links have to stay aligned while the short one turns: J is nearly singular all the way.
    task, target, q0 = rim(short)
    assert len(target) > 50
    jacobian = None if numeric else task.jacobian
    result = solve(task.forward, jacobian, target, q0, restarts=0)
    assert result.converged.all()
    assert result.iterations.max() < 60


def test_the_nearest_point_of_a_long_chain_is_found_in_few_steps():
    arm = PlanarArm([0.5, 0.45, 0.4, 0.35, 0.3, 0.25, 0.2])
    target, _, distance = unreachable(arm, 'too far', 30)
    result = Task(arm).solve(target, anywhere(arm, len(target)), restarts=0)
    np.testing.assert_allclose(result.error, distance, atol=1e-9)
    assert result.iterations.max() < 50


@pytest.mark.parametrize('method', METHODS)
def test_the_natural_first_try_is_reached(method):
    arm = PlanarArm([1.0, 1.0])
    task = Task(arm)
    result = task.solve([1.0, 0.0], [0.0, 0.0], method=method)
    assert result.converged
    assert result.start == result.restarts == 1
    np.testing.assert_allclose(task.forward(result.q[np.newaxis])[0], [1.0, 0.0], atol=TOLERANCE)
    # A start that cannot take a step is left for one not far away.
    first = task.derived[1][0]
    assert 0.0 < np.abs(first).max() < 0.1 * np.pi


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize(('distance', 'angle'), [(0.5, 0.0), (1.2, 2.5), (2.5, 0.3)])
def test_a_stretched_arm_is_restarted_as_no_joint_moves_it_along_its_own_line(distance, angle, method):
    target, q0 = at(distance, angle), np.array([angle, 0.0])
    alone = Task(TWO).solve(target, q0, method=method, restarts=0)
    assert not alone.converged
    assert alone.iterations == alone.restarts == alone.start == 0
    assert np.array_equal(alone.q, q0)
    assert alone.error == pytest.approx(abs(1.7 - distance))
    steps = 5000 if method == 'transpose' else 500
    result = Task(TWO).solve(target, q0, method=method, max_iterations=steps)
    assert result.converged == (distance < 1.7)
    assert result.restarts > 0
    assert result.error == pytest.approx(max(0.0, distance - 1.7), abs=TOLERANCE)


# --- Restarts


class Walled(Task):
    """An arm with joint limits; what it is asked beyond them fails the test."""

    def __init__(self, arm, lower, upper, heading=False):
        super().__init__(arm, heading)
        self.limits = np.broadcast_to(lower, arm.joints), np.broadcast_to(upper, arm.joints)
        self.seen = []

    def forward(self, q):
        assert np.all((q >= self.limits[0]) & (q <= self.limits[1]))
        self.seen.append(q.copy())
        return super().forward(q)

    def inside(self, count, seed):
        lower, upper = (np.clip(side, -np.pi, np.pi) for side in self.limits)
        return np.random.default_rng(seed).uniform(lower, upper, (count, self.arm.joints))

    def solve(self, target, q0, **options):
        return super().solve(target, q0, limits=self.limits, **options)


def test_restarts_find_what_one_search_does_not():
    task = Walled(THREE, -2.0, 2.0, heading=True)
    target, q0 = task.forward(task.inside(100, 0)), task.inside(100, 1)
    alone, several = task.solve(target, q0, restarts=0), task.solve(target, q0, restarts=100)
    assert np.count_nonzero(alone.converged) < 85
    assert np.count_nonzero(several.converged) >= 99
    assert not alone.restarts.any()
    # The first search is the same but for rounding, and what it finds stays.
    by_first = several.start == 0
    np.testing.assert_allclose(several.q[alone.converged], alone.q[alone.converged], atol=1e-9)
    assert np.all(several.error <= alone.error + 1e-12)
    np.testing.assert_allclose(several.error[by_first], alone.error[by_first], atol=1e-12)
    assert np.array_equal(several.start[several.converged], several.restarts[several.converged])
    assert np.all(several.start <= several.restarts)
    off = pose_difference(target, task.forward(several.q))
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), several.error, atol=1e-14)


def test_restarts_are_the_same_for_the_same_seed():
    task, target = Walled(THREE, -2.0, 2.0, heading=True), THREE.forward_kinematics([1.9, 1.9, -1.9])
    q0 = task.inside(50, 2)
    one, same, other = (task.solve(target, q0, seed=seed) for seed in (3, 3, 4))
    assert one.restarts.any()
    assert_same(one, same)
    assert not np.array_equal(one.q, other.q)
    drawn = task.solve(target, q0, seed=np.random.default_rng(3))
    assert_same(one, drawn)


@pytest.mark.parametrize('restarts', [0, 1, 5])
def test_restarts_end(restarts):
    task, (target, _, distance) = Task(LONG_FIRST[1]), unreachable(LONG_FIRST[1], 'too far')
    q0 = anywhere(LONG_FIRST[1], len(target))
    result = task.solve(target, q0, restarts=restarts)
    # Three searches with the same end suffice.
    assert np.all(result.restarts == min(restarts, 2))
    np.testing.assert_allclose(result.error, distance, atol=1e-9)
    few = task.solve(target, q0, restarts=restarts, max_iterations=30)
    assert few.iterations.max() <= 30


def test_a_search_that_runs_in_circles_is_restarted():
    task = Task(TWO)
    target, q0 = task.forward(anywhere(TWO, 60, 15)), anywhere(TWO, 60, 16)
    alone = task.solve(target, q0, method='newton', restarts=0)
    several = task.solve(target, q0, method='newton', max_iterations=2000)
    assert np.count_nonzero(alone.converged) < 59
    assert several.converged.all()


# --- Joint limits


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('numeric', [False, True], ids=['jacobian', 'no jacobian'])
def test_solutions_are_within_the_limits(method, numeric):
    task = Walled(THREE, [-3.0, -0.2, -np.inf], [1.0, 2.4, 1.5])
    target, q0 = task.forward(task.inside(60, 0)), task.inside(60, 1)
    jacobian = None if numeric else task.jacobian
    result = solve(task.forward, jacobian, target, q0, method=method, limits=task.limits)
    # `forward` checks that nothing beyond them was asked.
    task.forward(result.q)
    assert np.count_nonzero(result.converged) >= (55 if method == 'transpose' else 60)


@pytest.mark.parametrize('method', DOWNHILL)
def test_the_nearest_point_within_the_limits_is_found(method):
    task = Walled(TWO, [-1.0, 0.3], [0.5, 1.5])
    target = np.random.default_rng(17).uniform(-2.0, 2.0, (20, 2))
    result = task.solve(target, task.inside(20, 1), method=method, max_iterations=2000)
    grid = np.stack(np.meshgrid(np.linspace(-1.0, 0.5, 301), np.linspace(0.3, 1.5, 301)), axis=-1)
    points = TWO.forward_kinematics(grid.reshape(-1, 2))[:, :2] @ [1.0, 1j]
    least = np.array([np.abs(one - points).min() for one in target @ [1.0, 1j]])
    assert np.count_nonzero(~result.converged) > 10
    assert np.all(result.error >= least - 0.01)
    # Limits leave local minima, and several searches may end in the same one.
    assert np.count_nonzero(result.error <= least + TOLERANCE) >= 18
    around = np.clip(
        result.q[:, np.newaxis] + [[0.01, 0], [-0.01, 0], [0, 0.01], [0, -0.01]], *task.limits
    )
    there = TWO.forward_kinematics(around)[..., :2]
    assert np.all(
        np.linalg.norm(target[:, np.newaxis] - there, axis=2).min(axis=1) > result.error - 1e-9
    )


def test_a_start_beyond_the_limits_is_moved_to_them():
    task = Walled(TWO, 0.0, 1.0)
    result = task.solve([5.0, 5.0], [-3.0, 4.0], max_iterations=1, restarts=0)
    assert task.seen[0].tolist() == [[0.0, 1.0]]
    assert task.solve(task.forward(np.array([[0.0, 1.0]]))[0], [-3.0, 4.0]).q.tolist() == [0.0, 1.0]
    assert not result.converged


def test_a_locked_joint_stays_where_it_is():
    for jacobian in (THREE.jacobian, None):
        task = Walled(THREE, [-np.pi, 0.7, -np.pi], [np.pi, 0.7, np.pi])
        target = task.forward(task.inside(50, 0))
        result = solve(task.forward, jacobian, target, task.inside(50, 1), limits=task.limits)
        assert result.converged.all()
        assert np.all(result.q[:, 1] == 0.7)


@pytest.mark.parametrize(
    ('lower', 'upper', 'least', 'most'),
    [
        (-np.inf, np.inf, -np.pi, np.pi),
        (1.0, np.inf, 1.0, 1.0 + 2.0 * np.pi),
        (-np.inf, -5.0, -5.0 - 2.0 * np.pi, -5.0),
        (-0.5, 0.25, -0.5, 0.25),
    ],
)
def test_restarts_are_drawn_between_the_limits(lower, upper, least, most):
    seen = []

    def constant(q):
        seen.append(q.copy())
        return np.zeros_like(q)

    def flat(q):
        return np.zeros((*q.shape, 2))

    middle = np.full(2, 0.5 * (least + most))
    result = solve(constant, flat, [1.0, 1.0], middle, limits=(lower, upper), restarts=150)
    assert result.restarts == 150
    # Nothing can be moved, so each goes a tenth of the way to a point of its own.
    path = np.concatenate(seen)
    drawn = path[:-1] + np.diff(path, axis=0) / 0.1
    assert drawn.min() >= least - 1e-9
    assert drawn.max() <= most + 1e-9
    assert drawn.min() < least + 0.05 * (most - least)
    assert drawn.max() > most - 0.05 * (most - least)


# --- Size of the update, the caller's alpha, no Jacobian


@pytest.mark.parametrize('method', METHODS)
def test_a_small_update_ends_a_search(method):
    task, q = Task(TWO), configurations(TWO, 50)
    q0 = q + np.random.default_rng(18).uniform(-0.2, 0.2, q.shape)
    options = {'method': method, 'tolerance': 1e-12, 'restarts': 0}
    steps = []
    for step_tolerance in (1e-1, 1e-2, 1e-3):
        result = task.solve(task.forward(q), q0, step_tolerance=step_tolerance, **options)
        steps.append(result.iterations)
        assert np.all(result.iterations < 500)
    # The sooner, the larger it is.
    assert np.all(np.diff(steps, axis=0) >= 0)
    assert np.any(np.diff(steps, axis=0) > 0)
    near = task.solve(task.forward(q), q0, method=method, step_tolerance=1e-9, max_iterations=5000)
    assert np.count_nonzero(near.converged) >= 45


def test_the_callers_alpha_is_document_ds():
    q, goal, m = np.array([0.3, 0.8]), np.array([1.0, 1.0]), np.array([1.0, 4.0])
    downhill = TWO.jacobian(q).T @ (m * (goal - TWO.forward_kinematics(q)[:2]))
    result = Task(TWO).solve(goal, q, mask=m, method='transpose', alpha=0.07, max_iterations=1)
    np.testing.assert_allclose(result.q, q + 0.07 * downhill, rtol=1e-12)


def test_transpose_is_sensitive_to_alpha():
    task, q = Task(TWO), np.array([0.4, 1.1])
    target = task.forward(q[np.newaxis])[0]
    bound = 2.0 / np.linalg.norm(TWO.jacobian(q), ord=2) ** 2
    options = {'method': 'transpose', 'max_iterations': 400, 'restarts': 0}
    slow, right, wild = (
        task.solve(target, q + 0.01, alpha=share * bound, **options) for share in (0.05, 0.9, 1.1)
    )
    assert right.converged
    assert slow.iterations > 5 * right.iterations
    # Beyond the bound it leaves the target however near it starts.
    assert not wild.converged
    assert task.solve(target, q + 0.01, **options).converged


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('heading', [False, True])
def test_without_a_jacobian_it_goes_the_same_way(heading, method):
    task, q = Task(FIVE, heading), configurations(FIVE, 15)
    target, q0 = task.forward(q), q + np.random.default_rng(2).uniform(-0.2, 0.2, q.shape)
    given = task.solve(target, q0, method=method, max_iterations=15)
    task.derived.clear()
    difference = pose_difference if heading else None
    none = solve(task.forward, None, target, q0, method=method, max_iterations=15, difference=difference)
    assert not task.derived
    np.testing.assert_allclose(none.q, given.q, atol=1e-6)
    np.testing.assert_allclose(none.error, given.error, atol=1e-6)


def test_central_differences_go_the_short_way_across_half_a_turn():
    arm = PlanarArm([1.0])
    result = solve(
        arm.forward_kinematics,
        None,
        arm.forward_kinematics([3.0]),
        [math.pi],
        difference=pose_difference,
        restarts=0,
    )
    assert result.converged
    np.testing.assert_allclose(result.q, [3.0], atol=TOLERANCE)
    assert result.iterations < 10
