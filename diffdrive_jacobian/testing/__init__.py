"""Tests of ROS nodes in simulated time: a plugin of pytest (`fixtures`), and `Lockstep` for others.

Names of this package, which are imported on first use:

- `Lockstep`, `LockstepError`: as in the package `lockstep`.
- `RecordedRun`, `GoldenRun`: types of the fixtures `recorded_run` and `golden_run`.

pytest loads the plugin in every project, so this module imports neither rclpy nor NumPy
by itself.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep import Lockstep, LockstepError
    from diffdrive_jacobian.testing.golden_run import GoldenRun
    from diffdrive_jacobian.testing.recorded_run import RecordedRun

__all__ = ['GoldenRun', 'Lockstep', 'LockstepError', 'RecordedRun']

_MODULES = {
    'GoldenRun': 'diffdrive_jacobian.testing.golden_run',
    'Lockstep': 'diffdrive_jacobian.lockstep',
    'LockstepError': 'diffdrive_jacobian.lockstep',
    'RecordedRun': 'diffdrive_jacobian.testing.recorded_run',
}


def __getattr__(name: str) -> Any:
    """Return a name of this package.

    Raises:
        AttributeError: There is no such name.
        ModuleNotFoundError: ROS is not installed.
    """
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    """Return the names of the module."""
    return sorted({*globals(), *__all__})
