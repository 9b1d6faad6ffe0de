"""Inverse velocity: adjugate, pseudo-inverse, damping, null space, priorities, weights and limits."""

from __future__ import annotations

import contextlib
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from public_calls import BROADCASTING, WIDE, X_DOT

from diffdrive_jacobian.kinematics import diff_drive
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

EPS = np.finfo(float).eps
SVD = 300.0 * EPS  # LAPACK stops when what is left beside the singular values is below some 90 eps.
deterministic = settings(deadline=None, derandomize=True)
shapes = pytest.mark.parametrize(
    ('m', 'n'), [(1, 1), (1, 5), (2, 1), (2, 2), (2, 7), (3, 2), (3, 3), (3, 4), (4, 7)]
)
TASK = WIDE, X_DOT


def norm(vectors):
    return np.linalg.norm(vectors, axis=-1)


def size(matrices):
    return np.linalg.norm(matrices, axis=(-2, -1))


def transposed(matrices):
    return np.swapaxes(matrices, -1, -2)


def times(matrices, vectors):
    return (matrices @ vectors[..., np.newaxis])[..., 0]


def decomposed(m, n, count=500, seed=1):
    """Give J = U diag(s) V^T of all scales, s from 1 down to 1e-16 and exact zeros."""
    rng = np.random.default_rng(seed)
    U, _, V_T = np.linalg.svd(rng.normal(size=(count, m, n)), full_matrices=False)
    s = 10.0 ** rng.uniform(-16.0, 0.0, (count, min(m, n)))
    s[count // 2 :] **= 0.1  # well conditioned
    s[rng.random(s.shape) < 0.2] = 0.0
    s *= 10.0 ** rng.uniform(-6.0, 6.0, (count, 1))
    return U * s[:, np.newaxis] @ V_T, U, s, transposed(V_T)


def rank(m, n, s):
    """Give the rank by the library's cutoff, and whether rounding could not change it."""
    relative = s / np.maximum(s.max(axis=-1, keepdims=True), 1e-300) / (iv.CUTOFF * max(m, n))
    return (relative > 1.0).sum(axis=-1), ((relative < 0.5) | (relative > 2.0)).all(axis=-1)


# --- The adjugate


@deterministic
@given(arrays(int, (2, 2), elements=st.integers(-9, 9)))
def test_the_adjugate_inverts_what_is_not_singular_and_names_the_determinant_of_what_is(J):
    if round(np.linalg.det(J)) == 0:
        with pytest.raises(np.linalg.LinAlgError, match=r'^J must not be .* a determinant of -?0$'):
            iv.adjugate_inverse(J)
    else:
        inverse, tolerance = iv.adjugate_inverse(J), 20.0 * EPS * np.linalg.cond(J)
        for other in (np.linalg.inv(J), np.linalg.solve(J, np.eye(len(J)))):
            np.testing.assert_allclose(inverse, other, rtol=0.0, atol=tolerance * np.abs(other).max())


def test_the_adjugate_never_gives_what_is_rounding_error_only():
    J, _, s, _ = decomposed(2, 2, count=1000)
    J[::5] = J[::5, :1] * J[::5, :, :1]  # rank 1
    s[::5, 1:] = 0.0
    inverses = np.zeros_like(J)
    for matrix, inverse in zip(J, inverses, strict=True):
        with contextlib.suppress(np.linalg.LinAlgError):
            inverse[:] = iv.adjugate_inverse(matrix)
    given, relative = inverses.any(axis=(1, 2)), s.min(axis=-1) / np.maximum(s.max(axis=-1), 1e-300)
    assert np.all(relative[given] > 1e-16)
    which = given & (relative > 1e-12)
    right = np.linalg.inv(J[which])
    assert np.all(size(inverses[which] - right) <= 0.01 * size(right))


@pytest.mark.parametrize('scale', [1e-310, 1e-161, 1e-140, 1e150, 1e200])
def test_the_adjugate_inverts_whatever_the_units_or_raises_an_error(scale):
    J = np.array([[1.0, 1.0], [0.5, 2.0]])
    if scale < 1e-145:
        with pytest.raises(np.linalg.LinAlgError, match='must not be singular'):
            iv.adjugate_inverse(J * scale)
    elif scale > 1e154:
        with pytest.raises(ValueError, match='J must give a finite result, but it overflows'):
            iv.adjugate_inverse(J * scale)
    else:
        inverse = iv.adjugate_inverse(J * scale) * scale
        np.testing.assert_allclose(inverse, np.linalg.inv(J), rtol=1e-12)


def test_the_axle_centre_is_refused_and_so_is_one_of_a_batch_with_its_index():
    theta, r, L = np.random.default_rng(3).uniform(0.01, 3.0, (3, 100))
    for J in [*diff_drive.wheel_to_position_jacobian(theta, r, L), np.zeros((2, 2))]:
        with pytest.raises(np.linalg.LinAlgError, match=r'a determinant of 0$'):
            iv.adjugate_inverse(J)
    J = np.broadcast_to(np.diag([1.0, 2.0]), (4, 5, 2, 2)).copy()
    J[2, 1, 0, 0] = J[3, 3, 0, 0] = 0.0
    for batch, index in [(J, r'\(2, 1\)'), (J[2], '1'), (J[2:, 1], '0')]:
        with pytest.raises(np.linalg.LinAlgError, match=rf'a determinant of 0 \(at index {index}\)$'):
            iv.adjugate_inverse(batch)


# --- The pseudo-inverse and the null space


@shapes
def test_the_penrose_conditions_hold(m, n):
    J, *_ = decomposed(m, n)
    P = iv.pseudoinverse(J)
    rounding = SVD * np.maximum(size(J) * size(P), 1.0)
    assert np.all(size(J @ P @ J - J) <= rounding * size(J))
    assert np.all(size(P @ J @ P - P) <= rounding * size(P))
    assert np.all(size(J @ P - transposed(J @ P)) <= rounding)
    assert np.all(size(P @ J - transposed(P @ J)) <= rounding)


@shapes
def test_the_pseudo_inverse_inverts_singular_values_and_leaves_zeros(m, n):
    J, U, s, V = decomposed(m, n)
    largest = s.max(axis=-1, keepdims=True)
    kept = s > 1e-8 * largest
    clear = (kept | (s <= 3e-16 * largest)).all(axis=-1)
    assert clear.mean() > 0.4
    P = V * np.where(kept, 1.0 / np.where(kept, s, 1.0), 0.0)[:, np.newaxis] @ transposed(U)
    error = size(iv.pseudoinverse(J) - P)
    assert np.all((error <= SVD * size(J) * size(P) ** 2)[clear])


@shapes
def test_the_projector_is_one_and_moves_no_task(m, n):
    J, _, s, _ = decomposed(m, n)
    N = iv.null_space_projector(J)
    assert np.all(size(J @ N) <= (4.0 * max(m, n) * iv.CUTOFF + 20.0 * EPS) * size(J))
    np.testing.assert_allclose(N @ N, N, rtol=0.0, atol=30.0 * EPS)
    np.testing.assert_allclose(N, transposed(N), rtol=0.0, atol=10.0 * EPS)
    ranks, clear = rank(m, n, s)
    np.testing.assert_allclose(np.trace(N, axis1=-2, axis2=-1)[clear], (n - ranks)[clear], atol=1e-13)


def test_the_projector_and_the_pseudo_inverse_count_the_same_values_as_zero():
    J = np.zeros((1000, 4, 4))
    J[:, range(4), range(4)] = 1.0
    J[:, 3, 3] = np.logspace(-16.0, -13.0, 1000)
    np.testing.assert_allclose(
        iv.null_space_projector(J), np.eye(4) - iv.pseudoinverse(J) @ J, atol=1e-13
    )


@shapes
def test_without_damping_it_is_the_pseudo_inverse_and_redundancy_adds_the_null_space(m, n):
    J, _, s, _ = decomposed(m, n)
    ranks, clear = rank(m, n, s)
    J, full = J[clear], (ranks == m)[clear]
    rng = np.random.default_rng(4)
    x_dot, wish = rng.normal(size=(len(J), m)), rng.normal(size=(len(J), n))
    P, N = iv.pseudoinverse(J), iv.null_space_projector(J)
    least, rounding = times(P, x_dot), SVD * (1.0 + size(J) * size(P))
    error = norm(iv.damped_least_squares(J, x_dot, 0.0) - least)
    assert np.all(error <= rounding * size(P) * norm(x_dot))
    error = norm(times(J, iv.damped_least_squares(J, x_dot, 0.0)) - x_dot)
    assert np.all((error <= rounding * norm(x_dot))[full])
    rounding *= size(P) * norm(x_dot) + norm(wish)
    assert np.all(norm(iv.redundant(J, x_dot, wish) - least - times(N, wish)) <= rounding)
    assert np.all(norm(iv.redundant(J, times(J, wish), wish) - wish) <= rounding)


# --- Damped least squares


@shapes
def test_with_damping_it_is_the_dense_solution_and_that_of_each_singular_value(m, n):
    J, U, s, V = decomposed(m, n)
    rng = np.random.default_rng(6)
    x_dot, damping = (
        rng.normal(size=(len(J), m)),
        size(J) * 10.0 ** rng.uniform(-8.0, 1.0, len(J)) + 1e-9,
    )
    q_dot = iv.damped_least_squares(J, x_dot, damping)
    gains = s / (s**2 + damping[:, np.newaxis] ** 2)
    exact = times(V * gains[:, np.newaxis] @ transposed(U), x_dot)
    assert np.all(norm(q_dot - exact) <= SVD * size(J) * norm(x_dot) / damping**2)
    square = J @ transposed(J) + (damping**2)[:, np.newaxis, np.newaxis] * np.eye(m)
    dense = times(transposed(J), times(np.linalg.inv(square), x_dot))
    error = norm(q_dot - dense) * damping**2 / norm(x_dot)
    assert np.all((error <= 1e-9 * size(J))[damping > 1e-3 * size(J)])


@shapes
def test_no_joint_is_faster_than_the_damping_allows(m, n):
    J, *_ = decomposed(m, n)
    J[::10] = 0.0
    J[1::10] = J[1::10, :1]  # equal rows
    J[2::10] = J[2::10, :, :1]  # equal columns
    x_dot = np.random.default_rng(7).normal(size=(len(J), m))
    damping = np.logspace(-12.0, 3.0, 31)[:, np.newaxis]
    for factor in (1e-6, 1.0, 1e6):
        q_dot = iv.damped_least_squares(factor * J, x_dot, damping)
        assert np.all(norm(q_dot) <= norm(x_dot) / (2.0 * damping) * (1.0 + 1e-12))
    for value in (0.1, 1e-20):
        fastest = iv.damped_least_squares(np.diag([value, *[1.0] * 6])[:m, :n], np.eye(m)[0], value)
        assert norm(fastest) == pytest.approx(1.0 / (2.0 * value), rel=1e-14)


@deterministic
@given(st.floats(0.0, 10.0), st.floats(1e-3, 10.0), st.floats(0.0, 10.0))
def test_damping_sets_in_below_the_threshold_and_grows_to_the_maximum(w, threshold, maximum):
    factor = iv.damping(w, threshold, maximum)
    squared = maximum**2 * (1.0 - w / threshold) ** 2 if w < threshold else 0.0
    assert factor**2 == pytest.approx(squared, rel=1e-9, abs=1e-290)
    assert 0.0 <= factor <= maximum == iv.damping(0.0, threshold, maximum)
    assert np.all(np.diff(iv.damping(np.linspace(0.0, 2.0 * threshold, 9), threshold, maximum)) <= 0.0)


@pytest.mark.parametrize('scale', [1e-70, 1e-30, 1e30, 1e70])
def test_other_units_give_the_same_motion_and_other_robots_change_nothing(scale):
    J, x_dot = np.array([[1.0, 2.0, 0.5], [-0.3, 1.0, 2.0]]), np.array([0.2, -0.7])
    both, damping = np.array([J, scale * J]), [0.1, 0.1 * scale]
    expected = iv.damped_least_squares(J, x_dot, 0.1)
    one, other = iv.damped_least_squares(both, x_dot, damping)
    for q_dot in (one, other * scale, iv.damped_least_squares(both[1], x_dot, damping[1]) * scale):
        np.testing.assert_allclose(q_dot, expected, rtol=1e-12)
    w = iv.manipulability(J)
    np.testing.assert_allclose(iv.manipulability(both), [w, scale * w * scale], rtol=1e-12)
    assert iv.manipulability(both[1]) == pytest.approx(scale * w * scale, rel=1e-12)


@shapes
def test_manipulability_is_the_volume_of_the_velocities_and_does_not_depend_on_axes(m, n):
    rng = np.random.default_rng(8)
    J = rng.normal(size=(500, m, n))
    w, gram = iv.manipulability(J), np.linalg.det(J @ transposed(J)) * (m <= n)
    np.testing.assert_allclose(w, np.sqrt(np.maximum(gram, 0.0)), rtol=1e-7, atol=1e-7)
    U, V = (np.linalg.qr(rng.normal(size=(side, side)))[0] for side in (m, n))
    np.testing.assert_allclose(iv.manipulability(U @ J @ V), w, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(iv.manipulability(-3.0 * J), 3.0**m * w, rtol=1e-9)
    J[:, -1] = J[:, 0] if m > 1 else 0.0
    np.testing.assert_allclose(iv.manipulability(J), 0.0, atol=1e-13)


@shapes
def test_ellipsoids_contain_what_unit_joint_velocities_and_torques_can_do(m, n):
    rng = np.random.default_rng(9)
    J = rng.normal(size=(100, m, n))
    (U, s), (same, inverse) = iv.velocity_ellipsoid(J), iv.force_ellipsoid(J)
    assert np.array_equal(U, same)
    np.testing.assert_allclose(transposed(U) @ U, np.broadcast_to(np.eye(m), U.shape), atol=1e-12)
    np.testing.assert_allclose(s * s, np.linalg.eigvalsh(J @ transposed(J))[:, ::-1], atol=1e-9)
    assert np.array_equal(iv.smallest_singular_value(J), s[:, -1])
    assert np.array_equal(iv.condition_number(J), s[:, 0] / s[:, -1] if m <= n else [np.inf] * 100)
    if m > n:  # Some velocities cannot be produced, and some forces need no torque.
        assert not s[:, n:].any()
        assert np.isinf(inverse[:, n:]).all()
        return
    np.testing.assert_allclose(s.prod(axis=-1), iv.manipulability(J), rtol=1e-9)
    q_dot = np.linalg.pinv(J) @ (U * s[:, np.newaxis])  # joints of norm 1 for the ends of the axes
    np.testing.assert_allclose(np.linalg.norm(q_dot, axis=1), 1.0)
    tau = transposed(J) @ (U * inverse[:, np.newaxis])
    np.testing.assert_allclose(np.linalg.norm(tau, axis=1), 1.0)


def test_a_singular_direction_is_an_axis_of_length_zero_and_carries_every_force():
    J = PlanarArm([1.0, 1.0, 1.0]).jacobian([0.3, 0.0, np.pi])
    U, s = iv.velocity_ellipsoid(J)
    np.testing.assert_allclose(np.abs(U[:, 1]), [np.cos(0.3), np.sin(0.3)])
    assert s[1] == iv.smallest_singular_value(J) == 0.0
    assert iv.force_ellipsoid(J).semi_axes[1] == iv.condition_number(J) == np.inf
    assert iv.condition_number(np.zeros((2, 2))) == np.inf


@shapes
def test_a_masked_task_minimises_the_weighted_error_and_omits_entries_of_weight_zero(m, n):
    rng = np.random.default_rng(10)
    J, x_dot, M = rng.normal(size=(m, n)), rng.normal(size=m), rng.uniform(0.5, 2.0, m)
    M[0] *= m == 1  # All entries are omitted, then nothing moves.
    q_dot = iv.damped_least_squares(*iv.masked_task(J, x_dot, M), 0.0)
    np.testing.assert_allclose(J.T @ (M * (x_dot - J @ q_dot)), 0.0, atol=1e-12)
    M[-1] = 0.0
    alone = iv.prioritized([iv.masked_task(J, x_dot, M)])
    if m > 1:
        roots = np.sqrt(M[:-1])
        expected = np.linalg.pinv(roots[:, np.newaxis] * J[:-1]) @ (roots * x_dot[:-1])
        np.testing.assert_allclose(alone, expected, atol=1e-12)


# --- Nearly singular

COUNT = 500
ROUNDING = 1e-12
redundant = pytest.mark.parametrize(('m', 'n'), [(1, 3), (2, 2), (2, 7), (3, 4), (4, 6)])


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


# --- The null space near a loss of rank


@redundant
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


@redundant
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


@redundant
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


@redundant
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


# --- Bad input


@pytest.mark.parametrize(
    ('function', 'bad', 'message'),
    [
        (iv.pseudoinverse, {'J': np.ones((0, 3))}, r'J must have shape .* got \(0, 3\)'),
        (iv.damped_least_squares, {'damping': -0.1}, r'damping must be zero or positive.* got -0\.1'),
        (iv.null_space_projector, {'damping': -0.1}, r'damping must be zero or positive.* got -0\.1'),
        (iv.damped_least_squares, {'weights': [1.0, 0.0, 1.0]}, r'weights must be positive .* got 0\.0'),
        (iv.damping, {'manipulability': -1e-9}, r'manipulability must be zero or .* got -1e-09'),
        (iv.damping, {'threshold': 0.0}, r'threshold must be positive .* got 0'),
        (iv.damping, {'maximum': -1.0}, r'maximum must be zero or positive .* got -1'),
        (iv.masked_task, {'mask': [1.0, -1.0]}, r'mask must be zero or positive .* got -1'),
        (iv.joint_limit_cost, {'upper': [-3.0, 1.0]}, r'upper must be above lower'),
        (iv.joint_limit_gradient, {'upper': [-4.0, 1.0]}, r'upper must be above lower'),
        (iv.manipulability_gradient, {'jacobian': lambda q: np.eye(2)}, r'jacobian must return'),
        (iv.limit_velocity, {'max_velocity': [1.0, 0.0, 1.0]}, r'max_velocity must be positive, got'),
        (iv.prioritized, {'max_velocity': [1.0, 0.0, 1.0]}, r'max_velocity must be positive, got'),
        (iv.prioritized, {'damping': -0.1}, r'damping must be zero or positive.* got -0\.1'),
        (iv.prioritized, {'cutoff': 0.0}, r'cutoff must be positive'),
        (iv.prioritized, {'cutoff': np.nan}, r'cutoff must be positive'),
        (iv.prioritized, {'tasks': []}, r'tasks must contain at least one'),
        (iv.prioritized, {'tasks': 7}, r'tasks must be pairs .* got 7'),
        (iv.prioritized, {'tasks': [np.eye(3)]}, r'tasks must be pairs'),
        (iv.prioritized, {'tasks': [TASK, (np.eye(2), [1.0, 1.0])]}, r'tasks must all .*joints.*3, 2'),
        (iv.prioritized, {'tasks': [(TASK[0], [1.0, np.nan])]}, r'x_dot of task 0 must be finite'),
        (
            iv.prioritized,
            {'tasks': [TASK, ([[1.0], [1.0, 2.0]], [1.0])]},
            r'J of task 1 must be an array',
        ),
        (iv.prioritized, {'tasks': [(TASK[0], [1.0])]}, r'x_dot of task 0 must have shape'),
    ],
)
def test_an_error_names_the_argument_what_was_got_and_what_is_allowed(function, bad, message):
    with pytest.raises(ValueError, match=f'^{message}'):
        function(**BROADCASTING[function] | bad)
