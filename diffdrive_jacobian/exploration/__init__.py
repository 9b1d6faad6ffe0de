"""Exploring worlds: `explore` runs a scenario in thousands of worlds and shrinks what fails.

    from diffdrive_jacobian.testing import explore, fault_schedules, goals

It needs Hypothesis, which is imported when one of these names is used first. Processes that only run
worlds do not need it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

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

_MODULES = {
    'explore': 'exploring',
    'fault_schedules': 'schedules',
    'reproducing': 'reproduction',
    **dict.fromkeys(('Exploration', 'Finding', 'Replay'), 'result'),
    **dict.fromkeys(('LocalExecutor', 'SerialExecutor'), 'executors'),
    **dict.fromkeys(
        (
            'angles',
            'gains',
            'goals',
            'numbers',
            'points',
            'poses',
            'probabilities',
            'times',
            'waypoints',
        ),
        'strategies',
    ),
}
"""Public names to the modules that are imported when they are used."""


def __getattr__(name: str) -> Any:
    """Import a public name.

    Raises:
        ExplorationError: Hypothesis is needed and not installed.
    """
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(importlib.import_module(f'{__name__}.{_MODULES[name]}'), name)
    globals()[name] = value
    return value
