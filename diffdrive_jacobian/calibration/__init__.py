"""Calibration of wheel radii and wheel separation from recorded wheels and a reference of the pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy
from diffdrive_jacobian.calibration.calibrate import calibrate
from diffdrive_jacobian.calibration.model import CalibrationDrive, CalibrationError, Given, Noise
from diffdrive_jacobian.calibration.motion import Geometry
from diffdrive_jacobian.calibration.result import PARAMETERS, Calibration

if TYPE_CHECKING:
    from diffdrive_jacobian.calibration.data import WheelsAndReference, read_wheels_and_reference

__all__ = [
    'PARAMETERS',
    'Calibration',
    'CalibrationDrive',
    'CalibrationError',
    'Geometry',
    'Given',
    'Noise',
    'WheelsAndReference',
    'calibrate',
    'read_wheels_and_reference',
]
if not TYPE_CHECKING:
    # The calibration itself needs NumPy only, no bags.
    __getattr__, __dir__ = lazy.attach(
        __name__,
        {'WheelsAndReference': 'calibration.data', 'read_wheels_and_reference': 'calibration.data'},
    )
