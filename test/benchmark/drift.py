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

"""Robots that slip, compared with what their odometry reports: `python test/benchmark/drift.py`.

For each drive: the mean normalized error squared (NEES, 3 is right) of the true pose about the odometry,
with the published covariance, over 4,000 seeds, and the standard deviations. Commands take effect within
cells, also several in each. Some robots have acceleration limits, a lag and a delay. The last column is
the NEES of as many runs with noisy wheels in steps of 10 ms, which do not use the slip. Then the CPU
time of long gaps.
`--seconds 60` drives longer: half a minute of CPU time for each ten seconds. `--limited` leaves out the
robots without limits.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))
from support.moments_reference import DRIVES, noisy_runs

from diffdrive_jacobian.simulation import (
    AccelerationLimits,
    Actuators,
    AxisLimits,
    Drift,
    Robot,
    RobotModel,
)
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds

DRIVES = DRIVES | {
    'short starts': lambda duration: [((0.22, 0.0), 0.002), ((0.0, 0.0), 0.018)] * round(50 * duration),
    'short stops': lambda duration: [((0.22, 0.0), 0.014), ((0.0, 0.0), 0.001)] * round(67 * duration),
}
_AXIS = {
    'max_acceleration': 0.5,
    'max_deceleration': -0.8,
    'max_acceleration_reverse': -0.3,
    'max_deceleration_reverse': 0.6,
}
LIMITS = AccelerationLimits(
    v=AxisLimits(**_AXIS), omega=AxisLimits(max_acceleration=2.0), max_wheel_acceleration=20.0
)
_TURNS = (
    ((0.22, 0.3), 1.3),
    ((-0.1, -0.8), 0.9),
    ((0.2, -0.5), 0.7),
    ((0.0, 0.0), 0.6),
    ((0.1, 1.2), 1.5),
)
LIMITED = {
    'limits, stop and go': ('stop and go', Actuators(acceleration=LIMITS)),
    'limits, turns': ('turns', Actuators(acceleration=LIMITS)),
    'lag, turns': ('turns', Actuators(lag=0.2)),
    'all, turns': ('turns', Actuators(acceleration=LIMITS, lag=0.1, delay=50_000_000)),
}
"""Drives of robots that take time to follow commands."""
DRIVES['turns'] = lambda duration: [*_TURNS] * round(duration / 5.0)
START = 7_654_321
STEP = 10_000_000
GAPS = {'1 s': 1.0, '1 min': 60.0, '1 h': 3600.0, '1 day': 86400.0, '1 year': 3.15e7}


def driven(model: RobotModel, name: str, duration: float) -> Robot:
    """Return a robot after a drive."""
    return list(states(model, name, duration))[-1]


def states(model: RobotModel, name: str, duration: float) -> Iterator[Robot]:
    """Yield the robot after each command of a drive, and at its end."""
    drive, actuators = LIMITED.get(name, (name, Actuators()))
    stamp = START
    robot = Robot(model=replace(model, actuators=actuators), stamp=stamp, pose=np.zeros(3))
    for twist, held in DRIVES[drive](duration):
        robot = robot.commanded(tuple(map(float, twist)), stamp)
        yield robot
        stamp += nanoseconds(held)
    yield robot.at(stamp)


def noisy(name: str, duration: float, count: int) -> np.ndarray:
    """Return the errors of runs with noisy wheels in short steps of constant twist, shape (n, 3)."""
    model, steps = RobotModel(), []
    for one, other in pairwise(states(model, name, duration)):
        number = math.ceil((other.stamp - one.stamp) / STEP)
        length = (other.stamp - one.stamp) / number
        steps += [
            (one.at(one.stamp + round((step + 0.5) * length)).twist, length / NANOSECONDS)
            for step in range(number)
        ]
    rng, L, k = np.random.default_rng(1), model.wheel_separation, model.wheel_travel_variance
    return noisy_runs(rng, steps, np.zeros((3, 3)), count, L, k)


def errors(name: str, duration: float, seeds: range) -> np.ndarray:
    """Return the errors of the odometry, shape (n, 3); they are those of the true pose."""
    found = []
    for seed in seeds:
        robot = driven(RobotModel(drift=Drift(seed=seed)), name, duration)
        x, y, theta = robot.true_pose - robot.pose
        found.append((x, y, math.remainder(theta, math.tau)))
    return np.array(found)


def accuracy(names: Iterable[str], count: int, duration: float) -> Table:
    """Return the table of the errors."""
    table = Table(title=f'ground_truth about odom after {duration:g} s, {count} seeds')
    for name in ('drive', 'NEES', 'sigma x (m)', 'published', 'sigma y (m)', 'published', 'NEES, noisy'):
        table.add_column(name, justify='right')
    workers = os.cpu_count() or 1
    shares = [range(count)[first::workers] for first in range(workers)]
    with ProcessPoolExecutor(workers) as pool:
        for name in names:
            parts = pool.map(errors, [name] * workers, [duration] * workers, shares)
            found = np.concatenate(list(parts))
            covariance = driven(RobotModel(), name, duration).covariance
            inverse = np.linalg.inv(covariance)
            values = np.einsum('ni,ij,nj->n', found, inverse, found)
            others = noisy(name, duration, count)
            by_steps = np.einsum('ni,ij,nj->n', others, inverse, others).mean()
            sigma, published = np.sqrt(np.mean(found**2, axis=0)), np.sqrt(np.diag(covariance))
            table.add_row(
                *(name, f'{values.mean():.2f} ± {values.std() / math.sqrt(count):.2f}'),
                *(f'{sigma[0]:.5f}', f'{published[0]:.5f}', f'{sigma[1]:.5f}', f'{published[1]:.5f}'),
                f'{by_steps:.2f}',
            )
    return table


def cost() -> Table:
    """Return the table of CPU times of the true pose after a long time under one command."""
    table = Table('gap', 'with slip (ms)', 'without (ms)', title='CPU time')
    for name, seconds in GAPS.items():
        found = []
        for model in (RobotModel(drift=Drift(seed=1)), RobotModel()):
            robot = Robot(model=model, stamp=START, pose=np.zeros(3)).commanded((0.2, 0.5), START)
            begin = time.process_time()
            _ = robot.at(START + round(seconds * 1e9)).true_pose_tuple
            found.append((time.process_time() - begin) * 1e3)
        table.add_row(name, f'{found[0]:.2f}', f'{found[1]:.3f}')
    return table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=4000, help='number of seeds (default: 4000)')
    parser.add_argument('--seconds', type=float, default=10.0, help='length of a drive (default: 10.0)')
    parser.add_argument('--limited', action='store_true', help='only robots with limits')
    options = parser.parse_args()
    console = Console(width=120)
    names = [*([] if options.limited else DRIVES), *LIMITED]
    console.print(accuracy(names, options.seeds, options.seconds))
    console.print(cost())


if __name__ == '__main__':
    main()
