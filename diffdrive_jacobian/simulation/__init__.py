"""Simulation of robots, of closed loops in batches, and of manipulators along lines. No ROS."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.simulation.slip import Drift

if TYPE_CHECKING:
    from diffdrive_jacobian.simulation.closed_loop import closed_loops, trajectories
    from diffdrive_jacobian.simulation.tracking import track_line

__all__ = ['Drift', 'Robot', 'RobotModel', 'closed_loops', 'track_line', 'trajectories']
_MODULES = {'closed_loops': 'closed_loop', 'trajectories': 'closed_loop', 'track_line': 'tracking'}


def __getattr__(name: str) -> Any:
    """Return a function or its module. Nodes, which need none of them, start faster without."""
    if name in _MODULES:
        return getattr(import_module(f'{__name__}.{_MODULES[name]}'), name)
    if name in _MODULES.values():
        return import_module(f'{__name__}.{name}')
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    """Return the names of the module."""
    return sorted({*globals(), *__all__})
