"""Jacobians and motions of wheeled robots and planar arms: pure functions over NumPy arrays, no ROS."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_jacobian.kinematics import (
        contact,
        diff_drive,
        inverse_kinematics,
        inverse_velocity,
        mobile_manipulator,
        planar_arm,
        se2,
    )
    from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator
    from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

__all__ = [
    'MobileManipulator',
    'PlanarArm',
    'contact',
    'diff_drive',
    'inverse_kinematics',
    'inverse_velocity',
    'mobile_manipulator',
    'planar_arm',
    'se2',
]
_CLASSES = {'MobileManipulator': 'mobile_manipulator', 'PlanarArm': 'planar_arm'}


def __getattr__(name: str) -> Any:
    """Return a module or a class. Nodes, which need few of them, start faster than with all."""
    if name not in __all__:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    module = import_module(f'{__name__}.{_CLASSES.get(name, name)}')
    return getattr(module, name) if name in _CLASSES else module


def __dir__() -> list[str]:
    """Return the names of the module."""
    return sorted({*globals(), *__all__})
