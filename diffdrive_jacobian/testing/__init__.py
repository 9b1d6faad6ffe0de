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

"""Tests of ROS nodes in simulated time: a plugin of pytest (`fixtures`), and `Lockstep` for others.

Names of this package, which are imported on first use:

- `Lockstep` and its errors.
- `NodeProcess`: a process whose nodes take part.
- `check_repeats`: whether a world does the same each time.
- `explore`, `fault_schedules`, `poses`, ...: exploring worlds, most of which needs Hypothesis.
- `path_message`: the message with a path.
- `RecordedRun`, `GoldenRun`: types of the fixtures `recorded_run` and `golden_run`.

Faults that a `Lockstep` injects are in the package `faults`, properties that it requires in
`properties`.

pytest loads the plugin in every project, so this module imports neither rclpy nor NumPy by itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.exploration.exploring import explore
    from diffdrive_jacobian.exploration.processes import LocalExecutor, SerialExecutor
    from diffdrive_jacobian.exploration.result import Exploration, Finding, Replay, reproducing
    from diffdrive_jacobian.exploration.scenario import ExplorationError, scenario_from
    from diffdrive_jacobian.exploration.schedules import (
        fault_schedules,
        numbers,
        probabilities,
        times,
    )
    from diffdrive_jacobian.lockstep._errors import (
        IneffectiveFaultsError,
        LockstepError,
        PropertyViolation,
    )
    from diffdrive_jacobian.lockstep.external.node_process import NodeProcess
    from diffdrive_jacobian.lockstep.world import Lockstep
    from diffdrive_jacobian.nodes.goal_client import path_message
    from diffdrive_jacobian.robot_testing.strategies import (
        angles,
        gains,
        goals,
        points,
        poses,
        waypoints,
    )
    from diffdrive_jacobian.testing.recorded_run import GoldenRun, RecordedRun
    from diffdrive_jacobian.testing.repeats import check_repeats

__all__ = [
    'Exploration',
    'ExplorationError',
    'Finding',
    'GoldenRun',
    'IneffectiveFaultsError',
    'LocalExecutor',
    'Lockstep',
    'LockstepError',
    'NodeProcess',
    'PropertyViolation',
    'RecordedRun',
    'Replay',
    'SerialExecutor',
    'angles',
    'check_repeats',
    'explore',
    'fault_schedules',
    'gains',
    'goals',
    'numbers',
    'path_message',
    'points',
    'poses',
    'probabilities',
    'reproducing',
    'scenario_from',
    'times',
    'waypoints',
]

_MODULES = {
    'exploration.scenario': ('ExplorationError', 'scenario_from'),
    'exploration.exploring': ('explore',),
    'exploration.processes': ('LocalExecutor', 'SerialExecutor'),
    'exploration.result': ('Exploration', 'Finding', 'Replay', 'reproducing'),
    'exploration.schedules': ('fault_schedules', 'numbers', 'probabilities', 'times'),
    'lockstep._errors': ('IneffectiveFaultsError', 'LockstepError', 'PropertyViolation'),
    'lockstep.external.node_process': ('NodeProcess',),
    'lockstep.world': ('Lockstep',),
    'nodes.goal_client': ('path_message',),
    'robot_testing.strategies': ('angles', 'gains', 'goals', 'points', 'poses', 'waypoints'),
    'testing.recorded_run': ('GoldenRun', 'RecordedRun'),
    'testing.repeats': ('check_repeats',),
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy.attach(
        __name__, {name: module for module, names in _MODULES.items() for name in names}
    )
