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

"""Jacobians of any function of generalized coordinates, by central differences.

Generalized coordinates q are independent variables that describe the configuration of a robot. Every
other quantity is a function r(q) of them, and its velocity is `r_dot = J(q) q_dot` with `J = dr/dq`.

Source: document C, "Generalized coordinates" and "Jacobians"; document D, 2.1; doc/mathematics.md,
"Manipulators".
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.numerics.checks import array
from diffdrive_jacobian.numerics.formula import Array

__all__ = ['numerical_jacobian']

STEP = float(np.finfo(np.float64).eps) ** (1.0 / 3.0)
"""Step of central differences, at which rounding and truncation errors are of the same size."""


def numerical_jacobian(
    r: Callable[[Array], ArrayLike],
    q: ArrayLike,
    *,
    difference: Callable[[Array, Array], ArrayLike] = np.subtract,
) -> Array:
    """Differentiate a function of generalized coordinates: `J_ij = dr_i / dq_j` (C, D).

    The result is accurate to about ten digits where r is smooth. r maps coordinates of shape (n,) to a
    vector of shape (m,). It is called 2 n times for each q, with one q at a time, so it need not
    broadcast. `difference` subtracts two values of r: `inverse_kinematics.pose_difference` is for planar
    poses, whose headings jump at pi.

    For q of shape (..., n), in any units, the Jacobians have the shape (..., m, n), in the units of r
    over those of q. A q or a value of r that is not finite or of a wrong shape raises ValueError.
    """
    q = array('q', q, 'n')
    J_transposed: list[Array] = []
    for one in q.reshape(-1, q.shape[-1]):
        steps = STEP * np.diag(np.maximum(1.0, np.abs(one)))
        above, below = one + steps, one - steps
        change = difference(*np.split(_values(r, [*above, *below]), 2))
        # The distance that is left after rounding.
        width = np.diag(above - below)
        J_transposed.append(array('difference of r', change, 'm') / width[:, np.newaxis])
    return np.swapaxes(np.reshape(J_transposed, (*q.shape, -1)), -1, -2)


def _values(r: Callable[[Array], ArrayLike], q: list[Array]) -> Array:
    """Return the values of r, shape (k, m)."""
    values = [array('r(q)', r(one), 'm') for one in q]
    shapes = {value.shape for value in values}
    if len(shapes) > 1 or values[0].ndim != 1:
        raise ValueError(f'r(q) must have one shape (m,), got {", ".join(map(str, shapes))}')
    return np.array(values)
