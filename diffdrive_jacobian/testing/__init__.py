"""Tests of ROS nodes in simulated time: a plugin of pytest (`fixtures`), and `Lockstep` for others.

Names of this package, which are imported on first use:

- `Lockstep`, `LockstepError`, `PropertyViolation`: as in the package `lockstep`.
- `Answers`, `Every`, `Idle`: what nodes in other processes send, as in the package `lockstep`.
- `faults`: the package of the faults that a `Lockstep` injects.
- `properties`: the package of the properties that a `Lockstep` requires.
- `explore`, `fault_schedules`, `poses`, ...: all names of the package `exploration`, most of which need
  Hypothesis.
- `RecordedRun`, `GoldenRun`: types of the fixtures `recorded_run` and `golden_run`.

pytest loads the plugin in every project, so this module imports neither rclpy nor NumPy by itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian import faults, properties
    from diffdrive_jacobian.exploration import (
        Exploration,
        ExplorationError,
        Finding,
        LocalExecutor,
        Replay,
        SerialExecutor,
        angles,
        explore,
        fault_schedules,
        gains,
        goals,
        numbers,
        points,
        poses,
        probabilities,
        reproducing,
        scenario_from,
        times,
        waypoints,
    )
    from diffdrive_jacobian.lockstep import (
        Answers,
        Every,
        Idle,
        Lockstep,
        LockstepError,
        PropertyViolation,
    )
    from diffdrive_jacobian.testing.golden_run import GoldenRun
    from diffdrive_jacobian.testing.recorded_run import RecordedRun

__all__ = [
    'Answers',
    'Every',
    'Exploration',
    'ExplorationError',
    'Finding',
    'GoldenRun',
    'Idle',
    'LocalExecutor',
    'Lockstep',
    'LockstepError',
    'PropertyViolation',
    'RecordedRun',
    'Replay',
    'SerialExecutor',
    'angles',
    'explore',
    'fault_schedules',
    'faults',
    'gains',
    'goals',
    'numbers',
    'points',
    'poses',
    'probabilities',
    'properties',
    'reproducing',
    'scenario_from',
    'times',
    'waypoints',
]

_LOCKSTEP = ('Answers', 'Every', 'Idle', 'Lockstep', 'LockstepError', 'PropertyViolation')
_EXPLORATION = tuple(
    name
    for name in __all__
    if name not in (*_LOCKSTEP, 'GoldenRun', 'RecordedRun', 'faults', 'properties')
)

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy.attach(
        __name__,
        {
            'GoldenRun': 'testing.golden_run',
            'RecordedRun': 'testing.recorded_run',
            'faults': 'faults',
            'properties': 'properties',
            **dict.fromkeys(_LOCKSTEP, 'lockstep'),
            **dict.fromkeys(_EXPLORATION, 'exploration'),
        },
    )
