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

"""Exercise 3: kp below kv. The law is v = kv d cos(e), omega = kp e.

error_rate(kp, kv, e)   de/dt of the bearing error e (rad/s), while the robot drives to the goal
turns_to_goal(kp, kv)   whether small bearing errors vanish: True or False
gains()                 (kp, kv) that arrive within 5 s at goals 1 m away, and drive at most 1.3 m
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from diffdrive_jacobian.drives import drive
from diffdrive_jacobian.grading import HandIn, SavePicture, agree


@pytest.mark.points(2)
def test_error_rate(hand_in: HandIn) -> None:
    """The bearing error falls by the yaw rate, and grows as the robot passes the goal."""
    for kp, kv, e in (
        np.random.default_rng(3).uniform([0.1, 0.1, -3.0], [5.0, 5.0, 3.0], (12, 3)).tolist()
    ):
        expected = -kp * e + kv * math.sin(e) * math.cos(e)
        agree(
            hand_in.call('error_rate', kp, kv, e),
            expected,
            f'error_rate({kp:.3g}, {kv:.3g}, {e:.3g})',
            within=1e-3,
        )


@pytest.mark.points(1)
def test_turns_to_goal(hand_in: HandIn) -> None:
    """Small errors vanish if kp is larger than kv."""
    for kp, kv in ((3.0, 0.5), (0.5, 1.0), (1.0, 0.9), (0.9, 1.0), (4.0, 8.0)):
        found = hand_in.call('turns_to_goal', kp, kv)
        assert bool(found) == (kp > kv), f'turns_to_goal({kp:g}, {kv:g}) must be {kp > kv}, got {found}'


@pytest.mark.points(2)
def test_gains(hand_in: HandIn, save_picture: SavePicture) -> None:
    """With these gains the robot arrives in time at goals in all directions."""
    kp, kv = hand_in.array('gains', shape=(2,)).tolist()
    for angle in (0.0, 1.0, 2.0, 3.0, -2.5):
        goal = [math.cos(angle), math.sin(angle)]
        outcome = drive([goal], lockstep=True, timeout=5.0, parameters={'kp': kp, 'kv': kv})
        assert outcome.arrived, (
            f'kp = {kp:g}, kv = {kv:g}: the robot is {outcome.distance:.2f} m from the goal after 5 s, '
            f'{math.degrees(angle):.0f} degrees to the left of where it started'
        )
        length = float(np.hypot(*np.diff(outcome.run.odometry.values[:, :2], axis=0).T).sum())
        assert length <= 1.3, f'kp = {kp:g}, kv = {kv:g}: it drives {length:.2f} m to a goal 1 m away'
    save_picture(outcome.plot)
