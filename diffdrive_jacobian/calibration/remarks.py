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

"""What is remarkable about a calibration: impossible or unusual values, noise, and clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffdrive_jacobian.calibration.fit import SMALLEST
from diffdrive_jacobian.calibration.initial_estimate import unit
from diffdrive_jacobian.calibration.model import CalibrationError, Given
from diffdrive_jacobian.calibration.motion import composed
from diffdrive_jacobian.calibration.result import Calibration
from diffdrive_jacobian.numerics.elementary import wrap

BOUNDS = (0.1, 10.0)
"""Multipliers that `wheel_bridge` accepts."""
UNUSUAL = 1.15
"""Factor beyond which multipliers are not explained by manufacturing."""
LARGE_WHEEL_NOISE = 1e-2
"""Wheel travel variance beyond which the reference does not follow the wheels (m)."""
NOTABLE_WHEEL_NOISE = 1e-4
"""Wheel travel variance that is worth a note (m)."""
EXACT = 2e-5
"""Residual of the positions below which a reference is no observation of a real robot (m)."""
BACKWARD = 0.6
"""Angle from straight back within which a sensor looks backwards (rad)."""
LONG_DELAY, NOTABLE_DRIFT, LARGEST_DRIFT = 0.2, 2e-4, 0.02
"""Time offset (s) and drift of a clock that are worth a note, and a drift that no clock has. That of
quartz is less than 1e-4."""
CORRELATED, LEAST_ERRORS = 0.5, 60
"""Correlation of successive errors that is noted, and fewest errors that show it."""


def remarked(result: Calibration, given: Given) -> Calibration:
    """Return a calibration with notes about all that is remarkable.

    If successive errors of the reference are correlated, its covariance is larger.

    Raises:
        CalibrationError: The multipliers or the noise are impossible.
    """
    notes = [*result.notes, *_of_values(result, given)]
    estimate = result.estimate
    correlation = _correlation(result) if given.position_noise is None else 0.0
    if correlation > CORRELATED:
        notes.append(
            f'the errors of successive poses of the reference are correlated ({correlation:.2f}): the '
            'stated deviations are enlarged for that'
        )
        # As of the mean of an autoregressive process of first order.
        factor = (1.0 + correlation) / (1.0 - correlation)
        estimate = replace(estimate, covariance=estimate.covariance * factor)
    if given.time_offset is None:
        notes += _of_clocks(result)
    return replace(result, estimate=estimate, notes=tuple(notes))


def _of_values(result: Calibration, given: Given) -> list[str]:
    """Return notes about multipliers, noise and sensor; CalibrationError if they are impossible."""
    values, noise = result.multipliers, result.estimate.noise
    other_unit = unit(float(np.exp(np.log(values).mean())))
    if (values < BOUNDS[0]).any() or (values > BOUNDS[1]).any():
        found = ', '.join(f'{value:.3g}' for value in values.tolist())
        raise CalibrationError(
            f'multipliers must be from {BOUNDS[0]:g} to {BOUNDS[1]:g}, got {found} (left, right, '
            'separation): are the nominal dimensions wrong, or is the reference of another robot, or in '
            f'{other_unit} instead of metres?'
        )
    apart = f'{noise.wheel**0.5:.2g} m'
    if noise.wheel > LARGE_WHEEL_NOISE:
        raise CalibrationError(
            f'the reference does not follow the wheels: after 1 m they differ by {apart}; is it of this '
            'robot, and do the wheels slip?'
        )
    notes = []
    residuals = np.concatenate(result.residuals())[:, 1:3]
    if np.isnan(given.variances).all() and np.sqrt(np.mean(residuals**2)) < EXACT:
        notes.append(
            'the reference follows the wheels without error: it is simulated without slip, or odometry '
            'that was computed from these wheels, which does not show their true dimensions'
        )
    if given.wheel_noise is None and noise.wheel > NOTABLE_WHEEL_NOISE:
        notes.append(
            f'the wheels differ from the reference by {apart} after 1 m: they slip, '
            'or the reference is filtered, or of another body'
        )
    if (np.abs(np.log(values)) > np.log(UNUSUAL)).any():
        listed = ', '.join(f'{value:.4g}' for value in values.tolist())
        notes.append(
            f'the multipliers {listed} (left, right, separation) are beyond what manufacturing '
            f'explains: are the nominal dimensions wrong, or is the reference in {other_unit} instead '
            'of metres?'
        )
    if given.yaw_offset is None and abs(wrap(result.estimate.sensor[2] - np.pi)) < BACKWARD:
        notes.append(
            'the sensor looks backwards. If it is not mounted so, the left and the right wheel are '
            'swapped and both turn in the wrong sense: the multipliers of the radii are exchanged then'
        )
    return notes


def _correlation(result: Calibration) -> float:
    """Return the correlation of the position errors of successive poses in motion; 0: there are few.

    Those at rest are means of several, and a reference without noise has none that could be correlated.
    """
    first, second = [], []
    for motion, states in zip(result.motions, result.estimate.states, strict=True):
        errors = (motion.poses - composed(states, result.estimate.sensor))[:, :2]
        single = (motion.samples[1:] == 1.0) & (motion.samples[:-1] == 1.0)
        first.append(errors[:-1][single].ravel())
        second.append(errors[1:][single].ravel())
    a, b = np.concatenate(first), np.concatenate(second)
    if len(a) < LEAST_ERRORS or result.estimate.noise.position <= 1.01 * SMALLEST.position:
        return 0.0
    return float(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), 0.0, 0.99))


def _of_clocks(result: Calibration) -> list[str]:
    """Return notes about clocks that differ."""
    notes = []
    clocks = np.column_stack([result.clocks, result.clock_deviations]).tolist()
    for one, (offset, drift, _, deviation) in zip(result.recordings, clocks, strict=True):
        if abs(offset) > LONG_DELAY:
            notes.append(
                f'{one.name}: the clock of the reference differs by {offset:.3f} s from that '
                'of the wheels'
            )
        if abs(drift) > LARGEST_DRIFT:
            raise CalibrationError(
                f'{one.name}: the clock of the reference would drift by {100.0 * abs(drift):.2g} %: is '
                'it of the same drive as the wheels?'
            )
        if abs(drift) > max(NOTABLE_DRIFT, 4.0 * deviation):
            notes.append(
                f'{one.name}: the clock of the reference runs {100.0 * abs(drift):.2g} % '
                f'{"slow" if drift > 0.0 else "fast"} by that of the wheels, which is corrected'
            )
    return notes
