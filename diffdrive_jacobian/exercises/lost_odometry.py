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

"""Exercise 10: odometry that is lost. Its last part is a node in lockstep, and needs ROS.

command(pose, age, goal)   (v, omega) 20 times a second, from the last pose [x, y, theta] and its age
                           (s): to [x, y], and zero if the pose is older than 0.3 s. pose is None, and
                           age too, before the first one
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from diffdrive_jacobian.grading import HandIn, agree

GOAL = np.array([1.0, 0.5])


@pytest.mark.points(1)
def test_before_odometry(hand_in: HandIn) -> None:
    """Without a pose the robot stands."""
    agree(hand_in.call('command', None, None, GOAL), [0.0, 0.0], 'command(None, None, goal)')


@pytest.mark.points(2)
def test_old_pose(hand_in: HandIn) -> None:
    """A pose that is too old stops the robot, and a new one lets it drive on."""
    pose = np.array([0.0, 0.0, 0.2])
    for age in (0.0, 0.2, 0.31, 1.0, 100.0, 0.05):
        v, omega = hand_in.array('command', pose, age, GOAL, shape=(2,))
        drives = v > 0.0
        assert drives == (age <= 0.3), (
            f'command(pose, {age:g}, goal) must {"drive" if age <= 0.3 else "be zero"}, got v = {v:.6g}'
        )
        assert drives or omega == 0.0, f'omega must be 0 at an age of {age:g} s, got {omega:.6g}'


@pytest.mark.points(3)
@pytest.mark.skipif(find_spec('rclpy') is None, reason='needs ROS 2, as nodes in lockstep')
def test_in_lockstep(hand_in: HandIn) -> None:
    """In a world without odometry for two seconds, the robot stops in half a second, and arrives."""
    from diffdrive_jacobian.exercises._lost_odometry_world import world_of

    distance, violation = world_of(hand_in, GOAL)
    assert not violation, violation
    assert distance < 0.1, f'after 30 s the robot is {distance:.2f} m from the goal, allowed 0.1 m'
