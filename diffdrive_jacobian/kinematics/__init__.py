"""Jacobians and motions of wheeled robots: pure functions over NumPy arrays, no ROS."""

from diffdrive_jacobian.kinematics import diff_drive, se2

__all__ = ['diff_drive', 'se2']
