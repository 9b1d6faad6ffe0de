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

"""Incremental wheel encoders, and the odometry that follows from their counts.

An encoder counts whole increments of `2 pi / per_revolution`. Between two readings the odometry follows
one exact arc, with the distances of the counted increments, so it depends on how often they are read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from diffdrive_jacobian.numerics.checks import integer
from diffdrive_jacobian.simulation.robot import Robot
from diffdrive_jacobian.simulation.speeds import arc_end
from diffdrive_jacobian.time_units import NANOSECONDS

MAX_PER_REVOLUTION = 10**9
"""Largest number of increments."""


@dataclass(frozen=True, slots=True)
class Encoders:
    """Encoders at their last reading."""

    per_revolution: int
    """Number of increments in one turn of a wheel."""
    stamp: int
    """Time of the reading (ns)."""
    counts: tuple[int, int]
    """Counts of the right and the left wheel."""
    pose: tuple[float, float, float]
    """`(x, y, theta)` of the odometry (m, m, rad)."""
    speeds: tuple[float, float] = (0.0, 0.0)
    """`(omega_R, omega_L)`, the increments per time since the reading before (rad/s)."""

    @classmethod
    def at(cls, robot: Robot, per_revolution: int) -> Encoders:
        """Return encoders that are read for the first time; ValueError: `per_revolution` is invalid."""
        per_revolution = integer('per_revolution', per_revolution, 1, MAX_PER_REVOLUTION)
        counts = _counts(robot.wheel_angles, per_revolution)
        return cls(per_revolution, robot.stamp, counts, robot.pose_tuple)

    @property
    def increment(self) -> float:
        """Angle of one increment (rad)."""
        return math.tau / self.per_revolution

    def read(self, robot: Robot) -> Encoders:
        """Return the encoders after they were read again, at the time of the robot."""
        counts = _counts(robot.wheel_angles, self.per_revolution)
        right, left = (
            (new - old) * self.increment for new, old in zip(counts, self.counts, strict=True)
        )
        model, dt = robot.model, (robot.stamp - self.stamp) / NANOSECONDS
        distance, turn = model.twist(right, left)
        pose = arc_end(self.pose, (distance, turn), 1.0)
        # Time may have gone back.
        speeds = (right / dt, left / dt) if dt > 0.0 else (0.0, 0.0)
        return Encoders(self.per_revolution, robot.stamp, counts, pose, speeds)

    def placed(self, pose: tuple[float, float, float]) -> Encoders:
        """Return the same counts, with the odometry reset to a pose."""
        return replace(self, pose=pose)

    def reported(self, robot: Robot) -> Robot:
        """Return the robot as these encoders report it."""
        right, left = self.counts
        model = robot.model
        twist = model.twist(*self.speeds)
        return robot.reported(self.pose, (right * self.increment, left * self.increment), twist)


def _counts(angles: tuple[float, float], per_revolution: int) -> tuple[int, int]:
    right, left = (math.floor(angle / math.tau * per_revolution) for angle in angles)
    return right, left
