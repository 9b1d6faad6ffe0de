"""Calibration of wheel radii and wheel separation from recorded wheels and a reference of the pose."""

from diffdrive_jacobian.calibration.calibrate import PARAMETERS, Calibration, calibrate
from diffdrive_jacobian.calibration.measurements import (
    CalibrationError,
    Given,
    Noise,
    Recording,
)
from diffdrive_jacobian.calibration.motion import Geometry

__all__ = [
    'PARAMETERS',
    'Calibration',
    'CalibrationError',
    'Geometry',
    'Given',
    'Noise',
    'Recording',
    'calibrate',
]
