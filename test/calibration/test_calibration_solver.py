"""Cyclic reduction of block-tridiagonal systems, compared with dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.calibration.fit import solve_block_tridiagonal


@pytest.mark.parametrize('count', [1, 2, 3, 4, 5, 8, 13, 17])
def test_equals_dense_linear_algebra(count):
    random = np.random.default_rng(count)
    diagonal, upper = random.standard_normal((count, 3, 3)), random.standard_normal((count - 1, 3, 3))
    diagonal = diagonal @ np.swapaxes(diagonal, 1, 2) + 12.0 * np.eye(3)
    right = random.standard_normal((count, 3, 4))
    dense = np.zeros((3 * count, 3 * count))
    for i in range(count):
        dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = diagonal[i]
    for i in range(count - 1):
        dense[3 * i : 3 * i + 3, 3 * i + 3 : 3 * i + 6] = upper[i]
        dense[3 * i + 3 : 3 * i + 6, 3 * i : 3 * i + 3] = upper[i].T
    np.linalg.cholesky(dense)  # raises unless it is positive definite
    solution, logarithm = solve_block_tridiagonal(diagonal, upper, right)
    np.testing.assert_allclose(solution.reshape(-1, 4), np.linalg.solve(dense, right.reshape(-1, 4)))
    assert logarithm == pytest.approx(np.linalg.slogdet(dense)[1])
