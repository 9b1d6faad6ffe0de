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

"""The offset between the clocks of the wheels and of the reference, from the speeds that both show.

Forward speed and yaw rate of both are correlated at all offsets. With the correlations rho of N
independent speeds in the overlap, `N g` with `g = -1/2 sum(log(1 - rho^2))` is the log-likelihood ratio
against speeds that have nothing to do with each other. The offset has the largest g. A motion that
repeats itself agrees as well at others: then the one nearest to zero must also have the largest overlap.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.model import Array, CalibrationDrive, CalibrationError
from diffdrive_jacobian.calibration.motion import Geometry

WINDOW, STEP = 0.5, 0.1
"""Time over which speeds are means, and time between them, at least (s). Robots of this kind change
their speed within about half a second; the estimate itself corrects an error of some tenths."""
FEWEST_WINDOWS = 3.0
"""Shortest recording, in such windows."""
MOST = 1 << 17
"""Largest number of speeds: four hours. Longer drives have longer steps."""
LEAST_OVERLAP, NEAR = 0.5, 5.0
"""Overlap, as a share of the shorter recording, up to which offsets are searched, and offset up to which
they are searched whatever the overlap (s): of synchronized computers, with recordings that overlap
little."""
EXPLAINED = 0.75
"""What an offset explains at least of both speeds, `1 - (1 - rho_v^2) (1 - rho_omega^2)`. Of 150 pairs
of drives that have nothing to do with each other none reached it."""
EVIDENCE = 20.0
"""Least `N g`: 15 s of overlap at least, where an offset explains just enough. It is no probability:
speeds within seconds depend on each other."""
ALIKE = 2.0
"""Ratio of what they do not explain up to which two offsets are about as good. Laps of a robot differ by
slip and noise alone, and so by less."""
OFF_AXLE = 0.01
"""What is never explained: the speeds of a sensor off the axle are not those of the wheels. Without it,
the best of two nearly perfect agreements would win by rounding errors."""
OUTLYING = 4.0
"""Factor of the 95th percentile to which speeds of the reference are limited: one glitch must not
outweigh the whole drive."""
REMEDY = 'synchronize the clocks, or give the offset (--time-offset of calibrate_run)'


def time_offset(recording: CalibrationDrive, nominal: Geometry) -> float | None:
    """Return what must be added to the times of the poses; None: the speeds do not show it.

    Raises:
        CalibrationError: They show several, or one at the end of the range that is searched.
    """
    wheels, poses = recording.wheel_time, recording.pose_time
    window = max(WINDOW, *(float(np.median(np.diff(time))) for time in (wheels, poses)))
    lengths = float(wheels[-1] - wheels[0]), float(poses[-1] - poses[0])
    if min(lengths) < FEWEST_WINDOWS * window:
        return None
    step = max(STEP, max(lengths) / MOST)
    ours, theirs = _wheel_speeds(recording, nominal, step, window), _pose_speeds(recording, step, window)
    lags, overlap, rho = _correlations(ours, theirs)
    offsets = wheels[0] - poses[0] + lags * step
    searched = (overlap >= LEAST_OVERLAP * np.max(overlap)) | (np.abs(offsets) <= NEAR)
    samples = overlap * step / window
    # Yaw rates of the same sign agree. Those of swapped wheels have the other one.
    g, swapped = (
        np.where(searched & (samples * one >= EVIDENCE), one, 0.0)
        for one in (_agreement(rho * [1.0, sign]) for sign in (1.0, -1.0))
    )
    if g.max() < _agreement(np.array([[EXPLAINED**0.5, 0.0]]))[0]:
        return None
    good = _maxima(g, max(0.5 * np.log(ALIKE), EVIDENCE / samples[np.argmax(g)]))
    best = _meant(good, offsets, overlap * step, step, recording.name)
    if not (searched[max(best - 1, 0)] and searched[min(best + 1, len(g) - 1)]):
        raise CalibrationError(
            f'{recording.name}: the wheels and the reference agree best at a time offset of '
            f'{offsets[best]:.3f} s, the end of the range that is searched: {REMEDY}'
        )
    other = int(np.argmax(samples * swapped))
    if samples[other] * swapped[other] > samples[best] * g[best]:
        # Swapped wheels are reported later, and must not be taken for a longer offset.
        best = min(best, other, key=lambda index: abs(offsets[index]))
        return float(offsets[best])
    return float(offsets[best]) + _vertex(g[best - 1 : best + 2]) * step


def _agreement(rho: Array) -> Array:
    """Return g, shape (l,), of correlations, shape (l, k). Negative ones do not agree."""
    explained = (1.0 - OFF_AXLE) * np.maximum(rho, 0.0) ** 2
    return np.asarray(-0.5 * np.log(1.0 - explained).sum(axis=1))


def _maxima(g: Array, close: float) -> list[int]:
    """Return the maxima of g that are as high as the largest but for `close`, with less between them."""
    least = float(g.max()) - close
    high = np.flatnonzero(g > least - close)
    hills = np.split(high, np.flatnonzero(np.diff(high) > 1) + 1)
    peaks = [int(hill[np.argmax(g[hill])]) for hill in hills]
    return [peak for peak in peaks if g[peak] >= least]


def _meant(good: list[int], offsets: Array, overlap: Array, step: float, name: str) -> int:
    """Return which of some offsets is meant: the nearest to zero, if it has the largest overlap.

    Raises:
        CalibrationError: A nearer one has a smaller overlap.
    """
    nearest = sorted(good, key=lambda index: abs(offsets[index]))
    widest = max(good, key=lambda index: overlap[index])
    # The overlap of recordings of the same length falls by a step with each step from the widest, that
    # of one within the other does not. Half of it tells them apart.
    fair = abs(nearest[0] - widest) * step / 2.0
    if overlap[widest] - overlap[nearest[0]] <= fair:
        return nearest[0]
    listed = ', '.join(
        f'{offsets[index]:.3f} s (overlap {overlap[index]:.0f} s)' for index in nearest[:4]
    )
    raise CalibrationError(
        f'{name}: the motion repeats itself, and the wheels and the reference agree about as well at '
        f'several time offsets: {listed}: {REMEDY}'
    )


def _vertex(values: Array) -> float:
    """Return where a parabola through three values is largest, from -1 to 1 about the middle one."""
    low, middle, high = values.tolist()
    bend = low - 2.0 * middle + high
    return min(1.0, max(-1.0, 0.5 * (low - high) / bend)) if bend < 0.0 else 0.0


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
        # Speeds that hardly change correlate with nothing.
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
    limits = OUTLYING * np.percentile(np.abs(speeds), 95, axis=0) + 1e-9
    return np.asarray(np.clip(speeds, -limits, limits))
