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

"""Limits of the acceleration beside those of diff_drive_controller: `python test/benchmark/limiter.py`.

The same commands, at rest before, are followed by our robot and by the published rule of that controller
(control_toolbox, RateLimiter). In each cycle v and omega, each for itself, approach the command by at
most its limit times the cycle. The limit depends on the sign of the speed before the cycle. The result
is held until the next cycle. Without jerk limits. The table is in doc/comparison.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from diffdrive_jacobian.kinematics.se2 import integrate
from diffdrive_jacobian.simulation import AccelerationLimits, Actuators, AxisLimits, Robot, RobotModel
from diffdrive_jacobian.time_units import nanoseconds

LIMITS = AccelerationLimits(
    v=AxisLimits(
        max_acceleration=0.5,
        max_deceleration=-0.8,
        max_acceleration_reverse=-0.3,
        max_deceleration_reverse=0.6,
    ),
    omega=AxisLimits(
        max_acceleration=2.0,
        max_deceleration=-3.0,
        max_acceleration_reverse=-2.0,
        max_deceleration_reverse=3.0,
    ),
)
END = 3.0
"""Duration of each drive (s)."""
DRIVES = {
    'start on a circle': [(0.0, (0.4, 1.0))],
    'start and stop straight on': [(0.0, (0.4, 0.0)), (1.0, (0.0, 0.0))],
    'start and stop on a circle': [(0.0, (0.4, 1.0)), (1.0, (0.0, 0.0))],
    'reverse': [(0.0, (0.3, 0.0)), (1.0, (-0.3, 0.0))],
    'slalom': [(0.4 * number, (0.3, 1.5 * (-1) ** number)) for number in range(6)],
}
"""Commands with their times (s)."""


class Motion(NamedTuple):
    """Samples of a motion."""

    times: np.ndarray
    """Shape (n,) (s)."""
    twists: np.ndarray
    """v and omega from each time on, shape (n, 2)."""
    poses: np.ndarray
    """Shape (n, 3)."""

    def reaches(self, twist) -> float:
        """Return the time from which on the twist is another one, near enough (s)."""
        away = np.abs(self.twists - twist).max(axis=1) > 1e-9
        return float(self.times[np.flatnonzero(away)[-1] + 1])


def limited(axis: AxisLimits, speed: float, command: float, cycle: float) -> float:
    """Return the speed of the next cycle by the rule of diff_drive_controller."""
    upwards = axis.max_deceleration_reverse if speed < 0.0 else axis.max_acceleration
    downwards = axis.max_deceleration if speed > 0.0 else axis.max_acceleration_reverse
    return speed + min(max(command - speed, downwards * cycle), upwards * cycle)


def theirs(commands, cycle: float) -> Motion:
    """Follow commands by the rule of diff_drive_controller, in cycles (s)."""
    twist, pose, waiting = (0.0, 0.0), np.zeros(3), list(commands)
    command, rows = (0.0, 0.0), []
    for number in range(round(END / cycle) + 1):
        time = number * cycle
        while waiting and waiting[0][0] <= time + 1e-9:
            command = waiting.pop(0)[1]
        twist = tuple(
            limited(axis, speed, to, cycle)
            for axis, speed, to in zip((LIMITS.v, LIMITS.omega), twist, command, strict=True)
        )
        rows.append((time, *twist, *pose))
        pose = integrate(pose, twist, cycle)
    samples = np.array(rows)
    return Motion(samples[:, 0], samples[:, 1:3], samples[:, 3:])


def ours(commands, step: float = 0.001) -> Motion:
    """Follow commands with our robot, sampled in steps (s)."""
    robot = Robot(model=RobotModel(actuators=Actuators(acceleration=LIMITS)), stamp=0, pose=np.zeros(3))
    waiting, rows = list(commands), []
    for number in range(round(END / step) + 1):
        time = number * step
        while waiting and waiting[0][0] <= time + 1e-9:
            robot = robot.commanded(waiting.pop(0)[1], nanoseconds(time))
        now = robot.at(nanoseconds(time))
        rows.append((time, *now.twist, *now.pose))
    samples = np.array(rows)
    return Motion(samples[:, 0], samples[:, 1:3], samples[:, 3:])


def off_the_circle(poses: np.ndarray, twist) -> float:
    """Return the largest distance of the path from the circle of a twist through the origin (m)."""
    radius = twist[0] / twist[1] if twist[1] else math.inf
    if math.isinf(radius):
        return float(np.abs(poses[:, 1]).max())
    return float(np.abs(np.hypot(poses[:, 0], poses[:, 1] - radius) - abs(radius)).max())


def main() -> None:
    """Print the table."""
    table = Table(title='on the same commands', show_lines=False)
    for name in (
        *('drive', 'limiter', 'last command reached (s)', 'end x (m)', 'y (m)', 'heading (rad)'),
        *('apart from ours (mm)', 'off the circle (mm)'),
    ):
        table.add_column(name, justify='right')
    for name, commands in DRIVES.items():
        reference = ours(commands)
        motions = {'ours': reference}
        motions |= {f'theirs, {rate} Hz': theirs(commands, 1.0 / rate) for rate in (50, 100, 1000)}
        for limiter, motion in motions.items():
            apart = math.dist(motion.poses[-1, :2], reference.poses[-1, :2])
            circle = f'{1e3 * off_the_circle(motion.poses, commands[0][1]):.2f}'
            table.add_row(
                *(name, limiter, f'{motion.reaches(commands[-1][1]):.3f}'),
                *(f'{value:.4f}' for value in motion.poses[-1]),
                *(f'{1e3 * apart:.2f}', '' if name in ('slalom', 'reverse') else circle),
            )
    Console(width=130).print(table)


if __name__ == '__main__':
    main()
