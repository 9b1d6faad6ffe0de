"""Null space, damping, weights, priorities and limits, above all where Jacobians are nearly singular."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from diffdrive_jacobian.kinematics import inverse_velocity as iv

COUNT = 500
SHAPES = [(1, 3), (2, 2), (2, 7), (3, 4), (4, 6)]
ROUNDING = 1e-12
shapes = pytest.mark.parametrize(('m', 'n'), SHAPES)


def norm(vectors):
    return np.linalg.norm(vectors, axis=-1)


def size(matrices):
    return np.linalg.norm(matrices, axis=(-2, -1))


def times(matrices, vectors):
    return (matrices @ vectors[..., np.newaxis])[..., 0]


@cache
def orthogonal(m, n):
    """Return random singular vectors: U of shape (COUNT, m, m) and V^T of shape (COUNT, m, n)."""
    rng = np.random.default_rng([m, n])
    left, _ = np.linalg.qr(rng.normal(size=(COUNT, m, m)))
    right, _ = np.linalg.qr(rng.normal(size=(COUNT, n, m)))
    for vectors in (left, right):
        vectors.setflags(write=False)
    return left, np.swapaxes(right, 1, 2)


def nearly_singular(rng, m, n, count=COUNT):
    """Return Jacobians whose smallest singular value is from 1e-12 to 1, or 0, these, and damping."""
    left, right = (vectors[:count] for vectors in orthogonal(m, n))
    values = 10.0 ** rng.uniform(-1.0, 0.0, (count, m))
    values[:, -1] = 10.0 ** rng.uniform(-12.0, 0.0, count)
    values[::17, -1] = 0.0
    return left * values[:, np.newaxis] @ right, values, 10.0 ** rng.uniform(-3.0, 0.0, count)


def nearby(rng, J):
    """Return Jacobians at a distance from 1e-9 to 1."""
    return J + 10.0 ** rng.uniform(-9.0, 0.0, (len(J), 1, 1)) * rng.normal(size=J.shape)


# --- The null space


@shapes
def test_nothing_leaks_where_singular_values_are_zero_or_a_tenth_of_the_damping(m, n):
    rng = np.random.default_rng(1)
    left, right = orthogonal(m, n)
    damping = 10.0 ** rng.uniform(-3.0, 1.0, COUNT)
    values = damping[:, np.newaxis] * 10.0 ** rng.uniform(-1.0 + 1e-6, 3.0, (COUNT, m))
    values[::5, -1] = 0.0
    J, wish = left * values[:, np.newaxis] @ right, rng.normal(size=(COUNT, n))
    tolerance = ROUNDING * size(J) * norm(wish)
    assert np.all(norm(times(J, iv.redundant(J, np.zeros(m), wish, damping))) <= tolerance)
    N = iv.null_space_projector(J, damping)
    assert np.all(norm(times(J, times(N, wish))) <= tolerance)


@shapes
def test_what_leaks_near_a_loss_of_rank_is_bounded_by_a_fortieth_of_the_damping(m, n):
    rng = np.random.default_rng(2)
    J, values, damping = nearly_singular(rng, m, n)
    wish = rng.normal(size=(COUNT, n))
    leak = norm(times(J, iv.redundant(J, np.zeros(m), wish, damping)))
    bound = iv.FILTER * damping / 4.0 * norm(wish)
    assert np.all(leak <= bound + ROUNDING * norm(wish))
    # It is what the singular values say.
    f = np.minimum(values / (iv.FILTER * damping[:, np.newaxis]), 1.0)
    N = iv.null_space_projector(J, damping)
    np.testing.assert_allclose(
        np.linalg.norm(J @ N, ord=2, axis=(1, 2)), (values * (1.0 - f)).max(axis=1), atol=1e-12
    )
    # And the bound is reached: in the middle of the filter, along the singular vector.
    J = np.zeros((m, n))
    J[range(m), range(m)] = iv.FILTER * 0.3 / 2.0
    worst = J @ iv.redundant(J, np.zeros(m), np.eye(n)[0], 0.3)
    assert norm(worst) == pytest.approx(iv.FILTER * 0.3 / 4.0)


# --- Bounds over random pairs


@shapes
def test_joint_velocities_change_by_no_more_than_the_task_velocity_over_twice_the_damping(m, n):
    rng = np.random.default_rng(4)
    J, _, damping = nearly_singular(rng, m, n)
    first, second = rng.normal(size=(2, COUNT, m))
    wish = rng.normal(size=(COUNT, n))
    bound = norm(second - first) / (2.0 * damping) * (1.0 + 1e-9)
    for law in (
        lambda x_dot: iv.damped_least_squares(J, x_dot, damping),
        lambda x_dot: iv.redundant(J, x_dot, wish, damping),
        lambda x_dot: iv.prioritized([(J, x_dot)], damping),
        lambda x_dot: iv.prioritized([(np.eye(n)[:1], [1.0]), (J, x_dot)], damping),
    ):
        assert np.all(norm(law(second) - law(first)) <= bound + ROUNDING * norm(wish) / damping)


@shapes
def test_inverse_and_projector_are_continuous_in_the_jacobian(m, n):
    rng = np.random.default_rng(5)
    J, _, damping = nearly_singular(rng, m, n)
    other = nearby(rng, J)
    distance, x_dot = size(other - J), rng.normal(size=(COUNT, m))
    change = size(iv.null_space_projector(other, damping) - iv.null_space_projector(J, damping))
    assert np.all(change <= np.sqrt(2.0) / (iv.FILTER * damping) * distance + ROUNDING)
    one, two = (iv.damped_least_squares(matrix, x_dot, damping) for matrix in (J, other))
    bound = norm(x_dot) / damping**2 * (distance + ROUNDING)
    assert np.all(norm(two - one) <= bound)


# --- Priorities


def tasks_in_conflict(rng, n=4):
    """Return three tasks for each of many robots, the later ones nearly combinations of earlier ones."""
    J_1 = nearly_singular(rng, 2, n)[0]
    J_2 = rng.normal(size=(COUNT, 1, 2)) @ J_1 + 10.0 ** rng.uniform(-10.0, 0.0, (COUNT, 1, 1)) * (
        rng.normal(size=(COUNT, 1, n))
    )
    J_3 = rng.normal(size=(COUNT, 2, 1)) @ J_2 + 10.0 ** rng.uniform(-10.0, 0.0, (COUNT, 1, 1)) * (
        rng.normal(size=(COUNT, 2, n))
    )
    return [(J, rng.normal(size=(COUNT, J.shape[1]))) for J in (J_1, J_2, J_3)]


def test_tasks_that_nearly_conflict_stay_slow_and_do_not_jump():
    def q_dot(d):
        J = np.ones(np.shape(d))[..., np.newaxis, np.newaxis] * [[1.0, 0.0, 0.0]]
        J[..., 0, 1] = d
        return iv.prioritized([([[1.0, 0.0, 0.0]], [1.0]), (J, [0.0])], damping=0.1)

    conflict = np.concatenate([[0.0], np.logspace(-12.0, 0.0, 1201)])
    found = q_dot(conflict)
    assert norm(found).max() <= 1.0 / 0.2 + 1.0
    assert norm(q_dot(1e-8) - q_dot(0.0)) < 1e-5
    assert norm(iv.prioritized([([[1.0, 0.0, 0.0]], [1.0]), ([[1.0, 1e-8, 0.0]], [0.0])])) > 1e7
    # Derived: d / (d^2 + lambda^2) of what the second task lacks, which is -x of the first.
    lacks = -1.0 / (1.0 + 0.1**2)
    np.testing.assert_allclose(found[:, 1], lacks * conflict / (conflict**2 + 0.01), atol=1e-12)


def test_each_task_contributes_a_bounded_velocity_and_leaves_those_before_it_almost_alone():
    rng = np.random.default_rng(6)
    tasks, damping = tasks_in_conflict(rng), 10.0 ** rng.uniform(-3.0, 0.0, COUNT)
    before = np.zeros((COUNT, 4))
    for k, (J, x_dot) in enumerate(tasks):
        after = iv.prioritized(tasks[: k + 1], damping)
        missing = norm(x_dot - times(J, before))
        assert np.all(norm(after - before) <= missing / (2.0 * damping) * (1.0 + 1e-6) + ROUNDING)
        for earlier, _ in tasks[:k]:
            moved = norm(times(earlier, after - before))
            assert np.all(moved <= iv.FILTER / 8.0 * missing + 1e-9 * norm(after - before))
        before = after


def test_damped_priorities_are_continuous_in_all_jacobians():
    """The bound adds up what the projector, the inverse and the tasks before contribute."""
    rng = np.random.default_rng(8)
    tasks, damping = tasks_in_conflict(rng), 10.0 ** rng.uniform(-1.5, 0.0, COUNT)
    step = 10.0 ** rng.uniform(-9.0, -1.0, (COUNT, 1, 1))
    others = [(J + step * rng.normal(size=J.shape), x_dot) for J, x_dot in tasks]
    width, moved, fast = iv.FILTER * damping, np.zeros(COUNT), np.zeros(COUNT)
    projector = np.zeros(COUNT)  # how far the two projectors are apart
    for k, ((J, x_dot), (other, _)) in enumerate(zip(tasks, others, strict=True)):
        distance, largest = size(other - J), np.maximum(size(J), size(other))
        apart = distance + largest * projector
        missing = norm(x_dot) + largest * fast
        lacking_apart = distance * fast + largest * moved
        moved = (
            moved
            + projector * missing / (2.0 * damping)
            + apart * missing / damping**2
            + lacking_apart / (2.0 * damping)
        )
        fast = fast + missing / (2.0 * damping)
        projector = projector + np.sqrt(2.0) / width * apart
        found = [iv.prioritized(choice[: k + 1], damping) for choice in (tasks, others)]
        assert np.all(norm(found[1] - found[0]) <= moved * (1.0 + 1e-6) + 1e-9)


@pytest.mark.parametrize('damping', [0.0, 0.1])
def test_tasks_of_one_robot_and_of_many_broadcast(damping):
    rng = np.random.default_rng(14)
    many = rng.normal(size=(5, 1, 2, 4)), rng.normal(size=(3, 2))
    one = rng.normal(size=(1, 4)), rng.normal(size=1)
    for order in ((many, one), (one, many), (one, many, one)):
        together = iv.prioritized(order, damping)
        assert together.shape == (5, 3, 4)
        for i, j in np.ndindex(5, 3):
            tasks = [(J[i, 0], x_dot[j]) if J.ndim > 2 else (J, x_dot) for J, x_dot in order]
            np.testing.assert_allclose(together[i, j], iv.prioritized(tasks, damping), atol=1e-10)


# --- Limits


def test_limits_are_never_exceeded_and_all_tasks_keep_their_direction():
    rng = np.random.default_rng(10)
    tasks = [(rng.normal(size=(COUNT, m, 5)), rng.normal(size=(COUNT, m))) for m in (2, 2)]
    limits = 10.0 ** rng.uniform(-2.0, 2.0, (COUNT, 5))
    free = iv.prioritized(tasks)
    q_dot = iv.prioritized(tasks, max_velocity=limits)
    assert np.all(np.abs(q_dot) <= limits)
    factor = norm(q_dot) / norm(free)
    np.testing.assert_allclose(q_dot, factor[:, np.newaxis] * free, rtol=1e-12, atol=1e-14)
    for J, x_dot in tasks:
        np.testing.assert_allclose(times(J, q_dot), factor[:, np.newaxis] * x_dot, atol=1e-9)
    # No slower than necessary.
    at_limit = (np.abs(q_dot) / limits).max(axis=1)
    np.testing.assert_allclose(at_limit[factor < 1.0 - 1e-12], 1.0, rtol=1e-12)
    within = np.all(np.abs(free) <= limits, axis=1)
    assert 0.01 < within.mean() < 0.99
    assert np.array_equal(q_dot[within], free[within])
    # One limit for all joints, and none.
    assert iv.limit_velocity([3.0, -4.0], 2.0).tolist() == [1.5, -2.0]
    assert iv.limit_velocity([3.0, -4.0], [np.inf, 8.0]).tolist() == [3.0, -4.0]


# --- Weights


@pytest.mark.parametrize(('m', 'n'), [(1, 3), (2, 3), (2, 7), (3, 4)])
def test_weighted_solutions_are_those_of_lagrange(m, n):
    """Minimise the weighted norm under the constraint, by its optimality conditions."""
    rng = np.random.default_rng(11)
    J, x_dot, wish = (rng.normal(size=(500, *shape)) for shape in ((m, n), (m,), (n,)))
    weights = 10.0 ** rng.uniform(-1.5, 1.5, (500, n))
    clear = np.linalg.svd(J, compute_uv=False).min(axis=1) > 0.1
    J, x_dot, wish, weights = J[clear], x_dot[clear], wish[clear], weights[clear]
    W = weights[:, :, np.newaxis] * np.eye(n)
    optimality = np.block([[W, np.swapaxes(J, 1, 2)], [J, np.zeros((len(J), m, m))]])

    def nearest(to):
        right = np.concatenate([weights * to, x_dot], axis=1)
        return np.linalg.solve(optimality, right[..., np.newaxis])[:, :n, 0]

    close = {'rtol': 1e-7, 'atol': 1e-7}
    least = nearest(np.zeros_like(wish))
    np.testing.assert_allclose(times(iv.pseudoinverse(J, weights=weights), x_dot), least, **close)
    np.testing.assert_allclose(iv.damped_least_squares(J, x_dot, 0.0, weights=weights), least, **close)
    np.testing.assert_allclose(iv.prioritized([(J, x_dot)], weights=weights), least, **close)
    np.testing.assert_allclose(iv.redundant(J, x_dot, wish, weights=weights), nearest(wish), **close)
    N = iv.null_space_projector(J, weights=weights)
    np.testing.assert_allclose(J @ N, 0.0, atol=1e-10)
    np.testing.assert_allclose(N @ N, N, atol=1e-10)
    np.testing.assert_allclose(W @ N, np.swapaxes(W @ N, 1, 2), atol=1e-10)
    np.testing.assert_allclose(least + times(N, wish), nearest(wish), **close)
    damped = np.linalg.solve(np.swapaxes(J, 1, 2) @ J + 0.3**2 * W, np.swapaxes(J, 1, 2))
    found = iv.damped_least_squares(J, x_dot, 0.3, weights=weights)
    np.testing.assert_allclose(found, times(damped, x_dot), **close)


def test_bounds_hold_in_the_weighted_norm():
    rng = np.random.default_rng(15)
    J, _, damping = nearly_singular(rng, 2, 4)
    weights = 10.0 ** rng.uniform(-1.0, 1.0, (COUNT, 4))
    wish, x_dot = rng.normal(size=(COUNT, 4)), rng.normal(size=(COUNT, 2))
    leak = norm(times(J, iv.redundant(J, np.zeros(2), wish, damping, weights=weights)))
    largest = norm(np.sqrt(weights) * wish)
    assert np.all(leak <= iv.FILTER * damping / 4.0 * largest + 1e-11)
    q_dot = np.sqrt(weights) * iv.damped_least_squares(J, x_dot, damping, weights=weights)
    assert np.all(norm(q_dot) <= norm(x_dot) / (2.0 * damping) * (1.0 + 1e-9))


def test_equal_weights_change_nothing_and_a_heavy_joint_rests():
    rng = np.random.default_rng(12)
    J, x_dot, wish = rng.normal(size=(2, 4)), rng.normal(size=2), rng.normal(size=4)
    twice = np.full(4, 4.0)
    np.testing.assert_allclose(iv.pseudoinverse(J, weights=twice), iv.pseudoinverse(J), atol=1e-14)
    # Roots of 2: a damping of 0.1 is one of 0.2 in the units of J.
    one = iv.redundant(J, x_dot, wish, 0.1, weights=twice)
    np.testing.assert_allclose(one, iv.redundant(J, x_dot, wish, 0.2), atol=1e-14)
    heavy = iv.damped_least_squares(J, x_dot, 0.0, weights=[1.0, 1.0, 1e8, 1.0])
    assert abs(heavy[2]) < 1e-6
    np.testing.assert_allclose(J @ heavy, x_dot, atol=1e-12)


# --- Extremes


@pytest.mark.parametrize(
    ('J', 'x_dot', 'damping', 'expected'),
    [
        ([[1.0, 0.0], [0.0, 1e-140]], [1.0, 1.0], 1e-300, [1.0, 1e140]),
        ([[1.0, 0.0], [0.0, 1e-170]], [1.0, 1.0], 1e-300, [1.0, 0.0]),
        ([[0.0, 1e-140], [1.0, 0.0]], [1.0, 1.0], 1e-140, [1.0, 5e139]),
        ([[1e-140, 0.0], [0.0, 1e-140]], [1e200, 0.0], 0.0, None),
        ([[1e300, 0.0], [0.0, 1e290]], [1e300, 1e290], 0.0, None),
        (1e-140 * np.eye(3), [1e-140, 0.0, 0.0], 1e-140, [0.5, 0.0, 0.0]),
        (1e-140 * np.eye(3), [1e200, 1.0, 0.0], 0.0, None),
    ],
    ids=str,
)
def test_extreme_units_give_numbers_alone_and_in_a_batch_or_an_error(J, x_dot, damping, expected):
    if expected is None:
        with pytest.raises(ValueError, match='must give a finite result, but it overflows'):
            iv.damped_least_squares(J, x_dot, damping)
        return
    alone = iv.damped_least_squares(J, x_dot, damping)
    np.testing.assert_allclose(alone, expected, rtol=1e-9)
    J, x_dot = np.asarray(J), np.asarray(x_dot)
    company = np.stack([np.eye(*J.shape), J, 1e-3 * np.eye(*J.shape)])
    together = iv.damped_least_squares(company, x_dot, [0.1, damping, 0.0])
    assert np.array_equal(together[1], alone)
    zero = np.zeros(J.shape[1])
    assert np.array_equal(iv.redundant(J, x_dot, zero, damping), alone)
