"""Jacobians and motions of wheeled robots and planar arms: pure functions over NumPy arrays, no ROS."""

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
