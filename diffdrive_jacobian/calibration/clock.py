"""The offset between the clocks of the wheels and of the reference, from the speeds that both show.

With the correlations rho of the N speeds in the overlap, the log-likelihood ratio against independent
speeds is `N g`, `g = -1/2 sum(log(1 - rho^2))`. The offset has the largest g. A motion that repeats
itself agrees as well at others. Then the offset nearest to zero must also have the largest overlap.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.model import Array, CalibrationDrive, CalibrationError
from diffdrive_jacobian.calibration.motion import Geometry

WINDOW = 0.5
"""Time over which speeds are means, at least (s)."""
STEP = 0.1
"""Time between them, at least (s)."""
MOST = 1 << 17
"""Largest number of them."""
LEAST_OVERLAP = 0.5
"""Overlap, as a share of the shorter recording, up to which offsets are searched."""
NEAR = 5.0
"""Offset up to which they are searched whatever the overlap (s)."""
LEAST = 0.7
"""Value of g below which an offset is not found."""
EVIDENCE = 20.0
"""Log-likelihood ratio below which two offsets are about as good, or one is not found."""
CLOSE = 0.3
"""Difference of g below which they are about as good in any case: offsets are multiples of the step."""
PERFECT = 0.99
"""Largest squared correlation: the speeds of a sensor off the axle are not those of the wheels."""
REMEDY = 'synchronize the clocks, or give the offset (--time-offset of calibrate_run)'


def time_offset(recording: CalibrationDrive, nominal: Geometry) -> float | None:
    """Return what must be added to the times of the poses; None: the speeds do not show it."""
    wheels, poses = recording.wheel_time, recording.pose_time
    window = max(WINDOW, *(float(np.median(np.diff(time))) for time in (wheels, poses)))
    length = max(wheels[-1] - wheels[0], poses[-1] - poses[0])
    step = max(STEP, float(length) / MOST)
    if min(wheels[-1] - wheels[0], poses[-1] - poses[0]) < 3.0 * window:
        return None
    ours, theirs = _wheel_speeds(recording, nominal, step, window), _pose_speeds(recording, step, window)
    lags, overlap, found = _correlations(ours, theirs)
    offsets = wheels[0] - poses[0] + lags * step
    samples = overlap * step / window
    allowed = (overlap >= LEAST_OVERLAP * np.max(overlap)) | (np.abs(offsets) <= NEAR)
    either = (_ratio(np.maximum(found * [1.0, sign], 0.0)) for sign in (1.0, -1.0))
    g, turned = (np.where(allowed & (samples * one >= EVIDENCE), one, 0.0) for one in either)
    largest = int(np.argmax(g))
    if g[largest] < LEAST:
        return None
    close = max(CLOSE, EVIDENCE / samples[largest])
    good = _maxima(g, g[largest] - close, close)
    widest = max(good, key=lambda index: overlap[index])
    fair = [index for index in good if overlap[widest] - overlap[index] <= abs(index - widest) / 2.0]
    best = min(fair, key=lambda index: abs(offsets[index]))
    if any(abs(offsets[index]) < abs(offsets[best]) for index in good):
        listed = ', '.join(
            f'{offsets[index]:.3f} s (overlap {overlap[index] * step:.0f} s)'
            for index in sorted(good, key=lambda index: abs(offsets[index]))[:4]
        )
        raise CalibrationError(
            f'{recording.name}: the motion repeats itself, and the wheels and the reference agree about '
            f'as well at several time offsets: {listed}: {REMEDY}'
        )
    if not (allowed[max(best - 1, 0)] and allowed[min(best + 1, len(g) - 1)]):
        raise CalibrationError(
            f'{recording.name}: the wheels and the reference agree best at a time offset of '
            f'{offsets[best]:.3f} s, the end of the range that is searched: {REMEDY}'
        )
    # Swapped wheels turn the other way. That is reported later, and must not be taken for an offset.
    other = int(np.argmax(samples * turned))
    if samples[other] * turned[other] > samples[best] * g[best] and abs(offsets[other]) < abs(
        offsets[best]
    ):
        return float(offsets[other])
    low, middle, high = g[best - 1 : best + 2]
    bend = low - 2.0 * middle + high
    fine = 0.5 * (low - high) / bend if bend < 0.0 else 0.0
    return float(offsets[best] + np.clip(fine, -1.0, 1.0) * step)


def _maxima(g: Array, least: float, close: float) -> list[int]:
    """Return the maxima of g that are at least `least`, with values lower by `close` between them."""
    high = np.flatnonzero(g > least - close)
    hills = np.split(high, np.flatnonzero(np.diff(high) > 1) + 1) if len(high) else []
    peaks = [int(hill[np.argmax(g[hill])]) for hill in hills]
    return [peak for peak in peaks if g[peak] >= least]


def _ratio(correlations: Array) -> Array:
    """Return g, shape (l,), of correlations, shape (l, k)."""
    return np.asarray(-0.5 * np.log(1.0 - PERFECT * correlations**2).sum(axis=1))


def _correlations(ours: Array, theirs: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Correlate the columns of two tables, shapes (m, k) and (n, k), within their overlap.

    Returns:
        The lags by which rows of the second are moved, the numbers of rows that overlap, shapes (l,),
        and the correlations, shape (l, k).
    """
    m, n = len(ours), len(theirs)
    lags = np.arange(1 - n, m)
    first, last = np.maximum(0, lags), np.minimum(m, n + lags)
    use = last - first >= 2
    lags, first, last = lags[use], first[use], last[use]
    count = last - first
    size = 1 << int(m + n).bit_length()
    columns = []
    for a, b in zip(ours.T, theirs.T, strict=True):
        floors = [1e-6 * float(np.mean(one**2)) + 1e-18 for one in (a, b)]
        a, b = a - a.mean(), b - b.mean()
        products = np.fft.irfft(np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size)), size)[lags] / count
        mean_a, square_a = _means(a, first, last)
        mean_b, square_b = _means(b, first - lags, last - lags)
        variance_a = np.maximum(square_a - mean_a**2, floors[0])
        variance_b = np.maximum(square_b - mean_b**2, floors[1])
        columns.append((products - mean_a * mean_b) / np.sqrt(variance_a * variance_b))
    return lags, count.astype(np.float64), np.clip(np.column_stack(columns), -1.0, 1.0)


def _means(values: Array, first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the means and the mean squares of parts of an array."""
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(np.column_stack([values, values**2]), axis=0)])
    means = (sums[last] - sums[first]) / (last - first)[:, None]
    return means[:, 0], means[:, 1]


def _differences(time: Array, values: Array, step: float, window: float) -> Array:
    """Return mean derivatives over a window, every step, shape (n, k)."""
    begin = np.arange(time[0], time[-1] - window, step)
    ends = [
        np.column_stack([np.interp(at, time, column) for column in values.T])
        for at in (begin, begin + window)
    ]
    return np.asarray((ends[1] - ends[0]) / window)


def _wheel_speeds(recording: CalibrationDrive, nominal: Geometry, step: float, window: float) -> Array:
    """Return the forward speed, not negative, and the yaw rate, shape (n, 2)."""
    right, left = _differences(recording.wheel_time, recording.wheel_angles, step, window).T
    r, L = nominal.wheel_radius, nominal.wheel_separation
    return np.column_stack([np.abs(right + left) * r / 2.0, (right - left) * r / L])


def _pose_speeds(recording: CalibrationDrive, step: float, window: float) -> Array:
    """Return the speed of the sensor and the yaw rate, shape (n, 2)."""
    values = np.column_stack([recording.poses[:, :2], np.unwrap(recording.poses[:, 2])])
    dx, dy, turn = _differences(recording.pose_time, values, step, window).T
    speeds = np.column_stack([np.hypot(dx, dy), turn])
    # One glitch must not outweigh the whole drive.
    limits = 4.0 * np.percentile(np.abs(speeds), 95, axis=0) + 1e-9
    return np.asarray(np.clip(speeds, -limits, limits))
