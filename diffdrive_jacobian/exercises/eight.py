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

"""Exercise 9: along an eight, also with wheels that slip.

errors(pose, reference)    [along, left, heading]: the reference [x, y, theta] seen from the robot
                           (m, m, rad)
law(pose, reference, v, omega)   (v, omega) that follow a reference that moves at v and omega
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from diffdrive_jacobian.control import PathController
from diffdrive_jacobian.drives import Outcome, drive
from diffdrive_jacobian.grading import HandIn, SavePicture, agree
from diffdrive_jacobian.kinematics import se2


@pytest.mark.points(2)
def test_errors(hand_in: HandIn) -> None:
    """The errors are those in the frame of the robot, the heading wrapped."""
    for pose, reference in np.random.default_rng(10).uniform(-3.0, 3.0, (8, 2, 3)):
        expected = se2.compose(se2.inverse(pose), reference)
        what = f'errors({np.round(pose, 3).tolist()}, {np.round(reference, 3).tolist()})'
        agree(hand_in.call('errors', pose, reference), expected, what)


@pytest.mark.points(1)
def test_on_the_path(hand_in: HandIn) -> None:
    """A robot without errors drives as the reference moves."""
    pose = np.array([1.0, -2.0, 0.7])
    agree(hand_in.call('law', pose, pose, 0.3, -0.4), [0.3, -0.4], 'law without errors')


def follow(hand_in: HandIn, **robot: Any) -> Outcome:
    """Return the outcome of an eight by the law of a hand-in."""

    def law(poses: Any, references: Any) -> tuple[float, float]:
        moves = references[3:5].tolist()
        v, omega = hand_in.array('law', poses, references[:3], *moves, shape=(2,)).tolist()
        return v, omega

    controller = PathController(name='hand_in', law=law, gains=())
    return drive(
        'eight:1.0', path_controller=controller, lockstep=True, timeout=60.0, robot_parameters=robot
    )


@pytest.mark.points(2)
def test_eight(hand_in: HandIn, save_picture: SavePicture) -> None:
    """The eight is followed within 2 cm, in 60 s."""
    outcome = follow(hand_in)
    save_picture(outcome.plot)
    assert outcome.arrived, f'after {outcome.seconds:.0f} s, {outcome.distance:.2f} m are still to go'
    assert outcome.across < 0.02, f'the robot leaves the path by {outcome.across:.3f} m, allowed 0.02 m'


@pytest.mark.points(1)
def test_slip(hand_in: HandIn) -> None:
    """With wheels that slip the odometry stays within 5 cm of the path, from another start, too."""
    outcome = follow(hand_in, simulate_slip=True, wheel_travel_variance=1e-4, slip_seed=4)
    assert outcome.arrived, f'after {outcome.seconds:.0f} s, {outcome.distance:.2f} m are still to go'
    assert outcome.across < 0.05, f'the robot leaves the path by {outcome.across:.3f} m, allowed 0.05 m'
