# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Numeric inverse kinematics: what is reached and what is not, restarts, joint limits, no Jacobian."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from diffdrive_jacobian.kinematics.inverse_kinematics import METHODS, IKResult, pose_difference, solve
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

TOLERANCE = 1e-6
DOWNHILL = ('transpose', 'levenberg_marquardt')
TWO, THREE, FIVE = (PlanarArm(lengths) for lengths in ([1.0, 0.7], [1.0, 0.7, 0.4], [0.5] * 5))
LONG_FIRST = PlanarArm([1.0, 0.3, 0.2])
"""An arm whose tip cannot come near its base."""
LONG_CHAIN = PlanarArm([0.5, 0.45, 0.4, 0.35, 0.3, 0.25, 0.2])
NARROW = {'heading': True, 'limits': (-2.0, 2.0)}
numeric_or_not = pytest.mark.parametrize('numeric', [False, True], ids=['jacobian', 'no jacobian'])
every_method = pytest.mark.parametrize('method', METHODS)


class Task:
    """The position or pose of an arm within limits, and where it was asked for."""

    def __init__(self, arm, *, heading=False, limits=None):
        self.arm, self.heading, self.limits = arm, heading, limits
        self.asked, self.derived = [], []

    def forward(self, q):
        if self.limits is not None:
            assert np.all((q >= self.limits[0]) & (q <= self.limits[1]))
        self.asked.append(q.copy())
        return self.arm.forward_kinematics(q)[:, : 3 if self.heading else 2]

    def jacobian(self, q):
        self.derived.append(q.copy())
        return self.arm.jacobian(q, heading=self.heading)

    def solve(self, target, q0, *, numeric=False, **options):
        if self.heading:
            options.setdefault('difference', pose_difference)
        jacobian = None if numeric else self.jacobian
        return solve(self.forward, jacobian, target, q0, limits=self.limits, **options)

    def anywhere(self, count, seed):
        lower, upper = (-np.pi, np.pi) if self.limits is None else np.clip(self.limits, -np.pi, np.pi)
        return np.random.default_rng(seed).uniform(lower, upper, (count, self.arm.joints))

    def bent(self, count, seed=0):
        """Return joints that are bent by 20 to 150 degrees: none next to a singularity."""
        rng = np.random.default_rng(seed)
        q = rng.choice([-1.0, 1.0], (count, 1)) * rng.uniform(0.35, 2.6, (count, self.arm.joints))
        q[:, 0] = rng.uniform(-np.pi, np.pi, count)
        return q


def unreachable(arm, *, hole=False):
    """Return 20 targets, the reachable points nearest to them, and how far these are."""
    rng = np.random.default_rng(3)
    reach, angle = arm.lengths.sum(), rng.uniform(-np.pi, np.pi, 20)
    nearest = 2.0 * arm.lengths.max() - reach if hole else reach
    distance = nearest * rng.uniform(*((0.3, 0.9) if hole else (1.02, 2.0)), 20)
    bearing = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return distance[:, np.newaxis] * bearing, nearest * bearing, np.abs(distance - nearest)


def assert_same(actual, expected):
    for name in ('converged', 'iterations', 'restarts', 'start'):
        assert np.array_equal(getattr(actual, name), getattr(expected, name)), name
    np.testing.assert_allclose(actual.q, expected.q, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(actual.error, expected.error, rtol=0.0, atol=1e-6)


# --- What is reached


@pytest.mark.parametrize(
    ('arm', 'heading', 'near', 'options', 'most'),
    [
        *((THREE, True, True, {'method': method}, 5000) for method in METHODS),
        *((FIVE, False, True, {'method': method}, 5000) for method in METHODS),
        *((THREE, True, False, {'damping': damping}, 100) for damping in (1e-300, 0.1, 1e6)),
        # It runs in circles, and is restarted.
        (TWO, False, False, {'method': 'newton'}, 1000),
    ],
)
def test_reachable_targets_are_reached(arm, heading, near, options, most):
    task = Task(arm, heading=heading)
    q = task.bent(30) if near else task.anywhere(30, 4)
    target = task.forward(q)
    q0 = task.bent(30) + 0.2 * task.anywhere(30, 2) / np.pi if near else task.anywhere(30, 5)
    q0[0] = q[0]
    result = task.solve(target, q0, max_iterations=most, **options)
    assert result.converged.all()
    assert result.iterations[0] == result.error[0] == 0
    assert np.all(result.iterations[1:] >= 1)
    assert np.all(result.error <= TOLERANCE)
    reached = task.forward(result.q)
    difference = pose_difference(target, reached) if heading else target - reached
    np.testing.assert_allclose(np.linalg.norm(difference, axis=1), result.error, rtol=1e-6, atol=1e-14)


# --- The steps of documents C and D


def test_the_first_step_is_document_cs_and_document_ds():
    q, goal, m = np.array([0.3, 0.8, -0.5]), np.array([1.3, 1.0, 1.0]), np.array([1.0, 4.0, 0.25])
    J, M = THREE.jacobian(q, heading=True), np.diag(m)
    e = pose_difference(goal, THREE.forward_kinematics(q))
    downhill = J.T @ M @ e
    best = downhill @ downhill / (downhill @ J.T @ M @ J @ downhill)
    for step, options in (
        (np.linalg.inv(J) @ e, {'method': 'newton'}),
        (np.linalg.inv(J.T @ M @ J + 1e-3 * np.eye(3)) @ downhill, {'damping': 1e-3}),
        (np.linalg.inv(J.T @ M @ J + 7.0 * np.eye(3)) @ downhill, {'damping': 7.0}),
        (0.9 * best * downhill, {'method': 'transpose'}),
        (0.07 * downhill, {'method': 'transpose', 'alpha': 0.07}),
    ):
        result = Task(THREE, heading=True).solve(goal, q, mask=m, max_iterations=1, **options)
        assert result.iterations == 1
        np.testing.assert_allclose(result.q, q + step, rtol=1e-10)


@pytest.mark.parametrize('method', DOWNHILL)
def test_the_error_falls_with_every_step_that_is_taken(method):
    taken_back = 0
    targets = np.random.default_rng(6).uniform(-3.0, 3.0, (6, 2))
    for target, q0 in zip(targets, Task(THREE).anywhere(6, 1), strict=True):
        task = Task(THREE)
        # Nearly no damping at first, so that there are steps to take back.
        options = {'damping': 1e-12, 'max_iterations': 25, 'restarts': 0}
        result = task.solve(target, q0, method=method, **options)
        # It is derived where it stands. Calls with several rows are for second derivatives.
        errors = [np.linalg.norm(target - task.forward(q)) for q in task.derived if len(q) == 1]
        assert np.all(np.diff(errors) < 1e-14)
        assert result.error <= errors[-1] + 1e-14
        taken_back += result.iterations - len(errors)
    assert taken_back > 2


# --- What makes no difference


@every_method
def test_without_a_jacobian_the_result_is_the_same(method):
    task, target = Task(THREE), np.random.default_rng(9).uniform(-2.0, 2.0, (8, 2))
    # Rounding, which differs, grows on the paths of newton and of transpose.
    steps = {'newton': 5, 'transpose': 10, 'levenberg_marquardt': 25}
    options = {'method': method, 'max_iterations': steps[method]}
    usual = task.solve(target, task.bent(8), **options)
    assert_same(task.solve(target, task.bent(8), numeric=True, **options), usual)


# --- Headings and weights


@numeric_or_not
def test_a_heading_takes_the_short_way_across_half_a_turn(numeric):
    task, q = Task(THREE, heading=True), np.array([1.0, 1.0, 1.1])
    q0 = q + np.array([0.02, 0.02, 0.06])
    target, start = task.forward(np.stack([q, q0]))
    assert start[2] < -3.0 < 3.0 < target[2]
    wrapped = task.solve(target, q0, numeric=numeric)
    np.testing.assert_allclose(wrapped.q, q, atol=1e-4)
    assert wrapped.iterations < 10
    # With differences just at half a turn, too.
    arm = Task(PlanarArm([1.0]), heading=True)
    result = arm.solve(arm.arm.forward_kinematics([3.0]), [math.pi], numeric=numeric, restarts=0)
    np.testing.assert_allclose(result.q, [3.0], atol=TOLERANCE)


def test_weights_say_what_matters_where_not_all_can_be_had():
    # Two joints for three entries.
    task, target, off = Task(TWO, heading=True), np.array([0.9, 0.9, 2.5]), []
    for weight in (1e-3, 1.0, 1e3):
        m = np.array([1.0, 1.0, weight])
        result = task.solve(target, [0.5, 0.5], mask=m)
        e = pose_difference(target, TWO.forward_kinematics(result.q))
        assert result.error == pytest.approx(math.sqrt(e @ np.diag(m) @ e))
        downhill = TWO.jacobian(result.q, heading=True).T @ (m * e)
        assert np.abs(downhill).max() < 1e-5 * result.error * max(1.0, math.sqrt(weight))
        off.append([np.hypot(e[0], e[1]), -abs(e[2])])
    assert np.all(np.diff(off, axis=0) > 0.0)


# --- Batches


def test_leading_axes_broadcast_a_single_target_gives_scalars_and_no_target_is_no_work():
    task = Task(THREE)
    target, q0 = task.forward(task.bent(3, 10)), task.bent(4)
    table = task.solve(target[:, None], q0)
    assert [field.shape for field in table] == [(3, 4, 3)] + [(3, 4)] * 5
    single = task.solve(target[1], q0[2], max_iterations=np.int32(500))
    assert_same(IKResult(*(field[1, 2] for field in table)), single)
    assert [np.shape(field) for field in single] == [(3,)] + [()] * 5
    assert (single.converged.dtype, single.iterations.dtype) == (np.bool_, np.int64)
    task.asked.clear()
    # It would take hours to go through so many iterations.
    none = task.solve(np.zeros((0, 4, 2)), np.zeros(3), max_iterations=10**9)
    assert [field.shape for field in none] == [(0, 4, 3)] + [(0, 4)] * 5
    assert task.asked == []


@every_method
def test_what_is_done_costs_nothing(method):
    task = Task(TWO)
    target, q0 = task.forward(task.bent(100)), task.bent(100, 11)
    target[::10] *= 9.0
    task.asked.clear()
    result = task.solve(target, q0, method=method, max_iterations=100)
    # One call for the starts, then one for the step of each that is still open.
    sizes = list(map(len, task.asked))
    assert sizes[0] == 100
    assert sizes == sorted(sizes, reverse=True)
    assert sum(sizes) == 100 + result.iterations.sum()
    assert min(sizes) > 0
    # A step that is taken back needs no Jacobian.
    if method != 'levenberg_marquardt':
        assert sum(map(len, task.derived)) < sum(sizes)


# --- Functions that fail


@every_method
@pytest.mark.parametrize('which', ['forward', 'jacobian', 'difference'])
def test_what_is_not_finite_ends_its_own_target_only(which, method):
    task = Task(TWO)

    def spoiled(name, q, value):
        """Left of the base this function fails, if only in its last row or column."""
        assert np.isfinite(q).all()
        if name == which:
            value[TWO.forward_kinematics(q)[:, 0] < 0.0, ..., -1] = -np.inf
        return value

    functions = (
        lambda q: spoiled('forward', q, task.forward(q)),
        lambda q: spoiled('jacobian', q, task.jacobian(q)),
    )
    target, q0 = task.forward(task.bent(60)), task.anywhere(60, 1)
    result = solve(
        *(*functions, target, q0),
        difference=lambda target, pose: spoiled('difference', task.asked[-1], target - pose),
        method=method,
        max_iterations=60,
    )
    lost = task.forward(q0)[:, 0] < 0.0
    assert np.array_equal(result.q[lost], q0[lost])
    assert not result.iterations[lost].any()
    # Where only the derivative fails, the error is known.
    assert np.array_equal(np.isfinite(result.error), ~lost | (which == 'jacobian'))
    # Some come to where it fails, and those that do not see nothing of it.
    assert np.any(~lost & ~result.converged & (result.iterations < 60))
    whole = task.solve(target, q0, method=method, max_iterations=60)
    for field, other in zip(result, whole, strict=True):
        assert np.array_equal(field[result.converged], other[result.converged])


@every_method
@pytest.mark.parametrize('scale', [1e-320, 1e150, 1e307])
def test_extreme_numbers_neither_raise_nor_warn(scale, method):
    arm, target = Task(TWO), np.array([[0.4, 0.6], [1.9, 0.3]])
    result = solve(
        lambda q: scale * arm.forward(q),
        lambda q: scale * arm.jacobian(q),
        *(scale * target, arm.bent(2)),
        **{'method': method, 'max_iterations': 15},
    )
    assert np.isfinite(result.q).all()


# --- Out of reach


@pytest.mark.parametrize(
    ('arm', 'hole', 'method', 'most'),
    [
        (TWO, False, 'levenberg_marquardt', 500),
        (LONG_FIRST, True, 'levenberg_marquardt', 500),
        (LONG_CHAIN, False, 'levenberg_marquardt', 50),
        (TWO, False, 'transpose', 2000),
    ],
)
def test_the_nearest_reachable_point_is_found(arm, hole, method, most):
    task = Task(arm)
    target, nearest, distance = unreachable(arm, hole=hole)
    restarts = {'restarts': 0} if arm is LONG_CHAIN else {}
    result = task.solve(target, task.anywhere(20, 1), method=method, max_iterations=2000, **restarts)
    assert not result.converged.any()
    np.testing.assert_allclose(result.error, distance, atol=1e-9)
    np.testing.assert_allclose(task.forward(result.q), nearest, atol=1e-4)
    # It is known when it is found.
    assert result.iterations.max() < most


@every_method
def test_a_stretched_arm_takes_the_natural_first_try_from_a_point_nearby(method):
    task = Task(PlanarArm([1.0, 1.0]))
    alone = task.solve([1.0, 0.0], [0.0, 0.0], method=method, restarts=0)
    assert alone.iterations == alone.restarts == alone.start == 0
    result = task.solve([1.0, 0.0], [0.0, 0.0], method=method)
    assert result.converged
    assert result.start == result.restarts == 1
    assert 0.0 < np.abs(task.derived[2]).max() < 0.1 * np.pi


# --- Restarts


def test_restarts_find_what_one_search_does_not():
    task = Task(THREE, **NARROW)
    target, q0 = task.forward(task.anywhere(60, 0)), task.anywhere(60, 1)
    alone, several = task.solve(target, q0, restarts=0), task.solve(target, q0, restarts=100)
    assert np.count_nonzero(alone.converged) < 52
    assert np.count_nonzero(several.converged) >= 59
    assert np.array_equal(several.start[several.converged], several.restarts[several.converged])


def test_restarts_are_the_same_for_the_same_seed():
    task, target = Task(THREE, **NARROW), THREE.forward_kinematics([1.9, 1.9, -1.9])
    q0 = task.anywhere(20, 2)
    one, same, other = (task.solve(target, q0, seed=seed) for seed in (3, np.random.default_rng(3), 4))
    assert one.restarts.any()
    assert_same(one, same)
    assert not np.array_equal(one.q, other.q)


def test_restarts_and_iterations_are_limited():
    task, (target, _, _) = Task(LONG_FIRST), unreachable(LONG_FIRST)
    # Three searches with the same end suffice.
    for restarts, expected in ((0, 0), (1, 1), (5, 2)):
        result = task.solve(target, task.anywhere(20, 1), restarts=restarts)
        assert np.all(result.restarts == expected)
    few = task.solve(target, task.anywhere(20, 1), max_iterations=30)
    assert few.iterations.max() <= 30


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

    middle, flat = np.full(2, 0.5 * (least + most)), np.zeros((1, 2, 2))
    solve(constant, lambda q: flat, [1.0, 1.0], middle, limits=(lower, upper), restarts=150)
    # Nothing can be moved, so each goes a tenth of the distance to a point of its own.
    path = np.concatenate(seen)
    assert len(path) == 151
    share = (path[:-1] + np.diff(path, axis=0) / 0.1 - least) / (most - least)
    assert -1e-9 < share.min() < 0.05
    assert 0.95 < share.max() < 1.0 + 1e-9


# --- Joint limits. The task fails where anything beyond them is asked for


@every_method
@numeric_or_not
@pytest.mark.parametrize(
    'limits',
    [([-3.0, -0.2, -np.inf], [1.0, 2.4, 1.5]), ([-np.pi, 0.7, -np.pi], [np.pi, 0.7, np.pi])],
    ids=['limited', 'locked'],
)
def test_solutions_are_within_the_limits(limits, numeric, method):
    task = Task(THREE, limits=limits)
    target, q0 = task.forward(task.anywhere(30, 0)), task.anywhere(30, 1)
    result = task.solve(target, q0, numeric=numeric, method=method)
    task.forward(result.q)
    assert np.count_nonzero(result.converged) >= (27 if method == 'transpose' else 30)


@pytest.mark.parametrize('method', DOWNHILL)
def test_the_nearest_point_within_the_limits_is_found(method):
    task = Task(TWO, limits=([-1.0, 0.3], [0.5, 1.5]))
    target = np.random.default_rng(17).uniform(-2.0, 2.0, (20, 2))
    result = task.solve(target, task.anywhere(20, 1), method=method, max_iterations=150)
    grid = np.stack(np.meshgrid(np.linspace(-1.0, 0.5, 301), np.linspace(0.3, 1.5, 301)), axis=-1)
    points = TWO.forward_kinematics(grid.reshape(-1, 2))[:, :2] @ [1.0, 1j]
    least = np.array([np.abs(one - points).min() for one in target @ [1.0, 1j]])
    assert np.count_nonzero(~result.converged) > 10
    assert np.all(result.error >= least - 0.01)
    # Limits leave local minima, and several searches may end in the same one.
    assert np.count_nonzero(result.error <= least + TOLERANCE) >= 18


def test_a_start_beyond_the_limits_is_moved_to_them():
    task = Task(TWO, limits=(0.0, 1.0))
    task.solve([5.0, 5.0], [-3.0, 4.0], max_iterations=1, restarts=0)
    assert task.asked[0].tolist() == [[0.0, 1.0]]


@every_method
def test_a_small_update_ends_a_search(method):
    task = Task(TWO)
    q0 = task.bent(30) + 0.2 * task.anywhere(30, 2) / np.pi
    target = task.forward(task.bent(30))
    options = {'method': method, 'tolerance': 1e-12, 'restarts': 0}
    steps = [task.solve(target, q0, step_tolerance=10.0**-n, **options).iterations for n in (1, 2, 3)]
    assert np.all(np.array(steps) < 500)
    # The sooner, the larger it is.
    assert np.all(np.diff(steps, axis=0) >= 0)
    assert np.any(np.diff(steps, axis=0) > 0)


# --- Bad input

ARGUMENTS = {
    'forward': lambda q: TWO.forward_kinematics(q)[..., :2],
    'jacobian': TWO.jacobian,
    'target': [0.5, 0.5],
    'q0': [0.1, 0.2],
}
NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ('name', 'values', 'allowed'),
    [
        ('target', [1.0, np.zeros((3, 0))], r'have shape \(\.\.\., m\)'),
        ('target', [[NAN, 0.0]], 'be finite'),
        ('q0', [[[0.0, 1.0], [0.0]]], 'be an array of real numbers'),
        ('method', ['gauss', None], "be one of 'newton', 'transpose', 'levenberg_marquardt'"),
        ('mask', [[1.0], 1.0, np.ones((1, 2))], r'have shape \(2,\)'),
        ('mask', [[0, 0]], 'have an entry that is not zero'),
        ('mask', [[1.0, -1.0], [1.0, NAN]], 'be zero or positive and finite'),
        ('tolerance', [0.0, NAN], 'be positive and finite'),
        ('damping', [0.0, INF], 'be positive and finite'),
        ('max_iterations', [0, 10.0, True, None], 'be an integer of at least 1'),
        ('restarts', [-1, 2.0], 'be an integer of at least 0'),
        ('seed', [-1, 'today'], 'be an integer of at least 0'),
        ('step_tolerance', [-1e-9], 'be zero or positive and finite'),
        ('limits', [1.0, (1.0, 2.0, 3.0), ('low', 2.0)], r'be a pair \(lower, upper\)'),
        ('limits', [([0.0] * 3, 2.0)], r'have shape \(\) or \(2,\)'),
        ('limits', [(1.0, [2.0, 0.0]), (NAN, 1.0), (INF, INF)], 'be numbers with lower <= upper'),
        ('forward', [TWO.forward_kinematics, lambda q: q[0]], r'return shape \(1, 2\)'),
        ('jacobian', [partial(TWO.jacobian, heading=True)], r'return shape \(1, 2, 2'),
        ('difference', [lambda target, pose: target[0] - pose[0]], r'return shape \(1, 2\)'),
        ('what forward returns', [lambda q: None], 'be an array of real numbers, got None'),
        ('alpha', [0.1], "is for the method transpose alone, got method 'levenberg_marquardt'"),
    ],
)
def test_bad_arguments_are_named_with_what_is_allowed(name, values, allowed):
    argument = 'forward' if 'forward' in name else name
    for value in values:
        with pytest.raises(ValueError, match=rf'^{name} (must )?{allowed}'):
            solve(**ARGUMENTS | {argument: value})


def test_targets_and_starts_that_do_not_fit_together_are_named():
    with pytest.raises(ValueError, match=r'^target and q0 must have leading axes'):
        solve(**ARGUMENTS | {'target': np.zeros((4, 2)), 'q0': np.zeros((3, 2))})
