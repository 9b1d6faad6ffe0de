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

"""The uncertainty that odometry reports, beside noisy runs: `python test/benchmark/uncertainty.py`.

For each drive and time: the standard deviations about the reported pose as published, as of first
order, and of 4,000 Monte Carlo runs of the documented noise model, the mean normalized error squared
(3 is right), and how many of the runs are in the 95 % region that plot_run draws, and in the ellipse.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))
from support.moments_reference import DRIVES, noisy_runs, reported_path

from diffdrive_jacobian.simulation.exact_moments import (
    gaussian,
    propagate_moments,
)
from diffdrive_jacobian.simulation.odometry_noise import propagate_covariance
from diffdrive_jacobian.simulation.pose_region import (
    ELLIPSE_LEVEL,
    region_distance,
    region_of,
    sampled_errors,
)

L, K = 0.16, 1e-5
SURE = np.zeros((3, 3))


def nees(errors, moment):
    """Return the mean normalized error squared."""
    return float(np.einsum('ni,ij,nj->n', errors, np.linalg.inv(moment), errors).mean())


def accuracy(count: int) -> Table:
    """Return the table of standard deviations, errors and coverage."""
    table = Table(title=f'Uncertainty about the reported pose, {count} runs', show_lines=False)
    for name in (
        *('drive', 'time (s)', 'sigma x (m)', 'of first order', 'Monte Carlo'),
        *('sigma y (m)', 'Monte Carlo', 'NEES', 'of first order', 'region (%)', 'ellipse (%)'),
    ):
        table.add_column(name, justify='right')
    for name, drive_for in DRIVES.items():
        for duration in (10.0, 60.0, 300.0):
            drive = drive_for(duration)
            poses, noise = reported_path(drive, L, K)
            pose, moments, first = np.zeros(3), gaussian(SURE), SURE
            for twist, held in drive:
                moments = propagate_moments(moments, pose, twist, held, L, K)
                first = propagate_covariance(first, pose, twist, held, L, K)
                pose, _ = reported_path([(twist, held)], L, K, start=pose)
                pose = pose[-1]
            errors = noisy_runs(np.random.default_rng(1), drive, SURE, count, L, K)
            second = moments.second_moment
            *_, drawn = sampled_errors(poses, noise, SURE)
            region = region_of(pose, drawn)
            within = region_distance(region, pose[:2] + errors[:, :2]) <= region.level
            inverted = np.linalg.inv(second[:2, :2])
            ellipse = np.einsum('ni,ij,nj->n', errors[:, :2], inverted, errors[:, :2])
            sampled = np.sqrt(np.mean(errors**2, axis=0))
            table.add_row(
                *(name, f'{duration:.0f}', f'{second[0, 0] ** 0.5:.4f}', f'{first[0, 0] ** 0.5:.4f}'),
                *(f'{sampled[0]:.4f}', f'{second[1, 1] ** 0.5:.4f}', f'{sampled[1]:.4f}'),
                *(f'{nees(errors, second):.2f}', f'{nees(errors, first):.1f}'),
                *(f'{100.0 * within.mean():.1f}', f'{100.0 * np.mean(ellipse <= ELLIPSE_LEVEL):.1f}'),
            )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--quick', action='store_true', help='fewer runs, to try it')
    options = parser.parse_args()
    console = Console()
    if not console.is_terminal:
        console.width = 150
    console.print(accuracy(500 if options.quick else 4000))


if __name__ == '__main__':
    main()
