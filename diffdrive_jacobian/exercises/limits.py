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

"""Exercise 8: limits that keep the path, and gains that fit them.

limited(v, omega, max_v, max_omega)             both scaled alike, so that neither is too large
limited_wheels(v, omega, r, L, max_speed)       likewise by the limit of the wheels (rad/s)
gains(max_v, max_omega)                         (kp, kv) of the law v = kv d cos(e), omega = kp e that
                                                arrive within these limits 2 m away in 12 s
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.drives import drive
from diffdrive_jacobian.grading import HandIn, agree
from diffdrive_jacobian.kinematics import diff_drive

TWISTS = np.random.default_rng(9).uniform([-1.0, -4.0], [1.0, 4.0], (10, 2)).tolist()


@pytest.mark.points(2)
def test_limited(hand_in: HandIn) -> None:
    """A twist that is too fast is scaled, so that the robot drives the same circle more slowly."""
    for v, omega in [(0.1, 0.2), (0.0, 3.0), *TWISTS]:
        scale = min(1.0, 0.4 / max(abs(v), 1e-12), 1.5 / max(abs(omega), 1e-12))
        found = hand_in.call('limited', v, omega, 0.4, 1.5)
        agree(found, [scale * v, scale * omega], f'limited({v:.6g}, {omega:.6g}, 0.4, 1.5)')


@pytest.mark.points(2)
def test_limited_wheels(hand_in: HandIn) -> None:
    """No wheel turns faster than its limit."""
    for v, omega in TWISTS:
        fastest = np.abs(diff_drive.body_to_wheel_jacobian(0.05, 0.3) @ [v, omega]).max()
        scale = min(1.0, 6.0 / fastest)
        found = hand_in.call('limited_wheels', v, omega, 0.05, 0.3, 6.0)
        agree(found, [scale * v, scale * omega], f'limited_wheels({v:.6g}, {omega:.6g}, 0.05, 0.3, 6)')


@pytest.mark.points(1)
def test_gains(hand_in: HandIn) -> None:
    """The robot arrives in time within the limits."""
    for max_v, max_omega in ((0.3, 1.0), (0.6, 2.0)):
        kp, kv = hand_in.array('gains', max_v, max_omega, shape=(2,)).tolist()
        limits = {
            'linear.x.max_velocity': max_v,
            'angular.z.max_velocity': max_omega,
            'angular.z.min_velocity': -max_omega,
        }
        gains = {'kp': kp, 'kv': kv}
        outcome = drive([[-1.4, 1.4]], lockstep=True, timeout=12.0, parameters={**limits, **gains})
        assert outcome.arrived, (
            f'with kp = {kp:g}, kv = {kv:g} and limits {max_v:g} m/s, {max_omega:g} rad/s the robot is '
            f'{outcome.distance:.2f} m from the goal after 12 s'
        )
