"""The offset between the clocks of the wheels and of the reference, from the motion that both show."""

from __future__ import annotations

import numpy as np

from diffdrive_jacobian.calibration.measurements import Array, Recording
from diffdrive_jacobian.calibration.motion import Geometry

WIDEST = 30.0
"""Largest offset that is searched for (s)."""
LEAST = 0.5
"""Correlation below which an offset is not found."""
MOST = 1 << 18
"""Largest number of times at which the speeds are compared."""


def time_offset(recording: Recording, nominal: Geometry) -> float | None:
    """Return what must be added to the times of the poses; None: it cannot be found.

    The speeds and the absolute yaw rates of both are correlated. Both are 0 outside of their times.
    """
    wheels, poses = recording.wheel_time, recording.pose_time
    period = max(float(np.median(np.diff(poses))), 1e-3)
    begin, end = min(wheels[0], poses[0]) - WIDEST, max(wheels[-1], poses[-1]) + WIDEST
    period = max(period, float(end - begin) / MOST)
    grid = np.arange(begin, end, period)
    size = 1 << int(2 * len(grid) - 1).bit_length()
    total = np.zeros(size)
    for ours, theirs in zip(
        _wheel_speeds(recording, nominal, grid), _pose_speeds(recording, grid), strict=True
    ):
        norms = float(np.linalg.norm(ours) * np.linalg.norm(theirs))
        if norms > 0.0:
            spectrum = np.fft.rfft(ours, size) * np.conj(np.fft.rfft(theirs, size))
            total += np.fft.irfft(spectrum, size) / norms / 2.0
    lags = int(WIDEST / period)
    around = np.concatenate([total[-lags:], total[: lags + 1]])
    best = int(np.argmax(around))
    if around[best] < LEAST or best in (0, len(around) - 1):
        return None
    low, middle, high = around[best - 1 : best + 2]
    bend = low - 2.0 * middle + high
    fine = 0.5 * (low - high) / bend if bend < 0.0 else 0.0
    return float((best - lags + fine) * period)


def _derivative(time: Array, values: Array, grid: Array) -> Array:
    """Return the mean derivative within each cell of a grid, 0 outside of the times, shape (n, ...)."""
    inside = np.column_stack([np.interp(grid, time, column) for column in values.T])
    return np.asarray(np.diff(inside, axis=0) / np.diff(grid)[:, None], dtype=np.float64)


def _centred(values: Array) -> Array:
    return np.asarray(values - values.mean())


def _wheel_speeds(recording: Recording, nominal: Geometry, grid: Array) -> tuple[Array, Array]:
    right, left = _derivative(recording.wheel_time, recording.wheel_angles, grid).T
    r, L = nominal.wheel_radius, nominal.wheel_separation
    return _centred(np.abs(right + left) * r / 2.0), _centred(np.abs(right - left) * r / L)


def _pose_speeds(recording: Recording, grid: Array) -> tuple[Array, Array]:
    heading = np.unwrap(recording.poses[:, 2])
    values = np.column_stack([recording.poses[:, :2], heading])
    dx, dy, turn = _derivative(recording.pose_time, values, grid).T
    # One glitch must not outweigh the whole drive.
    speed, rate = np.hypot(dx, dy), np.abs(turn)
    limits = [4.0 * float(np.percentile(one, 95)) + 1e-9 for one in (speed, rate)]
    return _centred(np.minimum(speed, limits[0])), _centred(np.minimum(rate, limits[1]))
