"""Inverse velocity, control and secondary tasks with numbers near the largest and smallest ones.

A call has the true result or raises ValueError. It never hands an infinite matrix to LAPACK, which may
not terminate with it, it never warns, and what is too large is not taken for zero.
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.control import resolved_rate
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
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
    with pytest.raises(ValueError, match=r'J, .*weights must give a finite result|J and weights must'):
        call(J, np.ones(rows), [1e-20, 1.0, 1.0])


def test_the_error_names_the_task_whose_weighted_jacobian_overflows():
    tasks = [(J3[:1], [1.0]), (J3[1:] * 1e300, [1.0, 1.0])]
    with pytest.raises(ValueError, match='J of task 1 and weights must be finite'):
        iv.prioritized(tasks, weights=[1e-20, 1.0, 1.0])


def true_or_refused(call, expected, **close):
    """Require the true result, or an error where it or what leads to it overflows."""
    try:
        result = call()
    except ValueError as error:
        assert 'finite' in str(error)  # noqa: PT017
        return False
    np.testing.assert_allclose(result, expected, **{'rtol': 1e-9} | close)
    return True


SCALES = [10.0**power for power in (-140, -100, 100, 150, 153, 155, 200, 300, 307)]


@pytest.mark.parametrize('scale', SCALES)
@pytest.mark.parametrize('rows', [1, 2, 3])
def test_jacobians_of_any_size_are_inverted_or_refused(rows, scale):
    J, x_dot, wish = J3[:rows], np.ones(rows), np.array([1.0, -2.0, 0.5])
    tasks = [(J[:1], x_dot[:1]), (J[1:], x_dot[1:])][: 2 if rows > 1 else 1]
    scaled = [(scale * task, velocity) for task, velocity in tasks]
    calls = [
        (lambda: iv.pseudoinverse(scale * J) * scale, iv.pseudoinverse(J)),
        (lambda: iv.null_space_projector(scale * J, 0.1 * scale), iv.null_space_projector(J, 0.1)),
        (
            lambda: iv.damped_least_squares(scale * J, x_dot, 0.1 * scale) * scale,
            iv.damped_least_squares(J, x_dot, 0.1),
        ),
        (
            lambda: iv.redundant(scale * J, scale * x_dot, wish, 0.1 * scale),
            iv.redundant(J, x_dot, wish, 0.1),
        ),
        (lambda: iv.prioritized(scaled, 0.1 * scale) * scale, iv.prioritized(tasks, 0.1)),
        (lambda: iv.prioritized(scaled) * scale, iv.prioritized(tasks)),
    ]
    for call, expected in calls:
        accepted = true_or_refused(call, expected, atol=1e-12)
        assert accepted or scale > 1e152


@pytest.mark.parametrize('scale', [1e-305, 1e-200, 1e-151])
@pytest.mark.parametrize('rows', [1, 2, 3])
def test_jacobians_whose_squares_underflow_count_as_zero(rows, scale):
    J, x_dot, wish = scale * J3[:rows] / 10.0, np.ones(rows), np.array([1.0, -2.0, 0.5])
    for damping in (0.0, 1e-3):
        assert not iv.damped_least_squares(J, x_dot, damping).any()
        np.testing.assert_array_equal(iv.redundant(J, x_dot, wish, damping), wish)
    assert not iv.pseudoinverse(J).any()


@pytest.mark.parametrize('batch', [(), (2,)])
def test_a_task_near_the_largest_number_is_refused(batch):
    tasks = [(J3[:1], [1.0]), (np.broadcast_to(NEAR_MAX, (*batch, 3, 3)), ONES)]
    with pytest.raises(ValueError, match='must be finite'):
        iv.prioritized(tasks)
    for call in (iv.pseudoinverse, iv.null_space_projector, iv.manipulability):
        with pytest.raises(ValueError, match='must give a finite result, but it overflows'):
            call(tasks[1][0])


def test_prioritized_raises_an_error_where_joint_velocities_overflow():
    with pytest.raises(ValueError, match='tasks, damping and weights must be finite'):
        iv.prioritized([(1e-140 * J3[:1], [1e300])], max_velocity=1.0)
    with pytest.raises(ValueError, match='tasks, damping and weights must be finite'):
        iv.prioritized([([[1e-290]], [1e200])], weights=[1e-300])


def test_weights_whose_results_overflow():
    for call in (
        lambda: iv.pseudoinverse([[1e-310]], weights=[5e-324]),
        lambda: iv.damped_least_squares([[1e-290]], [1e200], 0.0, weights=[1e-300]),
        lambda: iv.redundant(J3[:2], [1.0, 1.0], [HUGE, 0.0, 0.0], weights=[1e10, 1.0, 1.0]),
    ):
        with pytest.raises(ValueError, match='weights must give a finite result, but it overflows'):
            call()


@pytest.mark.parametrize(
    ('J', 'expected'),
    [
        (np.diag([1e200, 1e200, 1e-200]), 1e200),
        (np.diag([1e-100, 1e100, 1e100, 1e-100]), 1.0),
        (np.diag([1e150, 1e-150]), 1.0),
        (np.diag([1e-200, 1e-200, 1e-200]), 0.0),
        (1e100 * J3, 3e300),
        (np.diag([1e120, 1e120, 1e120]), np.inf),
        (np.diag([1e150, 1e150, 1e150, 1e-150]), 1e300),
        (np.zeros((3, 4)), 0.0),
    ],
)
def test_manipulability_is_right_or_refused(J, expected):
    for call in (lambda: iv.manipulability(J), lambda: iv.manipulability([J, np.eye(*J.shape)])[0]):
        true_or_refused(call, expected, rtol=1e-12)
    assert iv.manipulability(np.diag([1e150, 1e-150])) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ('q_dot', 'most', 'expected'),
    [
        ([1e300], [1e-300], [1e-300]),
        ([1e300, -5e299, 0.0], 1e-300, [1e-300, -5e-301, 0.0]),
        ([1e300, 1.0], [1e-300, np.inf], [1e-300, 0.0]),
        ([-HUGE, HUGE], [5e-324, 1.0], [-5e-324, 5e-324]),
        ([[1e300], [3.0]], [1e-300], [[1e-300], [1e-300]]),
        ([1e200, 3.0], 1.0, [1.0, 3e-200]),
        ([1e-200, 3e-200], 1e-250, [1e-250 / 3.0, 1e-250]),
    ],
)
def test_velocities_far_beyond_their_limits_are_limited_or_refused(q_dot, most, expected):
    possible = np.max(np.abs(q_dot)) < 1e299
    limited = true_or_refused(lambda: iv.limit_velocity(q_dot, most), expected, rtol=1e-14, atol=0.0)
    assert limited == possible


def test_joint_limits_whose_range_overflows_are_refused():
    lower, upper = [-HUGE, -1.0], [HUGE, 1.0]
    for function in (iv.joint_limit_cost, iv.joint_limit_gradient):
        with pytest.raises(ValueError, match='upper - lower must be finite, got inf at index 0'):
            function([HUGE, 1.0], lower, upper)
    # The middle of these overflows only if they are added first.
    assert iv.joint_limit_cost([1.6e308], [1.5e308], [1.7e308]) == pytest.approx(0.0, abs=1e-20)


@pytest.mark.parametrize('function', [iv.joint_limit_cost, iv.joint_limit_gradient])
def test_joint_limits_raise_an_error_where_the_result_overflows(function):
    with pytest.raises(
        ValueError, match=r'^joint_limit_\w+ of q, lower and upper must be finite, got inf'
    ):
        function([HUGE], [-1e-300], [1e-300])


def test_a_correction_that_overflows_is_refused():
    for x, x_desired, gain, most in (
        ([-HUGE, 0.0], [HUGE, 0.0], 1e10, 2.0),
        ([0.0, 0.0], [3e200, 4e200], 1.0, 0.5),
        ([0.0, 0.0], [3e200, 4e200], 1.0, np.inf),
        ([0.0, 0.0], [3e100, 4e100], 1.0, 1e-250),
    ):
        with pytest.raises(ValueError, match='must give a finite result, but it overflows'):
            resolved_rate(np.eye(2), x, x_desired, [0.0, 0.0], gain, max_correction=most)
    slow = resolved_rate(np.eye(2), [0.0, 0.0], [3e150, 4e150], [0.0, 0.0], 1.0, max_correction=0.5)
    np.testing.assert_allclose(slow, [0.3, 0.4], rtol=1e-12)


def test_resolved_rate_raises_an_error_where_a_velocity_overflows():
    for J, x, x_desired, x_dot in (
        (np.eye(2), [-HUGE, 0.0], [HUGE, 0.0], [0.0, 0.0]),
        (np.eye(2) * 1e-140, [0.0, 0.0], [1.0, 0.0], [1e200, 0.0]),
    ):
        for most in (None, 1.0):
            with pytest.raises(ValueError, match='must give a finite result, but it overflows'):
                resolved_rate(J, x, x_desired, x_dot, 1.0, max_velocity=most)


@pytest.mark.parametrize('line', [None, 'line', 1.0])
def test_a_line_of_another_class_raises_an_error(line):
    with pytest.raises(ValueError, match=r'line must be a control\.StraightLine, got'):
        track_line(PlanarArm([1.0, 1.0]), [0.1, 0.2], line)
