"""A calibration in words, and as a ROS parameter file."""

from __future__ import annotations

import math

import numpy as np

from diffdrive_jacobian.calibration.calibrate import PARAMETERS, Calibration
from diffdrive_jacobian.calibration.errors import compared_distance, rms, tracks


def parameter_file(result: Calibration, source: str) -> str:
    """Return a ROS parameter file (YAML) for the nodes of this package and for diff_drive_controller.

    Args:
        result: The calibration.
        source: What it was estimated from, one line for a comment.
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
    full = np.sqrt(np.diag(result.estimate.covariance()))
    for one, offset, deviation in zip(
        result.recordings, result.time_offsets.tolist(), full[6:].tolist(), strict=True
    ):
        if deviation:
            offset = round(offset, 4) + 0.0
            lines.append(f'time offset of the reference in {one.name}: {offset:.4f} ± {deviation:.4f} s')
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
    deviations = np.sqrt(np.diag(result.estimate.covariance()))[3:6].tolist()
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
