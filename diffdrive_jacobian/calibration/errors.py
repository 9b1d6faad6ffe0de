"""Errors of the odometry with given dimensions, relative to the reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_jacobian.calibration.calibrate import Calibration
from diffdrive_jacobian.calibration.measurements import Array
from diffdrive_jacobian.calibration.motion import (
    Geometry,
    composed,
    increments,
    inverted,
    relative,
)
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
    """Return the tracks of a calibration with given dimensions.

    Args:
        result: The calibration; its time offsets and its sensor are used.
        geometry: Dimensions of the robot for the odometry.
        distance: Distance for the errors (m).
    """
    sensor = inverted(result.estimate.sensor)
    found = []
    for segment in result.segments:
        at = segment.time + result.time_offsets[segment.recording]
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
