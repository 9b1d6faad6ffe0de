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

"""Exercise 5: a point ahead of the axle, which can move in every direction.

jacobian(theta, d)       of the point d ahead of the axle, shape (2, 2): [dx, dy] = J [v, omega]
inverse(theta, d)        its inverse
law(pose, goal, k, d)    (v, omega) that move the point straight to the goal at k times its distance
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from diffdrive_jacobian.control import Controller, Gain
from diffdrive_jacobian.control.controller import OFFSET
from diffdrive_jacobian.drives import drive
from diffdrive_jacobian.grading import HandIn, SavePicture, agree

CASES = [(0.0, 0.1), *np.random.default_rng(5).uniform([-3.0, 0.02], [3.0, 0.5], (6, 2)).tolist()]
"""Heading (rad) and offset (m)."""


def point_jacobian(theta: float, d: float) -> NDArray[np.float64]:
    """Return the Jacobian of the point, shape (2, 2)."""
    sine, cosine = np.sin(theta), np.cos(theta)
    return np.array([[cosine, -d * sine], [sine, d * cosine]])


@pytest.mark.points(2)
def test_jacobian(hand_in: HandIn) -> None:
    """The Jacobian of the point has the determinant d."""
    for theta, d in CASES:
        expected = point_jacobian(theta, d)
        agree(hand_in.call('jacobian', theta, d), expected, f'jacobian({theta:.6g}, {d:.6g})')


@pytest.mark.points(1)
def test_inverse(hand_in: HandIn) -> None:
    """It has an inverse at every heading."""
    for theta, d in CASES:
        expected = np.linalg.inv(point_jacobian(theta, d))
        agree(hand_in.call('inverse', theta, d), expected, f'inverse({theta:.6g}, {d:.6g})')


@pytest.mark.points(2)
def test_law(hand_in: HandIn, save_picture: SavePicture) -> None:
    """The point drives straight to the goal, wherever the robot looks."""

    def law(poses: Any, goals: Any, k: float, offset: float) -> tuple[float, float]:
        v, omega = hand_in.array('law', poses, goals, float(k), float(offset), shape=(2,)).tolist()
        return v, omega

    gains = (Gain(name='gain', default=0.8), OFFSET)
    controller = Controller(name='hand_in', law=law, gains=gains, offset='offset')
    outcome = drive(
        [[-1.0, 0.5]], controller=controller, lockstep=True, timeout=30.0, parameters={'offset': 0.2}
    )
    save_picture(outcome.plot)
    assert outcome.arrived, (
        f'the point is {outcome.distance:.2f} m from the goal after {outcome.seconds:.0f} s'
    )
    x, y, theta = outcome.run.odometry.values[:, :3].T
    point = np.column_stack([x + 0.2 * np.cos(theta), y + 0.2 * np.sin(theta)])
    start, end = point[0], np.array([-1.0, 0.5])
    along = (end - start) / np.linalg.norm(end - start)
    across = np.abs((point - start) @ [-along[1], along[0]]).max()
    assert across < 0.03, (
        f'the point leaves the straight line to the goal by {across:.3f} m, allowed 0.03 m'
    )
