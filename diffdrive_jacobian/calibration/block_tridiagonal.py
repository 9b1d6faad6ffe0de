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

"""Solves block-tridiagonal equations by cyclic reduction, in a few NumPy calls for each level.

A level eliminates every other block, all of them at once, and half of the blocks remain. So n blocks
take log2(n) levels and a time proportional to n.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def solve_block_tridiagonal(diagonal: Array, upper: Array, right: Array) -> tuple[Array, float]:
    """Return the solution x of `A x = b` and log det A, for A positive definite.

    The blocks A[i, i] are `diagonal`, shape (n, 3, 3), the blocks A[i, i + 1] are `upper`, and b and x
    have shape (n, 3, m); m may be 0.
    """
    levels = []
    logarithm = 0.0
    while len(diagonal) > 1:
        count = len(diagonal)
        if count % 2 == 0:
            # An uncoupled block at the end, which is dropped below, gives each odd block two neighbours.
            diagonal = np.concatenate([diagonal, np.eye(3)[None]])
            upper = np.concatenate([upper, np.zeros((1, 3, 3))])
            right = np.concatenate([right, np.zeros((1, *right.shape[1:]))])
        # Of the odd blocks: those to the left and to the right in their row, and above and below.
        above, right_of = upper[0::2], upper[1::2]
        left_of, below = np.swapaxes(above, 1, 2), np.swapaxes(right_of, 1, 2)
        odd = diagonal[1::2]
        logarithm += float(np.linalg.slogdet(odd)[1].sum())
        inverse = np.linalg.inv(odd)
        to_before, to_after = inverse @ left_of, inverse @ right_of
        value = inverse @ right[1::2]
        levels.append((count, to_before, to_after, value))
        next_diagonal, next_right = diagonal[0::2].copy(), right[0::2].copy()
        next_diagonal[:-1] -= above @ to_before
        next_diagonal[1:] -= below @ to_after
        next_right[:-1] -= above @ value
        next_right[1:] -= below @ value
        kept = (count + 1) // 2
        upper = (-above @ to_after)[: kept - 1]
        diagonal, right = next_diagonal[:kept], next_right[:kept]
    logarithm += float(np.linalg.slogdet(diagonal[0])[1])
    solution = np.linalg.inv(diagonal) @ right
    for count, to_before, to_after, value in reversed(levels):
        whole = np.zeros((2 * len(value) + 1, *solution.shape[1:]))
        whole[0 : 2 * len(solution) : 2] = solution
        whole[1::2] = value - to_before @ whole[0:-1:2] - to_after @ whole[2::2]
        solution = whole[:count]
    return solution, logarithm
