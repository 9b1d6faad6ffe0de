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

"""Exercise 4: a law of your own, and two others, on the same goals in one picture.

law(pose, goal)   (v, omega) of a robot at [x, y, theta] that drives to [x, y] (m/s, rad/s)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from diffdrive_jacobian.control import Controller
from diffdrive_jacobian.drives import Outcome, drive
from diffdrive_jacobian.grading import HandIn, SavePicture
from diffdrive_jacobian.plots import run_figure

GOALS = [[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]]


def drive_by(hand_in: HandIn, goals: Any, **how: Any) -> Outcome:
    """Return the outcome of a drive by the law of a hand-in."""

    def law(poses: Any, targets: Any) -> tuple[float, float]:
        v, omega = hand_in.array('law', poses, targets, shape=(2,)).tolist()
        return v, omega

    controller = Controller(name='hand_in', law=law, gains=())
    return drive(goals, controller=controller, lockstep=True, **how)


def length(outcome: Outcome) -> float:
    """Return how far a robot drove (m)."""
    return float(np.hypot(*np.diff(outcome.run.odometry.values[:, :2], axis=0).T).sum())


@pytest.mark.points(1)
def test_straight(hand_in: HandIn) -> None:
    """A goal straight ahead is driven to without a turn."""
    pose, goal = np.array([0.0, 0.0, 0.0]), np.array([1.0, 0.0])
    v, omega = hand_in.array('law', pose, goal, shape=(2,))
    assert v > 0.0, f'v must be positive if the goal is ahead, got {v:.6g}'
    assert abs(omega) < 1e-9, f'omega must be 0 if the goal is straight ahead, got {omega:.6g}'


@pytest.mark.points(2)
def test_corners(hand_in: HandIn) -> None:
    """The corners of a square are reached, in 60 s."""
    outcome = drive_by(hand_in, GOALS, timeout=60.0)
    assert outcome.arrived, (
        f'after {outcome.seconds:.0f} s the robot is {outcome.distance:.2f} m from the last goal'
    )


@pytest.mark.points(2)
def test_as_short_as_others(hand_in: HandIn, save_picture: SavePicture) -> None:
    """The way is at most a tenth longer than by the laws go_to_goal and offset_point."""
    mine = drive_by(hand_in, GOALS, timeout=60.0)
    others = [drive(GOALS, controller=name, lockstep=True) for name in ('go_to_goal', 'offset_point')]
    save_picture(lambda: run_figure([mine, *others]))
    assert mine.arrived, f'the robot is {mine.distance:.2f} m from the last goal after 60 s'
    limit = 1.1 * max(map(length, others))
    assert length(mine) <= limit, f'it drove {length(mine):.2f} m, others at most {limit / 1.1:.2f} m'
