"""Poses of a robot at rest, merged: without motion between them they observe the same pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffdrive_jacobian.calibration.measurements import Segment
from diffdrive_jacobian.calibration.motion import Geometry
from diffdrive_jacobian.numerics.elementary import wrap

STILL = 1e-5
"""Distance that both wheels together travel while the robot counts as at rest (m)."""
MOST = 25
"""Largest weight of merged poses: the errors of a real reference at rest are not independent."""


def merged(segment: Segment, nominal: Geometry, time_offset: float) -> Segment:
    """Return a segment in which poses without motion of the wheels between them are averaged."""
    at = segment.time + time_offset
    steps = np.abs(np.diff(segment.wheel_angles, axis=0)).sum(axis=1) * nominal.wheel_radius
    travel = np.concatenate([[0.0], np.cumsum(steps)])
    place = np.floor(np.interp(at, segment.wheel_time, travel) / STILL)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(place)) + 1])
    counts = np.diff([*starts, len(at)])
    headings = segment.poses[np.repeat(starts, counts), 2]
    poses = segment.poses.copy()
    poses[:, 2] = wrap(poses[:, 2] - headings)
    means = np.add.reduceat(poses, starts) / counts[:, None]
    means[:, 2] += segment.poses[starts, 2]
    return replace(
        segment,
        time=np.add.reduceat(segment.time, starts) / counts,
        poses=means,
        weights=np.minimum(counts, MOST).astype(np.float64),
    )
