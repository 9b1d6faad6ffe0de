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

"""Robots as values, closed loops in batches, sweeps of gains, manipulators along lines. No ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy
from diffdrive_jacobian.simulation.actuators import AccelerationLimits, Actuators, AxisLimits
from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.simulation.slip import Drift

if TYPE_CHECKING:
    from diffdrive_jacobian.simulation.closed_loop import closed_loops, trajectories
    from diffdrive_jacobian.simulation.gain_sweep import (
        Sweep,
        SweepSetup,
        describe_sweep,
        sweep,
        sweep_table,
    )
    from diffdrive_jacobian.simulation.tracking import follow_path, track_line

__all__ = [
    'AccelerationLimits',
    'Actuators',
    'AxisLimits',
    'Drift',
    'Robot',
    'RobotModel',
    'Sweep',
    'SweepSetup',
    'closed_loops',
    'describe_sweep',
    'follow_path',
    'sweep',
    'sweep_table',
    'track_line',
    'trajectories',
]
if not TYPE_CHECKING:
    # Nodes, which need none of them, start faster without.
    __getattr__, __dir__ = lazy.attach(
        __name__,
        {
            'Sweep': 'simulation.gain_sweep',
            'SweepSetup': 'simulation.gain_sweep',
            'closed_loops': 'simulation.closed_loop',
            'describe_sweep': 'simulation.gain_sweep',
            'follow_path': 'simulation.tracking',
            'sweep': 'simulation.gain_sweep',
            'sweep_table': 'simulation.gain_sweep',
            'track_line': 'simulation.tracking',
            'trajectories': 'simulation.closed_loop',
        },
    )
