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

"""Exercise 1: the Jacobian of the wheels and its inverse.

jacobian(r, L)   J_w, shape (2, 2): [v, omega] = J_w [omega_R, omega_L]
inverse(r, L)    its inverse, shape (2, 2)
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.grading import HandIn, agree
from diffdrive_jacobian.kinematics import diff_drive

ROBOTS = [
    (0.033, 0.16),
    (0.05, 0.3),
    *np.random.default_rng(1).uniform([0.02, 0.1], [0.3, 0.8], (3, 2)).tolist(),
]
"""Wheel radius and separation of robots (m)."""


@pytest.mark.points(1)
def test_turning_in_place(hand_in: HandIn) -> None:
    """Wheels that turn against each other turn the robot in place."""
    for r, L in ROBOTS:
        v, omega = hand_in.array('jacobian', r, L, shape=(2, 2)) @ [1.0, -1.0]
        agree(v, 0.0, f'v with jacobian({r:.6g}, {L:.6g}) and wheels at 1 and -1 rad/s')
        assert omega > 0.0, f'omega must be positive if the right wheel goes ahead, got {omega:.6g}'


@pytest.mark.points(2)
def test_jacobian(hand_in: HandIn) -> None:
    """J_w maps the speeds of the right and the left wheel to v and omega."""
    for r, L in ROBOTS:
        expected = diff_drive.wheel_to_body_jacobian(r, L)
        agree(hand_in.call('jacobian', r, L), expected, f'jacobian({r:.6g}, {L:.6g})')


@pytest.mark.points(2)
def test_inverse(hand_in: HandIn) -> None:
    """Its inverse maps v and omega to the speeds of the wheels."""
    for r, L in ROBOTS:
        expected = diff_drive.body_to_wheel_jacobian(r, L)
        agree(hand_in.call('inverse', r, L), expected, f'inverse({r:.6g}, {L:.6g})')
