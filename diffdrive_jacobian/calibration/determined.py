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

"""What drives do not determine: combinations of multipliers, in words."""

from __future__ import annotations

import numpy as np

from diffdrive_jacobian.calibration.model import Array

UNDETERMINED = 0.02
"""Standard deviation of a combination of multipliers beyond which it counts as not determined [-]."""
_WITHIN = 0.98
"""Part of a combination that must lie in the undetermined space."""
_TURN = 'turn in place or drive arcs, in both directions'
_STRAIGHT = 'drive straight'
COMBINATIONS: tuple[tuple[str, tuple[float, float, float], str], ...] = (
    ('the wheel separation', (0.0, 0.0, 1.0), _TURN),
    (
        'the common scale of radii and separation (only their ratio is determined)',
        (1.0, 1.0, 1.0),
        _STRAIGHT,
    ),
    ('the mean of the wheel radii', (1.0, 1.0, 0.0), _STRAIGHT),
    ('the difference of the wheel radii', (1.0, -1.0, 0.0), f'{_STRAIGHT}, further'),
    ('the radius of the left wheel', (1.0, 0.0, 0.0), f'{_STRAIGHT}, with both wheels turning'),
    ('the radius of the right wheel', (0.0, 1.0, 0.0), f'{_STRAIGHT}, with both wheels turning'),
)
"""Name, direction in the space of the logarithms of the multipliers (left, right, separation), and what
drive determines it."""


def undetermined(covariance: Array) -> list[tuple[str, str]]:
    """Return the combinations of multipliers that are not determined, and what drive determines them.

    `covariance` is that of the logarithms of the multipliers, shape (3, 3).
    """
    variances, directions = np.linalg.eigh(covariance)
    space = directions[:, variances > UNDETERMINED**2]
    dimension, all_of_them = space.shape[1], f'{_STRAIGHT}, and {_TURN}'
    if dimension == 3:
        return [('any of the multipliers', all_of_them)]
    found: list[tuple[str, str]] = []
    spanned = np.zeros((3, 0))
    others = [('', tuple(direction), all_of_them) for direction in space.T.tolist()]
    for name, direction, remedy in (*COMBINATIONS, *others):
        unit = np.array(direction) / np.linalg.norm(direction)
        if np.linalg.norm(space.T @ unit) < _WITHIN or spanned.shape[1] == dimension:
            continue
        rest = unit - spanned @ (spanned.T @ unit)
        if np.linalg.norm(rest) > 0.5:
            rest /= np.linalg.norm(rest)
            spanned = np.column_stack([spanned, rest])
            left, right, separation = rest.tolist()
            parts = f'{left:+.2f} left radius, {right:+.2f} right radius, {separation:+.2f} separation'
            found.append((name or f'the combination {parts}', remedy))
    return found
