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

"""Exercise 6: damping near a singularity, with two joints of a planar arm.

jacobian(q, lengths)      of the tip of a planar arm with joint angles q, shape (2, n)
damped_inverse(J, damping)   J^T (J J^T + damping^2 I)^-1, shape (n, m)
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.grading import HandIn, agree
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

LENGTHS = [0.5, 0.4]


@pytest.mark.points(2)
def test_jacobian(hand_in: HandIn) -> None:
    """Column k is how the tip moves if joint k turns alone."""
    for lengths in (LENGTHS, [0.3, 0.3, 0.2]):
        arm = PlanarArm(lengths)
        for q in np.random.default_rng(6).uniform(-3.0, 3.0, (4, len(lengths))):
            expected = arm.jacobian(q)[:2]
            agree(
                hand_in.call('jacobian', q, lengths),
                expected,
                f'jacobian({np.round(q, 3).tolist()}, {lengths})',
            )


@pytest.mark.points(2)
def test_damped_inverse(hand_in: HandIn) -> None:
    """It is the inverse, as long as the damping is small against the singular values."""
    for damping in (0.01, 0.3):
        for J in np.random.default_rng(7).normal(size=(4, 2, 3)):
            expected = J.T @ np.linalg.inv(J @ J.T + damping**2 * np.eye(2))
            agree(
                hand_in.call('damped_inverse', J, damping), expected, f'damped_inverse(J, {damping:g})'
            )


@pytest.mark.points(1)
def test_bounded(hand_in: HandIn) -> None:
    """Near the stretched arm joints are as fast as 1 / (2 damping) times the tip, and no faster."""
    largest = 0.0
    for bend in np.linspace(0.6, 0.0, 25):
        J = np.asarray(PlanarArm(LENGTHS).jacobian([0.3, bend])[:2])
        inverse = hand_in.array('damped_inverse', J, 0.1, shape=(2, 2))
        largest = max(largest, float(np.linalg.norm(inverse, 2)))
    assert 4.9 < largest <= 5.0 + 1e-9, (
        f'the largest gain must rise to 1 / (2 damping) = 5 and no further, got {largest:.6g}'
    )
    stretched = float(np.linalg.norm(inverse, 2))
    assert stretched < 1.1, f'of the stretched arm the largest gain must be about 1, got {stretched:.6g}'
