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

"""The result of a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_jacobian.calibration.determined import undetermined
from diffdrive_jacobian.calibration.model import (
    CLOCKS,
    MULTIPLIERS,
    Array,
    CalibrationDrive,
    Estimate,
    Segment,
)
from diffdrive_jacobian.calibration.motion import Geometry, composed
from diffdrive_jacobian.numerics.elementary import wrap

PARAMETERS = (
    'left_wheel_radius_multiplier',
    'right_wheel_radius_multiplier',
    'wheel_separation_multiplier',
)
"""Names of the multipliers in their order, as wheel_bridge and diff_drive_controller have them."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Calibration:
    """The result of a calibration."""

    nominal: Geometry
    estimate: Estimate
    recordings: tuple[CalibrationDrive, ...]
    segments: tuple[Segment, ...]
    """Continuous motions; poses at rest are not merged."""
    motions: tuple[Segment, ...]
    """Continuous motions, poses at rest merged; `estimate.states` are their poses."""
    notes: tuple[str, ...] = ()
    """What `calibrate_run` prints as notes, see doc/calibration.md."""

    @property
    def geometry(self) -> Geometry:
        """The calibrated dimensions."""
        return self.estimate.geometry(self.nominal)

    @property
    def multipliers(self) -> Array:
        """Multipliers of the left radius, the right radius and the separation, shape (3,)."""
        return np.array(self.geometry.multipliers)

    @property
    def covariance(self) -> Array:
        """Covariance of the multipliers, shape (3, 3)."""
        scale = self.multipliers
        return np.asarray(self.estimate.covariance[MULTIPLIERS, MULTIPLIERS] * scale[:, None] * scale)

    @property
    def clocks(self) -> Array:
        """Offset (s) and drift (s/s) of the clock of each recording, shape (recordings, 2).

        A pose with the time t by the clock of the reference has the time `t + offset + drift (t - t_0)`
        by that of the wheels, where t_0 is in the middle of the poses.
        """
        return self.estimate.parameters[CLOCKS:].reshape(-1, 2)

    @property
    def clock_deviations(self) -> Array:
        """Standard deviations of the same, shape (recordings, 2)."""
        return np.sqrt(np.diag(self.estimate.covariance))[CLOCKS:].reshape(-1, 2)

    def residuals(self) -> list[Array]:
        """Return what remains between the reference and the most likely poses of the sensor.

        For each continuous motion the time since the first pose of all (s) and the residual in x, y (m)
        and heading (rad), shape (n, 4). Poses at rest are merged.
        """
        parts: list[Array] = []
        begins: dict[int, float] = {}
        for motion, states in zip(self.motions, self.estimate.states, strict=True):
            # Recordings follow each other, whenever they were made.
            end = float(parts[-1][-1, 0]) if parts else 0.0
            begin = begins.setdefault(motion.recording, end - float(motion.time[0]))
            difference = motion.poses - composed(states, self.estimate.sensor)
            difference[:, 2] = wrap(difference[:, 2])
            parts.append(np.column_stack([begin + motion.time, difference]))
        return parts

    @property
    def undetermined(self) -> list[tuple[str, str]]:
        """Combinations of the multipliers that the drives do not determine; empty: none.

        Of each, its name and what drive determines it, in words. Its standard deviation is above 2 %:
        the multipliers must not be used then.
        """
        return undetermined(self.estimate.covariance[MULTIPLIERS, MULTIPLIERS])
