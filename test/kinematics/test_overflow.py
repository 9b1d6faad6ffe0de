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

"""Inverse velocity with numbers near the largest and smallest ones: the true result or a ValueError.

An infinite matrix never comes to LAPACK, which may not terminate with it, and what is too large is not
taken for zero. That other extreme arguments are named, test_arguments.py shows.
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.control import resolved_rate
from diffdrive_jacobian.kinematics import inverse_velocity as iv

J3 = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 10.0]])
HUGE = 1.7e308
NEAR_MAX = HUGE * np.array([[1.0, -1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, 1.0, 1.0]])
UNIT, STILL = np.eye(2), [0.0, 0.0]


@pytest.fixture(autouse=True)
def only_finite_matrices(monkeypatch):
    """Let a non-finite matrix fail the test, where LAPACK would hang."""
    decompose = np.linalg.svd

    def svd(matrix, *arguments, **options):
        assert np.isfinite(matrix).all()
        return decompose(matrix, *arguments, **options)

    monkeypatch.setattr(np.linalg, 'svd', svd)


@pytest.mark.parametrize('scale', [1e-140, 1e150])
@pytest.mark.parametrize('rows', [1, 2, 3])
def test_the_units_of_a_jacobian_do_not_matter(rows, scale):
    J, x_dot, wish = J3[:rows], np.ones(rows), np.array([1.0, -2.0, 0.5])

    def results(size):
        """The same joint velocities, in units in which the Jacobian has this size."""
        huge, damping = size * J, 0.1 * size
        return [
            iv.pseudoinverse(huge) * size,
            iv.null_space_projector(huge, damping),
            iv.damped_least_squares(huge, x_dot, damping) * size,
            iv.redundant(huge, size * x_dot, wish, damping),
            iv.prioritized([(huge, x_dot)], damping) * size,
        ]

    for result, usual in zip(results(scale), results(1.0), strict=True):
        np.testing.assert_allclose(result, usual, rtol=1e-9, atol=1e-12)


def test_singular_values_that_differ_by_hundreds_of_decades_keep_their_digits():
    J = np.diag([1.0, 1e-140])
    for damping, expected in ((1e-300, [1.0, 1e140]), (1e-140, [1.0, 5e139])):
        found = iv.damped_least_squares(J, [1.0, 1.0], damping)
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert iv.manipulability(np.diag([1e150, 1e-150])) == pytest.approx(1.0)


@pytest.mark.parametrize(
    'call',
    [
        lambda: iv.pseudoinverse(NEAR_MAX),
        lambda: iv.null_space_projector(NEAR_MAX[np.newaxis]),
        lambda: iv.manipulability(NEAR_MAX),
        lambda: iv.pseudoinverse(J3 * 1e300, weights=[1e-20, 1.0, 1.0]),
        lambda: iv.null_space_projector(J3 * 1e300, 0.1, weights=[1e-20, 1.0, 1.0]),
        lambda: iv.damped_least_squares([J3 * 1e300] * 2, np.ones(3), 0.1, weights=[1e-20, 1.0, 1.0]),
        lambda: iv.prioritized([(1e-140 * J3[:1], [1e300])], max_velocity=1.0),
        lambda: iv.prioritized([([[1e-290]], [1e200])], weights=[1e-300]),
        lambda: iv.damped_least_squares([[1e-290]], [1e200], 0.0, weights=[1e-300]),
        lambda: iv.redundant(J3[:2], [1.0, 1.0], [HUGE, 0.0, 0.0], weights=[1e10, 1.0, 1.0]),
        lambda: resolved_rate(UNIT, [-HUGE, 0.0], [HUGE, 0.0], STILL, 1e10, max_correction=2.0),
        lambda: resolved_rate(UNIT, STILL, [3e100, 4e100], STILL, 1.0, max_correction=1e-250),
        lambda: resolved_rate(UNIT * 1e-140, STILL, [1.0, 0.0], [1e200, 0.0], 1.0, max_velocity=1.0),
    ],
)
def test_matrices_and_velocities_that_overflow_raise_an_error(call):
    with pytest.raises(ValueError, match='finite'):
        call()


def test_an_error_names_the_task_whose_jacobian_overflows():
    tasks = [(J3[:1], [1.0]), (J3[1:] * 1e300, [1.0, 1.0])]
    with pytest.raises(ValueError, match='J of task 1 and weights must be finite'):
        iv.prioritized(tasks, weights=[1e-20, 1.0, 1.0])


@pytest.mark.parametrize('function', [iv.joint_limit_cost, iv.joint_limit_gradient])
def test_joint_limits_raise_an_error_where_their_range_or_the_result_overflows(function):
    with pytest.raises(ValueError, match='upper - lower must be finite, got inf at index 0'):
        function([HUGE, 1.0], [-HUGE, -1.0], [HUGE, 1.0])
    with pytest.raises(ValueError, match=r'^joint_limit_\w+ of q, lower and upper must be finite'):
        function([HUGE], [-1e-300], [1e-300])
    # The middle of these overflows only if they are added first.
    assert function([1.6e308], [1.5e308], [1.7e308]) == pytest.approx(0.0, abs=1e-20)
