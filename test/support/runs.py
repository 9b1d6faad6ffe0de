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

"""Recorded runs of a robot on an arc or a line, without nodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffdrive_jacobian.bags.run import COLUMNS, Run, Series, read_run
from diffdrive_jacobian.kinematics.se2 import integrate
from support.bags import SECOND, odom, write_bag
from support.ros_messages import joint_command

RATE = 50
STRAIGHT = {'omega': 0.0, 'v': 0.5}
"""At time t at x = t / 2."""


def drive(count=200, v=0.5, omega=0.5, begin=10.0, delay=0.0):
    """Drive an arc; what the robot says is recorded with a delay (s)."""
    pose = np.zeros(3)
    for index in range(count):
        at = begin + index / RATE
        yield at + delay, '/odom', odom(*pose, v, omega, seconds=at)
        yield at + delay, '/joint_states', joint_command(index, -index, round(at * SECOND))
        pose = integrate(pose, (v, omega), 1 / RATE)


def sample(extra=(), **how):
    return sorted([*drive(**how), *extra], key=lambda one: one[0])


def run_of(tmp_path, extra=(), *, parameters=None, **how):
    return read_run(write_bag(tmp_path / 'run', sample(extra, **how), parameters=parameters))


def series(name, stamps, values, received=None):
    """Return a series of a run; messages are received at their stamps unless other times are given."""
    stamps = np.asarray(stamps, dtype=np.int64)
    columns = COLUMNS[name]
    return Series(
        received=stamps if received is None else np.asarray(received, dtype=np.int64),
        stamps=stamps,
        values=np.asarray(values, dtype=np.float64).reshape(len(stamps), len(columns)),
        columns=columns,
    )


def built_run(**given):
    """Return a run of these series; the others are empty."""
    return Run(path=Path('run'), **({name: series(name, [], []) for name in COLUMNS} | given))
