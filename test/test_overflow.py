"""Inverse velocity, control and secondary tasks with numbers near the largest and smallest ones.

A call has the true result, infinity where that is documented, or raises ValueError. It never hands an
infinite matrix to LAPACK, which may not terminate with it, and it never warns.
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.control import resolved_rate
from diffdrive_jacobian.kinematics import PlanarArm
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.simulation import track_line

pytestmark = pytest.mark.filterwarnings('error')
J3 = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 10.0]])
HUGE = 1.7e308
NEAR_MAX = HUGE * np.array([[1.0, -1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, 1.0, 1.0]])
ONES = [1.0, 1.0, 1.0]


@pytest.fixture(autouse=True)
def only_finite_matrices(monkeypatch):
    """Let a non-finite matrix fail the test, where LAPACK would hang."""
    decompose = np.linalg.svd

    def svd(matrix, *arguments, **options):
        assert np.isfinite(matrix).all()
        return decompose(matrix, *arguments, **options)

    monkeypatch.setattr(np.linalg, 'svd', svd)


@pytest.mark.parametrize('rows', [1, 2, 3])
@pytest.mark.parametrize('batch', [(), (2,)])
@pytest.mark.parametrize(
    'call',
    [
        lambda J, x_dot, w: iv.pseudoinverse(J, weights=w),
        lambda J, x_dot, w: iv.null_space_projector(J, weights=w),
        lambda J, x_dot, w: iv.null_space_projector(J, 0.1, weights=w),
        lambda J, x_dot, w: iv.damped_least_squares(J, x_dot, 0.1, weights=w),
        lambda J, x_dot, w: iv.redundant(J, x_dot, ONES, 0.1, weights=w),
        lambda J, x_dot, w: resolved_rate(J, x_dot, x_dot, x_dot, 1.0, 0.1, weights=w),
    ],
)
def test_a_weighted_jacobian_that_overflows_raises_an_error(call, batch, rows):
    J = np.broadcast_to(J3[:rows] * 1e300, (*batch, rows, 3))
    with pytest.raises(ValueError, match='J and weights must give a finite product, but it overflows'):
        call(J, np.ones(rows), [1e-20, 1.0, 1.0])


def test_the_error_names_the_task_whose_weighted_jacobian_overflows():
    tasks = [(J3[:1], [1.0]), (J3[1:] * 1e300, [1.0, 1.0])]
    with pytest.raises(ValueError, match='J of task 1 and weights must give a finite product'):
        iv.prioritized(tasks, weights=[1e-20, 1.0, 1.0])


@pytest.mark.parametrize('batch', [(), (2,)])
def test_a_second_task_near_the_largest_number_has_its_least_squares_solution(batch):
    # Minimise |J_2 q_dot| subject to q_dot_1 + 2 q_dot_2 + 3 q_dot_3 = 1.
    tasks = [(J3[:1], [1.0]), (np.broadcast_to(NEAR_MAX, (*batch, 3, 3)), ONES)]
    expected = np.broadcast_to([0.14, 0.16, 0.18], (*batch, 3))
    np.testing.assert_allclose(iv.prioritized(tasks), expected, rtol=1e-12)


def test_task_velocities_near_the_largest_number_do_not_overflow_in_between():
    tasks = [(1e10 * J3[:2], [HUGE, HUGE]), (1e10 * J3[2:], [HUGE])]
    expected = np.linalg.solve(J3, ONES) * (HUGE / 1e10)
    np.testing.assert_allclose(iv.prioritized(tasks), expected, rtol=1e-9, atol=1e284)


def test_prioritized_raises_an_error_where_joint_velocities_overflow():
    with pytest.raises(ValueError, match='tasks and damping must give a finite result'):
        iv.prioritized([(1e-300 * J3[:1], [1e300])], max_velocity=1.0)
    with pytest.raises(ValueError, match='tasks, damping and weights must give a finite result'):
        iv.prioritized([([[1e-150]], [1e200])], weights=[1e-300])


def test_inverses_and_projectors_near_the_largest_number():
    inverse = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [1.0, 0.0, 1.0]]) / 2.0
    # Its singular values are 2, 2 and 1, times HUGE.
    np.testing.assert_allclose(iv.pseudoinverse(NEAR_MAX) * HUGE, inverse, atol=1e-12)
    flat = np.full((2, 3), HUGE)  # The singular value sqrt(6) HUGE overflows.
    projector = np.eye(3) - 1.0 / 3.0
    for damping in (0.0, HUGE / 10.0):
        np.testing.assert_allclose(iv.null_space_projector(flat, damping), projector, atol=1e-12)
        small = 0.0 if damping == 0.0 else 0.1
        batch = iv.null_space_projector(np.array([flat, flat / HUGE]), [damping, small])
        np.testing.assert_allclose(batch, [projector, projector], atol=1e-12)


def test_weights_whose_results_overflow():
    assert iv.pseudoinverse([[1e-310]], weights=[1e-20]) == np.inf
    assert iv.damped_least_squares([[1e-150]], [1e200], 0.0, weights=[1e-300]) == np.inf
    with pytest.raises(ValueError, match='q_dot_0 and weights must give a finite product'):
        iv.redundant(J3[:2], [1.0, 1.0], [HUGE, 0.0, 0.0], weights=[1e10, 1.0, 1.0])


@pytest.mark.parametrize(
    ('J', 'expected'),
    [
        (np.diag([1e200, 1e200, 1e-200]), 1e200),
        (np.diag([1e-200, 1e200, 1e200, 1e-200]), 1.0),
        (np.diag([1e200, 1e-200]), 1.0),
        (np.diag([1e-200, 1e-200, 1e-200]), 0.0),
        (1e100 * J3, 3e300),
        (np.diag([HUGE, HUGE, 1e-308]), HUGE * (HUGE * 1e-308)),
        (np.diag([1e200, 1e200, 1.0]), np.inf),
        (np.zeros((3, 4)), 0.0),
    ],
)
def test_manipulability_does_not_overflow_in_between(J, expected):
    np.testing.assert_allclose(iv.manipulability(J), expected, rtol=1e-12)
    ordinary = np.eye(*J.shape)
    np.testing.assert_allclose(iv.manipulability(np.array([J, ordinary])), [expected, 1.0], rtol=1e-12)


@pytest.mark.parametrize(
    ('q_dot', 'most', 'expected'),
    [
        ([1e300], [1e-300], [1e-300]),
        ([1e300, -5e299, 0.0], 1e-300, [1e-300, -5e-301, 0.0]),
        ([1e300, 1.0], [1e-300, np.inf], [1e-300, 0.0]),
        ([-HUGE, HUGE], [5e-324, 1.0], [-5e-324, 5e-324]),
        ([[1e300], [3.0]], [1e-300], [[1e-300], [1e-300]]),
    ],
)
def test_velocities_that_exceed_their_limits_by_more_than_the_largest_number(q_dot, most, expected):
    limited = iv.limit_velocity(q_dot, most)
    np.testing.assert_allclose(limited, expected, rtol=1e-14)
    assert (np.abs(limited) <= most).all()


def test_joint_limits_whose_range_overflows():
    lower, upper = [-HUGE, -1.0], [HUGE, 1.0]
    assert iv.joint_limit_cost([HUGE, 1.0], lower, upper) == pytest.approx(1.0 / 8.0)
    gradient = iv.joint_limit_gradient([HUGE, 1.0], lower, upper)
    np.testing.assert_allclose(gradient, [0.125 / HUGE, 0.125], rtol=1e-12)
    # The middle of these overflows only if they are added first.
    assert iv.joint_limit_cost([1.6e308], [1.5e308], [1.7e308]) == pytest.approx(0.0, abs=1e-20)


@pytest.mark.parametrize('function', [iv.joint_limit_cost, iv.joint_limit_gradient])
def test_joint_limits_raise_an_error_where_the_result_overflows(function):
    with pytest.raises(
        ValueError, match=r'q, lower and upper must give a finite (cost|gradient), but it'
    ):
        function([HUGE], [-1e-300], [1e-300])


def test_a_correction_that_overflows_is_limited_along_its_direction():
    x_dot = resolved_rate(
        *(np.eye(2), [-HUGE, 0.0], [HUGE, 0.0], [0.0, 0.0], 1e10),
        max_correction=2.0,
    )
    np.testing.assert_allclose(x_dot, [2.0, 0.0], rtol=1e-12)
    # Its norm, or how often it contains the limit, overflows.
    for most in (0.5, 1e-200):
        slow = resolved_rate(np.eye(2), [0.0, 0.0], [3e200, 4e200], [0.0, 0.0], 1.0, max_correction=most)
        np.testing.assert_allclose(slow, [0.6 * most, 0.8 * most], rtol=1e-12)
    unlimited = resolved_rate(np.eye(2), [0.0, 0.0], [3e200, 4e200], [0.0, 0.0], 1.0)
    np.testing.assert_allclose(unlimited, [3e200, 4e200], rtol=1e-12)


def test_resolved_rate_raises_an_error_where_a_velocity_overflows():
    with pytest.raises(ValueError, match='x, x_desired, x_dot_desired and gain must give a finite'):
        resolved_rate(np.eye(2), [-HUGE, 0.0], [HUGE, 0.0], [0.0, 0.0], 1.0)
    with pytest.raises(ValueError, match='must give a finite joint velocity, but it overflows'):
        resolved_rate(np.eye(2) * 1e-300, [0.0, 0.0], [1e200, 0.0], [0.0, 0.0], 1.0, max_velocity=1.0)


@pytest.mark.parametrize('line', [None, 'line', 1.0])
def test_a_line_of_another_class_raises_an_error(line):
    with pytest.raises(ValueError, match=r'line must be a control\.StraightLine, got'):
        track_line(PlanarArm([1.0, 1.0]), [0.1, 0.2], line)
