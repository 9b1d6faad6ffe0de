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

"""Inverse velocity: adjugate, pseudo-inverse, damping, null space, priorities, weights and limits.

Laws are checked for batches of random Jacobians, on purpose often singular and nearly singular.
"""

from __future__ import annotations

import numpy as np
import pytest
from public_calls import BROADCASTING, WIDE, X_DOT

from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

EPS = np.finfo(float).eps
SVD = 300.0 * EPS  # LAPACK stops when what is left beside the singular values is below some 90 eps.
COUNT = 300
shapes = pytest.mark.parametrize(('m', 'n'), [(1, 1), (2, 1), (2, 2), (2, 7), (3, 2), (3, 3), (3, 4)])


def norm(vectors):
    return np.linalg.norm(vectors, axis=-1)


def size(matrices):
    return np.linalg.norm(matrices, axis=(-2, -1))


def transposed(matrices):
    return np.swapaxes(matrices, -1, -2)


def times(matrices, vectors):
    return (matrices @ vectors[..., np.newaxis])[..., 0]


def decomposed(rng, m, n, least=1e-10):
    """Return J = U diag(s) V^T of all sizes, U, s from 1 down to the least and exact zeros, and V."""
    U, _, V_T = np.linalg.svd(rng.normal(size=(COUNT, m, n)), full_matrices=False)
    s = least ** rng.uniform(0.0, 1.0, (COUNT, min(m, n)))
    s[rng.random(s.shape) < 0.2] = 0.0
    s *= 10.0 ** rng.uniform(-6.0, 6.0, (COUNT, 1))
    return U * s[:, np.newaxis] @ V_T, U, s, transposed(V_T)


# --- The adjugate


def test_the_adjugate_inverts_what_is_not_singular_and_names_the_determinant_of_what_is():
    matrices = np.random.default_rng(2).integers(-3, 4, (200, 2, 2))
    singular = np.round(np.linalg.det(matrices)) == 0
    assert 10 < singular.sum() < 100
    for J in matrices[singular][:30]:
        with pytest.raises(np.linalg.LinAlgError, match=r'^J must not be .* a determinant of -?0$'):
            iv.adjugate_inverse(J)
    inverse = iv.adjugate_inverse(matrices[~singular])
    np.testing.assert_allclose(inverse, np.linalg.inv(matrices[~singular]), rtol=1e-12, atol=1e-14)
    J = np.broadcast_to(np.diag([1.0, 2.0]), (4, 5, 2, 2)).copy()
    J[2, 1, 0, 0] = J[3, 3, 0, 0] = 0.0
    for batch, index in [(J, r'\(2, 1\)'), (J[2], '1'), (J[2:, 1], '0')]:
        with pytest.raises(np.linalg.LinAlgError, match=rf'a determinant of 0 \(at index {index}\)$'):
            iv.adjugate_inverse(batch)


# --- Inverses and the null space


@shapes
@pytest.mark.parametrize('damped', [False, True])
def test_inverses_and_projectors_are_those_of_the_singular_values(m, n, damped):
    """The sums over singular values of the description of the module, for any rank."""
    rng = np.random.default_rng(6)
    J, U, s, V = decomposed(rng, m, n)
    damping = damped * (size(J) * 10.0 ** rng.uniform(-8.0, 1.0, COUNT) + 1e-9)
    x_dot, wish = rng.normal(size=(COUNT, m)), rng.normal(size=(COUNT, n))
    counts, square = s > 0.0, s**2 + damping[:, np.newaxis] ** 2
    gain = np.where(counts, s / np.where(counts, square, 1.0), 0.0)
    if damped:
        removed, width = np.minimum(s / (iv.FILTER * damping[:, np.newaxis]), 1.0), damping
    else:
        removed, width = 1.0 * counts, np.where(counts, s, size(J)[:, np.newaxis] + 1.0).min(axis=-1)
    inverse = V * gain[:, np.newaxis] @ transposed(U)
    N = np.eye(n) - V * removed[:, np.newaxis] @ transposed(V)
    blur, leak = SVD * size(J) / width**2, 2.0 * SVD * size(J) / (iv.FILTER * width) + 10.0 * EPS
    assert np.all(size(iv.null_space_projector(J, damping) - N) <= leak)
    if not damped:
        assert np.all(size(iv.pseudoinverse(J) - inverse) <= blur)
    velocities, moved = times(inverse, x_dot), times(N, wish)
    blur *= norm(x_dot)
    assert np.all(norm(iv.damped_least_squares(J, x_dot, damping) - velocities) <= blur)
    found = iv.redundant(J, x_dot, wish, damping)
    assert np.all(norm(found - velocities - moved) <= blur + leak * norm(wish) + EPS * norm(velocities))


def test_damping_sets_in_below_the_threshold_and_grows_to_the_maximum():
    threshold, maximum = np.array([1e-3, 0.3, 10.0]), np.array([[0.0], [0.1], [5.0]])
    share = np.linspace(0.0, 2.0, 21)[:, np.newaxis, np.newaxis]
    factor = iv.damping(share * threshold, threshold, maximum)
    expected = np.broadcast_to(maximum * np.maximum(1.0 - share, 0.0), factor.shape)
    np.testing.assert_allclose(factor, expected, rtol=1e-12, atol=1e-15)


# --- Manipulability


@shapes
def test_manipulability_is_the_volume_of_the_velocities(m, n):
    J = np.random.default_rng(8).normal(size=(COUNT, m, n))
    gram = np.linalg.det(J @ transposed(J)) * (m <= n)
    np.testing.assert_allclose(
        iv.manipulability(J), np.sqrt(np.maximum(gram, 0.0)), rtol=1e-7, atol=1e-7
    )
    J[:, -1] = J[:, 0] if m > 1 else 0.0
    np.testing.assert_allclose(iv.manipulability(J), 0.0, atol=1e-13)


@shapes
def test_ellipsoids_contain_what_unit_joint_velocities_and_torques_can_do(m, n):
    J = np.random.default_rng(9).normal(size=(100, m, n))
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


@shapes
def test_a_masked_task_minimises_the_weighted_error_and_omits_entries_of_weight_zero(m, n):
    rng = np.random.default_rng(10)
    J, x_dot, M = rng.normal(size=(m, n)), rng.normal(size=m), rng.uniform(0.5, 2.0, m)
    M[-1] *= m == 1
    roots = np.sqrt(M)
    expected = np.linalg.pinv(roots[:, np.newaxis] * J) @ (roots * x_dot)
    found = iv.damped_least_squares(*iv.masked_task(J, x_dot, M), 0.0)
    np.testing.assert_allclose(found, expected, atol=1e-12)


# --- Priorities. That each task is done as well as those before it allow, test_documents.py shows


def tasks_in_conflict(rng, n=4):
    """Return three tasks for each of many robots, the later ones nearly combinations of earlier ones."""
    jacobians = [rng.normal(size=(COUNT, 2, n))]
    jacobians[0][:, 1] = jacobians[0][:, 0] + 10.0 ** rng.uniform(-12.0, 0.0, (COUNT, 1))
    for m in (1, 2):
        before = jacobians[-1]
        other = 10.0 ** rng.uniform(-10.0, 0.0, (COUNT, 1, 1)) * rng.normal(size=(COUNT, m, n))
        jacobians.append(rng.normal(size=(COUNT, m, before.shape[1])) @ before + other)
    return [(J, rng.normal(size=(COUNT, J.shape[1]))) for J in jacobians]


def test_each_task_contributes_a_bounded_velocity_and_leaves_those_before_it_almost_alone():
    rng = np.random.default_rng(6)
    tasks, damping = tasks_in_conflict(rng), 10.0 ** rng.uniform(-3.0, 0.0, COUNT)
    before = np.zeros((COUNT, 4))
    for k, (J, x_dot) in enumerate(tasks):
        after = iv.prioritized(tasks[: k + 1], damping)
        missing = norm(x_dot - times(J, before))
        assert np.all(norm(after - before) <= missing / (2.0 * damping) * (1.0 + 1e-6) + 1e-12)
        for earlier, _ in tasks[:k]:
            moved = norm(times(earlier, after - before))
            assert np.all(moved <= iv.FILTER / 8.0 * missing + 1e-9 * norm(after - before))
        before = after


@pytest.mark.parametrize('damping', [0.0, 0.1])
def test_tasks_of_one_robot_and_of_many_broadcast(damping):
    rng = np.random.default_rng(14)
    many = rng.normal(size=(3, 1, 2, 4)), rng.normal(size=(2, 2))
    one = rng.normal(size=(1, 4)), rng.normal(size=1)
    together = iv.prioritized((one, many, one), damping)
    assert together.shape == (3, 2, 4)
    for i, j in np.ndindex(3, 2):
        alone = iv.prioritized((one, (many[0][i, 0], many[1][j]), one), damping)
        np.testing.assert_allclose(together[i, j], alone, atol=1e-10)


# --- Limits and weights


def test_limits_are_never_exceeded_and_all_tasks_keep_their_direction():
    rng = np.random.default_rng(10)
    tasks = [(rng.normal(size=(COUNT, m, 5)), rng.normal(size=(COUNT, m))) for m in (2, 2)]
    limits = 10.0 ** rng.uniform(-2.0, 2.0, (COUNT, 5))
    free, q_dot = iv.prioritized(tasks), iv.prioritized(tasks, max_velocity=limits)
    assert np.all(np.abs(q_dot) <= limits)
    # No slower than necessary.
    factor = np.minimum((limits / np.abs(free)).min(axis=1), 1.0)
    assert 0.01 < np.mean(factor == 1.0) < 0.99
    np.testing.assert_allclose(q_dot, factor[:, np.newaxis] * free, rtol=1e-12, atol=1e-14)
    assert np.array_equal(q_dot[factor == 1.0], free[factor == 1.0])
    # One limit for all joints, and none.
    assert iv.limit_velocity([3.0, -4.0], 2.0).tolist() == [1.5, -2.0]
    assert iv.limit_velocity([3.0, -4.0], [np.inf, 8.0]).tolist() == [3.0, -4.0]


@pytest.mark.parametrize(('m', 'n'), [(1, 3), (2, 3), (3, 4)])
def test_weighted_solutions_are_those_of_lagrange(m, n):
    """Minimise the weighted norm under the constraint, by its optimality conditions."""
    rng = np.random.default_rng(11)
    J, x_dot, wish = (rng.normal(size=(COUNT, *shape)) for shape in ((m, n), (m,), (n,)))
    weights = 10.0 ** rng.uniform(-1.5, 1.5, (COUNT, n))
    clear = np.linalg.svd(J, compute_uv=False).min(axis=1) > 0.1
    J, x_dot, wish, weights = J[clear], x_dot[clear], wish[clear], weights[clear]
    W = weights[:, :, np.newaxis] * np.eye(n)
    optimality = np.block([[W, transposed(J)], [J, np.zeros((len(J), m, m))]])

    def nearest(to):
        right = np.concatenate([weights * to, x_dot], axis=1)
        return np.linalg.solve(optimality, right[..., np.newaxis])[:, :n, 0]

    least = nearest(np.zeros_like(wish))
    N = iv.null_space_projector(J, weights=weights)
    damped = np.linalg.solve(transposed(J) @ J + 0.3**2 * W, transposed(J))
    for found, expected in (
        (times(iv.pseudoinverse(J, weights=weights), x_dot), least),
        (iv.damped_least_squares(J, x_dot, 0.0, weights=weights), least),
        (iv.damped_least_squares(J, x_dot, 0.3, weights=weights), times(damped, x_dot)),
        (iv.prioritized([(J, x_dot)], weights=weights), least),
        (iv.redundant(J, x_dot, wish, weights=weights), nearest(wish)),
        (least + times(N, wish), nearest(wish)),
        (W @ N, transposed(W @ N)),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)


# --- Bad input, besides what test_arguments.py shows

TASK = WIDE, X_DOT


@pytest.mark.parametrize(
    ('function', 'bad', 'message'),
    [
        (iv.null_space_projector, {'damping': -0.1}, r'damping must be zero or positive'),
        (iv.damped_least_squares, {'weights': [1.0, 0.0, 1.0]}, r'weights must be positive .* got 0\.0'),
        (iv.damping, {'manipulability': -1e-9}, r'manipulability must be zero or .* got -1e-09'),
        (iv.damping, {'threshold': 0.0}, r'threshold must be positive'),
        (iv.damping, {'maximum': -1.0}, r'maximum must be zero or positive'),
        (iv.masked_task, {'mask': [1.0, -1.0]}, r'mask must be zero or positive'),
        (iv.joint_limit_cost, {'upper': [-3.0, 1.0]}, r'upper must be above lower'),
        (iv.manipulability_gradient, {'jacobian': lambda q: np.eye(2)}, r'jacobian must return'),
        (iv.limit_velocity, {'max_velocity': [1.0, 0.0, 1.0]}, r'max_velocity must be positive, got'),
        (iv.prioritized, {'damping': -0.1}, r'damping must be zero or positive'),
        (iv.prioritized, {'cutoff': 0.0}, r'cutoff must be positive'),
        (iv.prioritized, {'cutoff': 1.0}, r'cutoff must be below 1'),
        (iv.prioritized, {'tasks': []}, r'tasks must contain at least one'),
        (iv.prioritized, {'tasks': [np.eye(3)]}, r'tasks must be pairs'),
        (iv.prioritized, {'tasks': [TASK, (np.eye(2), [1.0, 1.0])]}, r'tasks must all .*joints.*3, 2'),
        (iv.prioritized, {'tasks': [TASK, (WIDE, [1.0, np.nan])]}, r'x_dot of task 1 must be finite'),
        (iv.prioritized, {'tasks': [TASK, ([[1.0], [1.0, 2.0]], [1.0])]}, r'J of task 1 must be an arr'),
        (iv.prioritized, {'tasks': [(WIDE, [1.0])]}, r'x_dot of task 0 must have shape'),
    ],
)
def test_an_error_names_the_argument_what_was_got_and_what_is_allowed(function, bad, message):
    with pytest.raises(ValueError, match=f'^{message}'):
        function(**BROADCASTING[function] | bad)
