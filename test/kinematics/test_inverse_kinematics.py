"""Numeric inverse kinematics: what is reached and what is not, restarts, joint limits, no Jacobian."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from diffdrive_jacobian.kinematics.inverse_kinematics import METHODS, IKResult, pose_difference, solve
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

TOLERANCE = 1e-6
ROUNDING = 1.0 + 1e-14
"""Lengths of the same error that are computed in two ways differ by a few units in the last place."""
DOWNHILL = ('transpose', 'levenberg_marquardt')
TWO, THREE, FIVE = (PlanarArm(lengths) for lengths in ([1.0, 0.7], [1.0, 0.7, 0.4], [0.5] * 5))
LONG_FIRST = (PlanarArm([1.0, 0.7]), PlanarArm([1.0, 0.3, 0.2]))


class Task:
    """An arm's position or pose, and what was asked of it."""

    def __init__(self, arm, heading=False):
        self.arm, self.heading, self.asked, self.derived = arm, heading, [], []

    def forward(self, q):
        self.asked.append(len(q))
        return self.arm.forward_kinematics(q)[:, : 3 if self.heading else 2]

    def jacobian(self, q):
        self.derived.append(q.copy())
        return self.arm.jacobian(q, heading=self.heading)

    def solve(self, target, q0, **options):
        if self.heading:
            options.setdefault('difference', pose_difference)
        return solve(self.forward, self.jacobian, target, q0, **options)


def configurations(arm, count, seed=0):
    """Random ones, joints bent by 20 to 150 degrees: none next to a singularity."""
    rng = np.random.default_rng(seed)
    q = rng.choice([-1.0, 1.0], (count, 1)) * rng.uniform(0.35, 2.6, (count, arm.joints))
    q[:, 0] = rng.uniform(-np.pi, np.pi, count)
    return q


def anywhere(arm, count, seed=1):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, arm.joints))


def at(distance, angle):
    return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)


def unreachable(arm, where, count=60):
    """Give targets, the reachable points nearest to them, and how far these are."""
    rng = np.random.default_rng(3)
    reach, angle = arm.lengths.sum(), rng.uniform(-np.pi, np.pi, count)
    if where == 'too far':
        distance, nearest = reach * rng.uniform(1.02, 2.0, count), reach
    else:
        nearest = 2.0 * arm.lengths.max() - reach
        distance = nearest * rng.uniform(0.3, 0.9, count)
    return at(distance, angle), at(nearest, angle), np.abs(distance - nearest)


def assert_same(actual, expected):
    assert np.array_equal(actual.converged, expected.converged)
    for name in ('iterations', 'restarts', 'start'):
        assert np.array_equal(getattr(actual, name), getattr(expected, name)), name
    np.testing.assert_allclose(actual.q, expected.q, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(actual.error, expected.error, rtol=0.0, atol=1e-9)


# --- What is reached


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize(('arm', 'heading'), [(TWO, False), (THREE, True), (FIVE, False)])
def test_near_starts_converge_by_every_method(arm, heading, method):
    task, q = Task(arm, heading), configurations(arm, 40)
    q0 = q + np.random.default_rng(2).uniform(-0.2, 0.2, q.shape)
    target = task.forward(q)
    result = task.solve(target, q0, method=method, max_iterations=5000)
    assert result.converged.all()
    assert np.all(result.iterations >= 1)
    assert np.all(result.error <= TOLERANCE)
    reached = task.forward(result.q)
    difference = pose_difference(target, reached) if heading else target - reached
    np.testing.assert_allclose(np.linalg.norm(difference, axis=1), result.error, rtol=1e-6, atol=1e-14)


@pytest.mark.parametrize('damping', [1e-300, 0.1, 1e6])
@pytest.mark.parametrize(('arm', 'heading'), [(THREE, True), (FIVE, False)])
def test_levenberg_marquardt_converges_from_anywhere(arm, heading, damping):
    task = Task(arm, heading)
    result = task.solve(task.forward(anywhere(arm, 100, 4)), anywhere(arm, 100, 5), damping=damping)
    assert result.converged.all()
    assert np.median(result.iterations) < 30
    assert result.iterations.max() < 100


@pytest.mark.parametrize(
    ('method', 'tolerance'), [('newton', 1e-9), ('levenberg_marquardt', 1e-9), ('transpose', 1e-3)]
)
def test_a_target_at_the_rim_is_reached(method, tolerance):
    # There the Jacobian is singular in the direction that is left to go.
    result = Task(THREE).solve([2.1, 0.0], [0.3, -0.5, 0.4], method=method, tolerance=tolerance)
    assert result.converged
    np.testing.assert_allclose(result.q, 0.0, atol=3.0 * math.sqrt(tolerance))


@pytest.mark.parametrize('method', METHODS)
def test_at_the_target_there_is_nothing_to_do(method):
    task, q0 = Task(THREE), configurations(THREE, 5)
    result = task.solve(task.forward(q0), q0, method=method)
    assert result.converged.all()
    assert not result.iterations.any()
    assert np.array_equal(result.q, q0)
    assert not result.error.any()
    assert task.derived == []


# --- The steps of documents C and D


def test_newton_is_document_c_with_its_lost_minus():
    task, q = Task(TWO), np.array([0.4, 1.1])
    goal, r = task.forward(np.array([[0.5, 0.9], q]))
    inverse = np.linalg.inv(TWO.jacobian(q))
    one = task.solve(goal, q, method='newton', max_iterations=1)
    np.testing.assert_allclose(one.q, q + inverse @ (goal - r), rtol=1e-12)
    assert one.iterations == 1
    # Step by step the error is squared.
    errors = [task.solve(goal, q, method='newton', max_iterations=k).error for k in (1, 2, 3)]
    assert errors[1] < 2.0 * errors[0] ** 2
    assert errors[2] < 2.0 * errors[1] ** 2 + 1e-15
    # As it is printed, "r_goal r_i" with a sign lost, a plus would not even come nearer.
    printed = q + inverse @ (goal + r)
    assert np.linalg.norm(goal - task.forward(printed[None])[0]) > np.linalg.norm(goal - r) > one.error


@pytest.mark.parametrize('damping', [1e-3, 7.0])
def test_levenberg_marquardt_is_document_d_with_its_lambda_not_squared(damping):
    q, goal, m = np.array([0.3, 0.8, -0.5]), np.array([1.3, 1.0, 1.0]), np.array([1.0, 4.0, 0.25])
    J, M = THREE.jacobian(q, heading=True), np.diag(m)
    e = pose_difference(goal, THREE.forward_kinematics(q))
    step = np.linalg.inv(J.T @ M @ J + damping * np.eye(3)) @ J.T @ M @ e
    result = Task(THREE, heading=True).solve(goal, q, mask=m, damping=damping, max_iterations=1)
    np.testing.assert_allclose(result.q, q + step, rtol=1e-10)


def test_the_transpose_step_is_document_ds_with_alpha_by_line_search():
    q, goal, m = np.array([0.3, 0.8]), np.array([1.0, 1.0]), np.array([1.0, 4.0])
    J, M = TWO.jacobian(q), np.diag(m)
    downhill = J.T @ M @ (goal - TWO.forward_kinematics(q)[:2])
    best = downhill @ downhill / (downhill @ J.T @ M @ J @ downhill)
    result = Task(TWO).solve(goal, q, mask=m, method='transpose', max_iterations=1)
    np.testing.assert_allclose(result.q, q + 0.9 * best * downhill, rtol=1e-12)


@pytest.mark.parametrize('method', DOWNHILL)
def test_the_error_falls_with_every_step_that_is_taken(method):
    taken_back = 0
    targets = np.random.default_rng(6).uniform(-3.0, 3.0, (20, 2))
    for target, q0 in zip(targets, anywhere(THREE, 20), strict=True):
        task = Task(THREE)
        # Nearly no damping at first, so that there are steps to take back.
        options = {'damping': 1e-12, 'max_iterations': 25, 'restarts': 0}
        result = task.solve(target, q0, method=method, **options)
        # It is derived where it stands; a step that is taken back counts, and is not derived. Calls with
        # several rows are for second derivatives.
        errors = [np.linalg.norm(target - task.forward(q)) for q in task.derived if len(q) == 1]
        assert np.all(np.array(errors[1:]) < ROUNDING * np.array(errors[:-1]))
        assert result.error <= ROUNDING * errors[-1]
        taken_back += result.iterations - len(errors)
    assert taken_back > 5


def test_newton_may_get_worse_and_gives_the_best_it_saw():
    task, target, q0 = Task(TWO), np.full((20, 2), 2.0), anywhere(TWO, 20)
    errors = [
        task.solve(target, q0, method='newton', max_iterations=steps).error for steps in range(1, 12)
    ]
    assert np.all(np.diff(errors, axis=0) <= 0.0)
    last = task.solve(target, q0, method='newton', max_iterations=11)
    np.testing.assert_allclose(np.linalg.norm(target - task.forward(last.q), axis=1), last.error)
    assert not last.converged.any()


# --- Headings, masks, units


def test_pose_difference_wraps_the_heading_only():
    target = [[5.0, -4.0, 3.0], [0.0, 0.0, -3.0], [1.0, 2.0, np.pi], [0.0, 0.0, 0.5]]
    pose = [[1.0, 4.0, -3.0], [0.0, 0.0, 3.0], [1.0, 2.0, 0.0], [0.0, 0.0, 0.25]]
    expected = [
        [4.0, -8.0, 6.0 - 2.0 * np.pi],
        [0.0, 0.0, 2.0 * np.pi - 6.0],
        [0.0, 0.0, np.pi],
        [0.0, 0.0, 0.25],
    ]
    np.testing.assert_allclose(pose_difference(target, pose), expected, atol=1e-15)
    np.testing.assert_allclose(pose_difference(target[0], pose[0]), expected[0], atol=1e-15)


@pytest.mark.parametrize('method', METHODS)
def test_a_heading_takes_the_short_way_across_half_a_turn(method):
    task, q = Task(THREE, heading=True), np.array([1.0, 1.0, 1.1])
    q0 = q + np.array([0.02, 0.02, 0.06])
    target, start = task.forward(np.stack([q, q0]))
    assert target[2] > 3.0
    assert start[2] < -3.0
    wrapped = task.solve(target, q0, method=method, max_iterations=3000)
    assert wrapped.converged
    np.testing.assert_allclose(wrapped.q, q, atol=1e-4)
    plain = task.solve(target, q0, method=method, max_iterations=3000, difference=np.subtract)
    assert np.abs(plain.q - q).max() > 0.5


@pytest.mark.parametrize('method', METHODS)
def test_a_masked_entry_is_as_if_it_were_not_there(method):
    pose, position = Task(THREE, heading=True), Task(THREE)
    target, q0 = pose.forward(configurations(THREE, 20)), configurations(THREE, 20, 7)
    target[:, 2] = 3.0
    masked = pose.solve(target, q0, method=method, mask=[1, 1, 0], max_iterations=50)
    assert_same(masked, position.solve(target[:, :2], q0, method=method, max_iterations=50))


@pytest.mark.slow
def test_weights_say_what_matters_where_not_all_can_be_had():
    # Two joints for three entries.
    task, q0, target = Task(TWO, heading=True), np.array([0.5, 0.5]), np.array([0.9, 0.9, 2.5])
    off = []
    for weight in (1e-3, 1.0, 1e3):
        m = np.array([1.0, 1.0, weight])
        for method in DOWNHILL:
            result = task.solve(target, q0, mask=m, method=method, max_iterations=20_000)
            e = pose_difference(target, TWO.forward_kinematics(result.q))
            assert not result.converged
            assert result.error == pytest.approx(math.sqrt(e @ np.diag(m) @ e))
            downhill = TWO.jacobian(result.q, heading=True).T @ (m * e)
            assert np.abs(downhill).max() < 1e-5 * result.error * max(1.0, math.sqrt(weight))
        off.append([np.hypot(e[0], e[1]), abs(e[2])])
    by_position, by_heading = np.transpose(off)
    assert by_position[0] < 2e-3 < 0.1 < by_position[1] < by_position[2]
    assert by_heading[0] > by_heading[1] > 0.1 > 2e-3 > by_heading[2]


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('unit', [1e-9, 1e3])
def test_the_unit_of_length_does_not_matter(unit, method):
    q, q0 = configurations(THREE, 15), configurations(THREE, 15, 8)
    target = Task(THREE).forward(q)
    metres = Task(THREE).solve(target, q0, method=method, max_iterations=100)
    other = Task(PlanarArm(unit * THREE.lengths)).solve(
        unit * target,
        q0,
        method=method,
        max_iterations=100,
        tolerance=unit * TOLERANCE,
        damping=0.1 * unit**2,
    )
    assert_same(other._replace(error=other.error / unit), metres)


@pytest.mark.parametrize(('method', 'damping'), [('newton', 1.0), ('levenberg_marquardt', 1e-19)])
def test_joints_may_have_other_units(method, damping):
    # A slide in nm, and an arm on it that cannot help in this direction.
    def forward(q):
        return np.stack([1e-9 * q[:, 0] + 0.3 * np.cos(q[:, 1]), 0.3 * np.sin(q[:, 1])], axis=-1)

    def jacobian(q):
        slide = np.broadcast_to([1e-9, 0.0], (len(q), 2))
        return np.stack([slide, 0.3 * np.stack([-np.sin(q[:, 1]), np.cos(q[:, 1])], axis=-1)], axis=-1)

    result = solve(forward, jacobian, [0.8, 0.0], [0.0, 0.0], method=method, damping=damping)
    assert result.converged
    np.testing.assert_allclose(result.q, [0.5e9, 0.0], rtol=1e-5)


# --- What is not reached


@pytest.mark.parametrize('method', DOWNHILL)
@pytest.mark.parametrize(('where', 'arm'), [('too far', LONG_FIRST[0]), ('in the hole', LONG_FIRST[1])])
def test_the_nearest_reachable_point_is_found(arm, where, method):
    task = Task(arm)
    target, nearest, distance = unreachable(arm, where, 20)
    result = task.solve(target, anywhere(arm, len(target)), method=method, max_iterations=2000)
    assert not result.converged.any()
    np.testing.assert_allclose(result.error, distance, atol=1e-9)
    np.testing.assert_allclose(task.forward(result.q), nearest, atol=1e-4)
    # It is known when it is found.
    assert result.iterations.max() < 2000


# --- Batches


@pytest.mark.parametrize('method', METHODS)
def test_a_batch_is_one_after_the_other(method):
    task, target = Task(THREE), np.random.default_rng(9).uniform(-2.0, 2.0, (20, 2))
    q0 = configurations(THREE, 20)
    # Rounding, which differs, grows on the ways of newton and of transpose.
    steps = {'newton': 5, 'transpose': 15, 'levenberg_marquardt': 100}
    options = {'method': method, 'max_iterations': steps[method]}
    together = task.solve(target, q0, **options)
    apart = [task.solve(t, q, **options) for t, q in zip(target, q0, strict=True)]
    assert_same(together, IKResult(*map(np.array, zip(*apart, strict=True))))


def test_leading_axes_broadcast():
    task, q0 = Task(THREE), configurations(THREE, 5)
    target = task.forward(configurations(THREE, 4, 10))
    table = task.solve(target[:, None], q0)
    assert table.q.shape == (4, 5, 3)
    assert table.converged.shape == table.iterations.shape == table.error.shape == (4, 5)
    for row, t in enumerate(target):
        assert_same(IKResult(*(field[row] for field in table)), task.solve(t, q0))
    assert_same(task.solve(target[0], q0), task.solve(np.tile(target[:1], (5, 1)), q0))
    assert_same(task.solve(target, q0[0]), task.solve(target, np.tile(q0[:1], (4, 1))))


def test_a_single_target_gives_scalars_and_arguments_stay_as_they_are():
    target, q0 = np.array([1.0, 1.0]), np.array([0.1, 0.2, 0.3])
    result = Task(THREE).solve(target, q0)
    assert result.q.shape == (3,)
    assert [np.ndim(field) for field in result[1:]] == [0] * 5
    assert result.converged.dtype == np.bool_
    assert result.iterations.dtype == np.int64
    assert target.tolist() == [1.0, 1.0]
    assert q0.tolist() == [0.1, 0.2, 0.3]
    at_once = Task(THREE).solve(target, q0, max_iterations=np.int32(1), tolerance=10)
    assert at_once.converged
    assert not np.shares_memory(at_once.q, q0)


def test_no_target_is_no_work():
    task = Task(THREE)
    result = task.solve(np.zeros((0, 4, 2)), np.zeros(3))
    assert [field.shape for field in result] == [(0, 4, 3)] + [(0, 4)] * 5
    assert task.asked == task.derived == []


@pytest.mark.parametrize('method', METHODS)
def test_what_is_done_costs_nothing(method):
    task = Task(TWO)
    target = task.forward(configurations(TWO, 200))
    target[::10] *= 9.0
    task.asked.clear()
    result = task.solve(target, configurations(TWO, 200, 11), method=method)
    assert len(set(result.iterations.tolist())) > 5
    # One call for the starts, then one for the step of each that is still open.
    assert task.asked[0] == 200
    assert task.asked == sorted(task.asked, reverse=True)
    assert sum(task.asked) == 200 + result.iterations.sum()
    # A step that is taken back needs no Jacobian, nor does the last one. Late steps of LM need those at
    # both sides of each joint, too.
    late = np.maximum(result.iterations - 10, 0).sum() if method == 'levenberg_marquardt' else 0
    assert sum(map(len, task.derived)) < sum(task.asked) + 2 * TWO.joints * late


# --- Functions that fail


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('bad', [np.nan, -np.inf])
@pytest.mark.parametrize('which', ['forward', 'jacobian', 'difference'])
def test_what_is_not_finite_ends_its_own_target_only(which, bad, method):
    task = Task(TWO)

    def spoiled(name, pose, value):
        """Left of the base this function fails, if only in its last row or column."""
        assert np.isfinite(pose).all()
        if name == which:
            value[pose[:, 0] < 0.0, ..., -1] = bad
        elif name == 'jacobian':
            assert np.all(pose[:, 0] >= 0.0)  # nobody needs it elsewhere
        return value

    def forward(q):
        return spoiled('forward', task.forward(q), task.forward(q))

    def jacobian(q):
        return spoiled('jacobian', task.forward(q), task.jacobian(q))

    def difference(target, pose):
        return spoiled('difference', pose, target - pose)

    target, q0 = task.forward(configurations(TWO, 150)), anywhere(TWO, 150)
    options = {'method': method, 'max_iterations': 60}
    result = solve(forward, jacobian, target, q0, difference=difference, **options)
    start = task.forward(q0)
    lost = start[:, 0] < 0.0
    assert np.array_equal(result.q[lost], q0[lost])
    assert not result.iterations[lost].any()
    # Where only the derivative fails, the error is known.
    assert np.array_equal(np.isfinite(result.error), ~lost | (which == 'jacobian'))
    off = np.linalg.norm(target - task.forward(result.q), axis=1)
    np.testing.assert_allclose(result.error[~lost], off[~lost], atol=1e-14)
    assert np.all(off <= ROUNDING * np.linalg.norm(target - start, axis=1))
    # Some come to where it fails, and those that do not see nothing of it.
    assert np.any(~lost & ~result.converged & (result.iterations < 60))
    assert np.count_nonzero(result.converged) > 10
    whole = task.solve(target, q0, **options)
    for field, other in zip(result, whole, strict=True):
        assert np.array_equal(field[result.converged], other[result.converged])


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('scale', [1e-320, 1e-200, 1e150, 1e307])
def test_numbers_without_measure_neither_raise_nor_warn(scale, method):
    arm, q0 = Task(TWO), configurations(TWO, 3)
    target = np.array([[0.4, 0.6], [-0.9, 0.3], [1.9, 0.3]])
    for lift, steep in ((scale, 1.0), (1.0, scale), (scale, scale)):
        forward = partial(lambda lift, q: lift * arm.forward(q), lift)
        jacobian = partial(lambda steep, q: steep * arm.jacobian(q), steep)
        options = {'max_iterations': 40, 'tolerance': min(1e-6, 1e-6 * lift) or 5e-324}
        assert np.isfinite(solve(forward, jacobian, lift * target, q0, method=method, **options).q).all()


def test_functions_may_warn_write_and_use_their_memory_again():
    task, q, q0 = Task(THREE), configurations(THREE, 30), configurations(THREE, 30, 12)
    memory = {name: np.empty(3000) for name in ('forward', 'jacobian', 'difference')}

    def stored(name, value):
        kept = memory[name][: value.size].reshape(value.shape)
        kept[...] = value
        return kept

    def forward(q):
        pose = stored('forward', task.forward(q))
        np.log(0.0 * q, out=q)
        return pose

    def jacobian(q):
        J = stored('jacobian', task.jacobian(q))
        q[:] = np.nan
        return J

    def difference(target, pose):
        return stored('difference', target - pose)

    target = task.forward(q)
    with np.errstate(all='raise'):
        result = solve(forward, jacobian, target, q0, difference=difference)
    assert_same(result, task.solve(target, q0))
    assert result.converged.all()


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
        ('target', ['home'], 'be an array of real numbers'),
        ('q0', [1.0], r'have shape \(\.\.\., n\)'),
        ('q0', [[0.0, -INF]], 'be finite'),
        ('q0', [[[0.0, 1.0], [0.0]]], 'be an array of real numbers'),
        ('method', ['gauss', None], 'be one of newton, transpose, levenberg_marquardt'),
        ('mask', [[1.0], 1.0, np.ones((1, 2))], r'have shape \(2,\)'),
        ('mask', [[0, 0]], 'have an entry that is not zero'),
        ('mask', [[1.0, -1.0], [1.0, NAN], [1.0, INF]], 'be zero or positive and finite'),
        ('tolerance', [0.0, -1e-6, NAN], 'be positive and finite'),
        ('tolerance', [[1e-6, 1e-6]], 'be a single number'),
        ('damping', [0.0, INF], 'be positive and finite'),
        ('damping', ['much'], 'be a number'),
        ('max_iterations', [0, -3, 10.0, True, None], 'be an integer of at least 1'),
        ('restarts', [-1, 2.0], 'be an integer of at least 0'),
        ('seed', [-1, 'today'], 'be an integer of at least 0'),
        ('step_tolerance', [-1e-9], 'be zero or positive and finite'),
        ('limits', [1.0, (1.0, 2.0, 3.0), ('low', 2.0)], r'be a pair \(lower, upper\)'),
        ('limits', [([0.0] * 3, 2.0)], r'have shape \(\) or \(2,\)'),
        ('limits', [(1.0, [2.0, 0.0]), (NAN, 1.0), (INF, INF)], 'be numbers with lower <= upper'),
        ('forward', [TWO.forward_kinematics, lambda q: q[0]], r'return shape \(1, 2\)'),
        (
            'jacobian',
            [partial(TWO.jacobian, heading=True), lambda q: np.eye(2)],
            r'return shape \(1, 2, 2',
        ),
        ('difference', [lambda target, pose: target[0] - pose[0]], r'return shape \(1, 2\)'),
    ],
)
def test_bad_arguments_are_named_with_what_is_allowed(name, values, allowed):
    for value in values:
        with pytest.raises(ValueError, match=rf'^{name} must {allowed}'):
            solve(**ARGUMENTS | {name: value})


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'target': np.zeros((4, 2)), 'q0': np.zeros((3, 2))}, 'target and q0 must have leading axes'),
        ({'alpha': 0.1}, "alpha is for the method transpose alone, got method 'levenberg_marquardt'"),
        ({'alpha': 0.0, 'method': 'transpose'}, 'alpha must be positive and finite, got 0.0'),
        (
            {'forward': lambda q: TWO.forward_kinematics(q[:1])[:, :2], 'jacobian': None},
            'forward must ret',
        ),
        ({'forward': lambda q: None}, 'what forward returns must be an array of real numbers, got None'),
        ({'forward': lambda q: q * 1j}, 'what forward returns must be an array of real numbers'),
    ],
)
def test_bad_combinations_and_results_are_reported(changes, message):
    with pytest.raises(ValueError, match=f'^{message}'):
        solve(**ARGUMENTS | changes)
