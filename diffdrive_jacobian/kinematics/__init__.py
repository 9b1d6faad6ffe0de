"""Jacobians and motions of wheeled robots and arms: pure functions over NumPy arrays, no ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.kinematics import (
        contact,
        diff_drive,
        differentiation,
        inverse_kinematics,
        inverse_velocity,
        mobile_manipulator,
        planar_arm,
        rigid_body,
        se2,
        spatial,
        spatial_arm,
    )
    from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator as MobileManipulator
    from diffdrive_jacobian.kinematics.planar_arm import PlanarArm as PlanarArm
    from diffdrive_jacobian.kinematics.spatial_arm import SpatialArm as SpatialArm

__all__ = [
    'contact',
    'diff_drive',
    'differentiation',
    'inverse_kinematics',
    'inverse_velocity',
    'mobile_manipulator',
    'planar_arm',
    'rigid_body',
    'se2',
    'spatial',
    'spatial_arm',
]
if not TYPE_CHECKING:
    # Nodes, which need few of them, start faster than with all.
    _MODULES = {name: f'kinematics.{name}' for name in __all__}
    # Short paths of the classes, which are listed under their modules.
    _CLASSES = {
        'MobileManipulator': 'kinematics.mobile_manipulator',
        'PlanarArm': 'kinematics.planar_arm',
        'SpatialArm': 'kinematics.spatial_arm',
    }
    __getattr__, __dir__ = lazy.attach(__name__, _MODULES | _CLASSES)
