# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
