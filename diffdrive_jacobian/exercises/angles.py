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

"""Exercise 2: angles that wrap.

wrap(angle)                 the same direction in [-pi, pi] (rad); of a number or an array
bearing_error(pose, goal)   from the heading of [x, y, theta] to the direction of [x, y] (rad)
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from diffdrive_jacobian.grading import HandIn, agree
from diffdrive_jacobian.kinematics.se2 import wrap_angle


@pytest.mark.points(2)
def test_wrap(hand_in: HandIn) -> None:
    """Angles are wrapped into [-pi, pi], whatever the number of turns."""
    for angle in (0.0, 1.0, -1.0, 3.0, 3.5, -3.5, 6.0, -7.0, 100.0, -1000.5):
        agree(hand_in.call('wrap', angle), wrap_angle(angle), f'wrap({angle:g})')
    # Both are right there.
    for angle in (math.pi, -math.pi, 3.0 * math.pi):
        agree(abs(hand_in.array('wrap', angle, shape=())), math.pi, f'the size of wrap({angle:.6g})')


@pytest.mark.points(1)
def test_arrays(hand_in: HandIn) -> None:
    """An array is wrapped element by element."""
    angles = np.linspace(-20.0, 20.0, 41).reshape(-1, 1)
    agree(hand_in.call('wrap', angles), wrap_angle(angles), 'wrap of an array')


@pytest.mark.points(2)
def test_bearing_error(hand_in: HandIn) -> None:
    """The robot turns the shorter way to the goal, also across the direction of -x."""
    for pose, goal in (
        ([0.0, 0.0, 0.0], [1.0, 1.0]),
        ([1.0, 2.0, 3.0], [0.0, 1.5]),
        ([0.0, 0.0, -3.0], [-1.0, 0.1]),
        ([2.0, -1.0, 9.0], [3.0, 4.0]),
    ):
        expected = wrap_angle(math.atan2(goal[1] - pose[1], goal[0] - pose[0]) - pose[2])
        agree(hand_in.call('bearing_error', pose, goal), expected, f'bearing_error({pose}, {goal})')
