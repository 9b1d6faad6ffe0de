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

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_jacobian import faults, properties
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
    'GoldenRun',
    'Idle',
    'Lockstep',
    'LockstepError',
    'PropertyViolation',
    'RecordedRun',
    'faults',
    'properties',
]

_PACKAGES = ('faults', 'properties')
"""Packages beside this one that are names of it, too."""
_MODULES = {
    'Answers': 'lockstep',
    'Every': 'lockstep',
    'GoldenRun': 'testing.golden_run',
    'Idle': 'lockstep',
    'Lockstep': 'lockstep',
    'LockstepError': 'lockstep',
    'PropertyViolation': 'lockstep',
    'RecordedRun': 'testing.recorded_run',
}
"""The module of each other name."""


def __getattr__(name: str) -> Any:
    """Return a name of this package.

    Raises:
        AttributeError: There is no such name.
        ModuleNotFoundError: ROS is not installed.
    """
    if name in _PACKAGES:
        return importlib.import_module(f'diffdrive_jacobian.{name}')
    if name in _MODULES:
        return getattr(importlib.import_module(f'diffdrive_jacobian.{_MODULES[name]}'), name)
    exploration = importlib.import_module('diffdrive_jacobian.exploration')
    if name in exploration.__all__:
        return getattr(exploration, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    """Return the names of the module."""
    return sorted({*globals(), *__all__})
