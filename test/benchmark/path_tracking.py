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

"""Tracking errors of the laws of paths: `python test/benchmark/path_tracking.py [--page | --quick]`.

Each law drives a robot along a circle and a figure eight at two speeds: an ideal robot, one whose wheels
slip, one with limits of the acceleration, and one that follows its commands 100 ms late. The figures
follow from the laws alone, without a clock: they are the same each time. --page writes them into
doc/mathematics.md, --quick drives along one path, to try it.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path as File
from typing import Any, NamedTuple

import numpy as np

from diffdrive_jacobian.control import Path
from diffdrive_jacobian.control.path_laws import PATH_CONTROLLERS
from diffdrive_jacobian.control.path_source import planned_path
from diffdrive_jacobian.simulation import (
    AccelerationLimits,
    Actuators,
    AxisLimits,
    Drift,
    RobotModel,
    follow_path,
)

PAGE = File(__file__).parents[2] / 'doc' / 'mathematics.md'
BEGIN, END = '<!-- tracking errors -->', '<!-- end of tracking errors -->'
SPEEDS = (0.2, 0.4)
SHAPES = ('circle:1.0', 'eight:1.0')
LIMITS = AccelerationLimits(
    v=AxisLimits(max_acceleration=0.5, max_deceleration=-0.5),
    omega=AxisLimits(
        max_acceleration=2.0,
        max_deceleration=-2.0,
        max_acceleration_reverse=-2.0,
        max_deceleration_reverse=2.0,
    ),
)
SEEDS = range(5)
"""Of the slip. The mean error is over all, the greatest one that of any."""
ROBOTS: dict[str, list[dict[str, Any]]] = {
    'ideal': [{}],
    'slip': [
        {'model': RobotModel(wheel_travel_variance=1e-4, drift=Drift(seed=seed)), 'localised': True}
        for seed in SEEDS
    ],
    'acceleration': [{'model': RobotModel(actuators=Actuators(acceleration=LIMITS))}],
    'delay': [{'model': RobotModel(actuators=Actuators(delay=100_000_000))}],
}


class Row(NamedTuple):
    """The errors of one law in one case: mean and greatest (mm)."""

    shape: str
    speed: float
    robot: str
    law: str
    across: tuple[float, float]
    along: tuple[float, float]


def rows(quick: bool) -> Iterator[Row]:
    """Drive every case, or the quickest of each robot and law."""
    for shape in SHAPES[:1] if quick else SHAPES:
        path = planned_path(shape)
        for speed in SPEEDS[-1:] if quick else SPEEDS:
            trajectory = Path(path.poses, path.arc_lengths / speed)
            for robot, options in ROBOTS.items():
                for law in PATH_CONTROLLERS:
                    drives = [
                        follow_path(law, trajectory, **one) for one in options[: 1 if quick else None]
                    ]
                    errors = 1e3 * abs(np.concatenate([one.errors[:, :2] for one in drives]))
                    along, across = np.stack([errors.mean(axis=0), errors.max(axis=0)], axis=-1)
                    yield Row(shape, speed, robot, law.name, tuple(across), tuple(along))


def table(quick: bool) -> str:
    """Return the rows of the page: one for each case, and a column for each law."""
    names = [law.name for law in PATH_CONTROLLERS]
    lines = [f'| path, robot | {" | ".join(f"`{name}`" for name in names)} |']
    lines.append('|---' * (len(names) + 1) + '|')
    found = list(rows(quick))
    for index in range(0, len(found), len(names)):
        case = found[index : index + len(names)]
        cells = ['{:.1f} / {:.1f}, {:.1f} / {:.1f}'.format(*row.across, *row.along) for row in case]
        shape, speed, robot, *_ = case[0]
        lines.append(f'| `{shape}`, {speed} m/s, {robot} | {" | ".join(cells)} |')
    return '\n'.join(lines)


def main() -> None:
    """Print the table, or write it into the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    output = parser.add_mutually_exclusive_group()
    output.add_argument('--page', action='store_true', help='write the table into doc/mathematics.md')
    output.add_argument('--quick', action='store_true', help='one path at one speed, to try it')
    options = parser.parse_args()
    text = table(options.quick)
    if options.page:
        page = PAGE.read_text()
        pattern = re.compile(f'{BEGIN}.*{END}', re.DOTALL)
        assert pattern.search(page)
        PAGE.write_text(pattern.sub(lambda _: f'{BEGIN}\n\n{text}\n\n{END}', page))
    else:
        print(text)


if __name__ == '__main__':
    main()
