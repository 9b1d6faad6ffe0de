"""Imports of names that do not exist. The type checker must refuse each: unused comments are errors."""

from diffdrive_jacobian.exploration import fault_schedule  # type: ignore[attr-defined]
from diffdrive_jacobian.kinematics import se3  # type: ignore[attr-defined]
from diffdrive_jacobian.simulation import close_loops  # type: ignore[attr-defined]
from diffdrive_jacobian.testing import explor  # type: ignore[attr-defined]

__all__ = ['close_loops', 'explor', 'fault_schedule', 'se3']
