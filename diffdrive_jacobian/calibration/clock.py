"""The offset between the clocks of the wheels and of the reference, from the speeds that both show.

Forward speed and yaw rate of both are correlated at all offsets. With the correlations rho of N
independent speeds in the overlap, `N g` with `g = -1/2 sum(log(1 - rho^2))` is the log-likelihood ratio
against speeds that have nothing to do with each other. The offset has the largest g. A motion that
repeats itself agrees as well at others: then the one nearest to zero must also have the largest overlap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.model import Array, CalibrationDrive, CalibrationError
from diffdrive_jacobian.calibration.motion import Geometry

WINDOW, STEP = 0.5, 0.1
"""Time over which speeds are means, and time between them, at least (s). Robots of this kind change
their speed within about half a second; the estimate itself corrects an error of some tenths."""
MOST = 1 << 17
"""Largest number of speeds: four hours. Longer drives have longer steps."""
LEAST_OVERLAP, NEAR = 0.5, 5.0
"""Overlap, as a share of the shorter recording, up to which offsets are searched, and offset up to which
they are searched whatever the overlap (s): clocks that agree, in recordings that overlap little."""
EVIDENCE = 20.0
"""Log-likelihood ratio below which an agreement may be chance. By chance one offset exceeds it with the
probability exp(-20) = 2e-9, and one of `MOST` with 3e-4."""
EXPLAINED = 0.75
"""Share of the variance of the speeds that an offset explains at least."""
ALIKE = 2.0
"""Ratio of the variances that they do not explain up to which two offsets are about as good."""
OFF_AXLE = 0.01
"""Share of the variance that is never explained: the speeds of a sensor off the axle are not those of
the wheels."""
REMEDY = 'synchronize the clocks, or give the offset (--time-offset of calibrate_run)'


@dataclass(frozen=True, kw_only=True, slots=True)
class Agreement:
    """How well the speeds of both agree at offsets that increase by equal steps."""

    offsets: Array
    """Shape (n,) (s)."""
    overlap: Array
    """Time that both have in common, shape (n,) (s)."""
    samples: Array
    """Number of independent speeds in it, shape (n,)."""
    searched: NDArray[np.bool_]
    """Whether the offset may be the one, shape (n,)."""
    g: Array
    """0 where it is not searched or may be chance, shape (n,)."""

    def best(self) -> int | None:
        """Return the index of the largest g; None: no offset explains enough."""
        largest = int(np.argmax(self.g))
        return largest if self.g[largest] >= -0.5 * np.log(1.0 - EXPLAINED) else None

    def about_as_good(self, best: int) -> list[int]:
        """Return the indices of the maxima of g that are as high as the best one, with it."""
        close = max(0.5 * np.log(ALIKE), EVIDENCE / self.samples[best])
        least = self.g[best] - close
        # Between two maxima g is lower by as much.
        high = np.flatnonzero(self.g > least - close)
        hills = np.split(high, np.flatnonzero(np.diff(high) > 1) + 1)
        peaks = [int(hill[np.argmax(self.g[hill])]) for hill in hills]
        return [peak for peak in peaks if self.g[peak] >= least]

    def refined(self, index: int) -> float:
        """Return the offset of the maximum of a parabola through g at an index and beside it (s)."""
        low, middle, high = self.g[index - 1 : index + 2].tolist()
        bend = low - 2.0 * middle + high
        shift = 0.5 * (low - high) / bend if bend < 0.0 else 0.0
        step = float(self.offsets[1] - self.offsets[0])
        return float(self.offsets[index]) + min(1.0, max(-1.0, shift)) * step


def time_offset(recording: CalibrationDrive, nominal: Geometry) -> float | None:
    """Return what must be added to the times of the poses; None: the speeds do not show it.

    Raises:
        CalibrationError: They show several, or one at the end of the range that is searched.
    """
    wheels, poses = recording.wheel_time, recording.pose_time
    window = max(WINDOW, *(float(np.median(np.diff(time))) for time in (wheels, poses)))
    lengths = float(wheels[-1] - wheels[0]), float(poses[-1] - poses[0])
    if min(lengths) < 3.0 * window:
        return None
    step = max(STEP, max(lengths) / MOST)
    ours, theirs = _wheel_speeds(recording, nominal, step, window), _pose_speeds(recording, step, window)
    lags, overlap, correlations = _correlations(ours, theirs)
    offsets = wheels[0] - poses[0] + lags * step
    samples = overlap * step / window
    searched = (overlap >= LEAST_OVERLAP * np.max(overlap)) | (np.abs(offsets) <= NEAR)

    def agreement(turning: float) -> Agreement:
        """Return how the speeds agree if the yaw rates have the same sign, 1, or the other one, -1."""
        rho = np.maximum(correlations * [1.0, turning], 0.0)
        g = -0.5 * np.log(1.0 - (1.0 - OFF_AXLE) * rho**2).sum(axis=1)
        return Agreement(
            offsets=offsets,
            overlap=overlap * step,
            samples=samples,
            searched=searched,
            g=np.where(searched & (samples * g >= EVIDENCE), g, 0.0),
        )

    same = agreement(1.0)
    largest = same.best()
    if largest is None:
        return None
    best = _nearest(same, same.about_as_good(largest), recording.name)
    # Swapped wheels turn the other way. That is reported later, and must not be taken for an offset.
    turned = agreement(-1.0)
    other = int(np.argmax(samples * turned.g))
    if samples[other] * turned.g[other] > samples[best] * same.g[best] and abs(offsets[other]) < abs(
        offsets[best]
    ):
        return float(offsets[other])
    return same.refined(best)


def _nearest(found: Agreement, good: list[int], name: str) -> int:
    """Return which of some good offsets is meant: the nearest to zero, with the largest overlap."""
    offsets, step = found.offsets, float(found.offsets[1] - found.offsets[0])
    widest = max(good, key=lambda index: found.overlap[index])
    # The overlap of an offset that is not at the maximum changes by a step with each step.
    loss = {index: (found.overlap[widest] - found.overlap[index]) / step for index in good}
    fair = [index for index in good if loss[index] <= abs(index - widest) / 2.0]
    best = min(fair, key=lambda index: abs(offsets[index]))
    by_distance = sorted(good, key=lambda index: abs(offsets[index]))
    if by_distance[0] != best:
        listed = ', '.join(
            f'{offsets[index]:.3f} s (overlap {found.overlap[index]:.0f} s)' for index in by_distance[:4]
        )
        raise CalibrationError(
            f'{name}: the motion repeats itself, and the wheels and the reference agree about as well '
            f'at several time offsets: {listed}: {REMEDY}'
        )
    if not found.searched[max(best - 1, 0) : best + 2].all() or best in (0, len(offsets) - 1):
        raise CalibrationError(
            f'{name}: the wheels and the reference agree best at a time offset of {offsets[best]:.3f} '
            f's, the end of the range that is searched: {REMEDY}'
        )
    return best


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
    # One glitch must not outweigh the whole drive.
    limits = 4.0 * np.percentile(np.abs(speeds), 95, axis=0) + 1e-9
    return np.asarray(np.clip(speeds, -limits, limits))
