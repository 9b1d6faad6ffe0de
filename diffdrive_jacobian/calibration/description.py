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

"""A calibration in words, as a ROS parameter file, and its odometry relative to the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from diffdrive_jacobian.calibration.model import Array
from diffdrive_jacobian.calibration.motion import Geometry, composed, increments, inverted, relative
from diffdrive_jacobian.calibration.result import PARAMETERS, Calibration
from diffdrive_jacobian.numerics.elementary import wrap

DISTANCE = 5.0
"""Distance over which odometry and reference are compared, where the drive is long enough (m)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Track:
    """The path of a continuous motion by the reference and by the wheels."""

    recording: int
    time: Array
    """Times by the clock of the wheels, shape (n,) (s)."""
    reference: Array
    """Poses of the body by the reference, shape (n, 3)."""
    odometry: Array
    """Poses of the body by the wheels, aligned with the reference at the start, shape (n, 3)."""
    position_error: Array
    """Distance between both after a given distance from where they agreed, shape (n,) (m)."""
    heading_error: Array
    """The same of the heading (rad)."""


def compared_distance(result: Calibration) -> float:
    """Return the distance after which the odometry is compared with the reference (m)."""
    longest = 0.0
    for segment in result.segments:
        moved = np.abs(np.diff(segment.wheel_angles, axis=0)).sum() / 2.0 * result.nominal.wheel_radius
        longest = max(longest, float(moved))
    return min(DISTANCE, longest / 4.0)


def tracks(result: Calibration, geometry: Geometry, distance: float) -> list[Track]:
    """Return the tracks of a calibration with given dimensions, and errors over a distance (m)."""
    sensor = inverted(result.estimate.sensor)
    found = []
    for segment in result.segments:
        at = segment.at(result.estimate.parameters)
        moved = increments(segment.wheel_time, segment.wheel_angles, at, geometry)
        reference = composed(segment.poses, sensor)
        travelled = np.concatenate([[0.0], np.cumsum(moved.travel / 2.0)])
        begin = np.searchsorted(travelled, travelled - distance, side='right') - 1
        known = begin >= 0
        begin = np.maximum(begin, 0)
        difference = relative(
            relative(moved.poses[begin], moved.poses), relative(reference[begin], reference)
        )
        found.append(
            Track(
                recording=segment.recording,
                time=at,
                reference=reference,
                odometry=composed(reference[0], moved.poses),
                position_error=np.where(known, np.hypot(difference[:, 0], difference[:, 1]), np.nan),
                heading_error=np.where(known, wrap(difference[:, 2]), np.nan),
            )
        )
    return found


def rms(values: list[Array]) -> float:
    """Return the root mean square of arrays, without NaN; NaN if nothing remains."""
    together = np.concatenate(values) if values else np.empty(0)
    together = together[np.isfinite(together)]
    return float(np.sqrt(np.mean(together**2))) if len(together) else float('nan')


def parameter_file(result: Calibration, source: str) -> str:
    """Return a ROS parameter file (YAML) for the nodes of this package and for diff_drive_controller.

    `source` says what it was estimated from, in one line for a comment.
    """
    deviations = np.sqrt(np.diag(result.covariance)).tolist()
    lines = [
        f'# Estimated by calibrate_run from {source}.',
        '# For virtual_robot, wheel_bridge and diff_drive_controller. Behind each value: its standard '
        'deviation.',
        '/**:',
        '  ros__parameters:',
        f'    wheel_radius: {result.nominal.wheel_radius!r}',
        f'    wheel_separation: {result.nominal.wheel_separation!r}',
    ]
    values = result.multipliers.tolist()
    for name, value, deviation in zip(PARAMETERS, values, deviations, strict=True):
        lines.append(f'    {name}: {value:.6f}  # {deviation:.6f}')
    return '\n'.join([*lines, ''])


def describe(result: Calibration) -> list[str]:
    """Return lines about the parameters, the noise, and the odometry before and after."""
    deviations = np.sqrt(np.diag(result.covariance)).tolist()
    radii = result.geometry.radii
    metres = (radii[1], radii[0], result.geometry.separation)
    rows = zip(PARAMETERS, result.multipliers.tolist(), deviations, metres, strict=True)
    lines = [
        f'{name}: {value:.5f} ± {deviation:.5f} ({size:.6f} m)' for name, value, deviation, size in rows
    ]
    correlation = result.covariance / np.outer(deviations, deviations)
    lines.append(
        f'correlation: left and right {correlation[0, 1]:+.2f}, left and separation '
        f'{correlation[0, 2]:+.2f}, right and separation {correlation[1, 2]:+.2f}'
    )
    lines.append(_sensor(result))
    clocks = np.column_stack([result.clocks, result.clock_deviations]).tolist()
    for one, (offset, drift, deviation, of_drift) in zip(result.recordings, clocks, strict=True):
        if deviation:
            offset, drift = round(offset, 4) + 0.0, round(1e6 * drift) + 0.0
            lines.append(
                f'clock of the reference in {one.name}: offset {offset:.4f} ± {deviation:.4f} s, drift '
                f'{drift:.0f} ± {1e6 * of_drift:.0f} us/s'
            )
    noise = result.estimate.noise
    lines.append(
        f'noise: wheel travel variance {noise.wheel:.3g} m, reference {noise.position:.3g} m and '
        f'{noise.heading:.3g} rad'
    )
    errors = np.max([one.wheel_errors.max(axis=0) for one in result.segments], axis=0) * radii
    if errors.any():
        lines.append(
            f'encoders: standard deviation of a wheel at rest {errors[1]:.2g} m (left), '
            f'{errors[0]:.2g} m (right)'
        )
    distance = compared_distance(result)
    before, after = (
        tracks(result, geometry, distance) for geometry in (result.nominal, result.geometry)
    )
    lines.append(
        f'odometry after {distance:.2g} m, rms: '
        + ' -> '.join(
            f'{rms([one.position_error for one in drawn]):.4f} m, '
            f'{rms([one.heading_error for one in drawn]):.4f} rad'
            for drawn in (before, after)
        )
    )
    return lines


def _sensor(result: Calibration) -> str:
    values = result.estimate.sensor.tolist()
    deviations = np.sqrt(np.diag(result.estimate.covariance))[3:6].tolist()
    values[2] = math.remainder(values[2], math.tau)
    values = [round(value, 4) + 0.0 for value in values]  # no negative zeros
    texts = [
        f'{value:.4f} ± {deviation:.4f}' if deviation else f'{value:.4f} (given)'
        for value, deviation in zip(values, deviations, strict=True)
    ]
    return f'sensor in the body frame: x {texts[0]} m, y {texts[1]} m, yaw {texts[2]} rad'


def explain_undetermined(result: Calibration) -> str:
    """Return, in words, what the drives do not determine and what would; '' if they determine all."""
    found = result.undetermined
    if not found:
        return ''
    return 'the drive does not determine ' + '; nor '.join(f'{name}: {remedy}' for name, remedy in found)
