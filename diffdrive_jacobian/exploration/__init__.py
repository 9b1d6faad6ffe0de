"""Exploring worlds: `explore` runs a scenario in thousands of worlds and shrinks what fails.

    from diffdrive_jacobian.testing import explore, fault_schedules, goals

It needs Hypothesis, which is imported when one of these names is used first. Processes that only run
worlds do not need it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy
from diffdrive_jacobian.exploration.errors import ExplorationError
from diffdrive_jacobian.exploration.scenario import scenario_from

if TYPE_CHECKING:
    from diffdrive_jacobian.exploration.executors import LocalExecutor, SerialExecutor
    from diffdrive_jacobian.exploration.exploring import explore
    from diffdrive_jacobian.exploration.reproduction import reproducing
    from diffdrive_jacobian.exploration.result import Exploration, Finding, Replay
    from diffdrive_jacobian.exploration.schedules import fault_schedules
    from diffdrive_jacobian.exploration.strategies import (
        angles,
        gains,
        goals,
        numbers,
        points,
        poses,
        probabilities,
        times,
        waypoints,
    )

__all__ = [
    'Exploration',
    'ExplorationError',
    'Finding',
    'LocalExecutor',
    'Replay',
    'SerialExecutor',
    'angles',
    'explore',
    'fault_schedules',
    'gains',
    'goals',
    'numbers',
    'points',
    'poses',
    'probabilities',
    'reproducing',
    'scenario_from',
    'times',
    'waypoints',
]

_STRATEGIES = (
    *('angles', 'gains', 'goals', 'numbers', 'points', 'poses', 'probabilities', 'times', 'waypoints'),
)

if not TYPE_CHECKING:
    # They need Hypothesis.
    __getattr__, __dir__ = lazy.attach(
        __name__,
        {
            'explore': 'exploration.exploring',
            'fault_schedules': 'exploration.schedules',
            'reproducing': 'exploration.reproduction',
            **dict.fromkeys(('Exploration', 'Finding', 'Replay'), 'exploration.result'),
            **dict.fromkeys(('LocalExecutor', 'SerialExecutor'), 'exploration.executors'),
            **dict.fromkeys(_STRATEGIES, 'exploration.strategies'),
        },
    )
