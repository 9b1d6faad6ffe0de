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

"""Exercise 7: the null space of an arm with more joints than the task needs.

projector(J)                   I - J^+ J, shape (n, n)
velocities(J, task, wanted)    joint velocities that do the task J dq = task, and are as near as
                               possible to the wanted ones
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.grading import HandIn, agree

RANDOM = np.random.default_rng(8)
JACOBIANS = [RANDOM.normal(size=(2, n)) for n in (3, 4, 5)]


@pytest.mark.points(2)
def test_projector(hand_in: HandIn) -> None:
    """What it projects does not move the tip, and what does not move the tip stays."""
    for J in JACOBIANS:
        expected = np.eye(J.shape[1]) - np.linalg.pinv(J) @ J
        agree(hand_in.call('projector', J), expected, f'projector of a Jacobian of shape {J.shape}')


@pytest.mark.points(2)
def test_task(hand_in: HandIn) -> None:
    """The task is done exactly, whatever else is wanted."""
    for J in JACOBIANS:
        task, wanted = RANDOM.normal(size=2), RANDOM.normal(size=J.shape[1])
        found = hand_in.array('velocities', J, task, wanted, shape=(J.shape[1],))
        agree(J @ found, task, 'J times the velocities')


@pytest.mark.points(1)
def test_wanted(hand_in: HandIn) -> None:
    """Of all velocities that do the task, these are nearest to the wanted ones."""
    for J in JACOBIANS:
        task, wanted = RANDOM.normal(size=2), RANDOM.normal(size=J.shape[1])
        expected = wanted + np.linalg.pinv(J) @ (task - J @ wanted)
        agree(hand_in.call('velocities', J, task, wanted), expected, 'velocities')
