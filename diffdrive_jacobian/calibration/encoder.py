"""Angles of a wheel from the readings of an encoder with finite steps, sampled at finite rate.

A reading is constant while the wheel turns by one step. Only its changes show where the wheel is. In
between, the wheel is taken to turn at the speed that they show. Where the reading is constant for
longer, the wheel may be anywhere within the step: the angle is its middle, and the reading error that of
a uniform distribution.

So an angle is about its mean given all readings, and the error does not correlate with it. Differences
of the readings themselves have errors that do, which would bias the estimate.
"""

from __future__ import annotations

import math

import numpy as np

from diffdrive_jacobian.calibration.measurements import Array, Segment

INTO_REST = 2.0 / 3.0
"""Time from a change of the reading to the middle of a step in which the wheel stops, relative to the
duration of the step before. It is the straight line nearest to the mean of wheels that stop anywhere."""
LONG = 1.25
"""Duration of a step in which the wheel stops, relative to those before and after together."""
PERIOD = 0.025
"""Period to which the angles are interpolated where they are recorded less often (s)."""


def located(time: Array, readings: Array) -> tuple[Array, Array]:
    """Return the angles of a wheel at the times of its readings, and their standard deviations.

    Both have shape (m,). Readings that change with each sample are returned as they are. The deviation
    is 0 where the wheel is located between two changes of its reading. Elsewhere, also where the reading
    changes with each sample, it is that of a step, if the readings show one.

    Args:
        time: Increasing, shape (m,) (s).
        readings: Shape (m,) (rad).
    """
    changes = np.flatnonzero(np.diff(readings))
    first, last = np.append(0, changes + 1), np.append(changes, len(time) - 1)
    level = readings[first]
    bounds = np.concatenate([time[:1], (time[changes] + time[changes + 1]) / 2.0, time[-1:]])
    single = first == last
    jumps, duration = np.diff(level), np.diff(bounds)
    steps = np.abs(jumps)[~single[:-1] & ~single[1:]]
    deviation = float(np.median(steps)) / 12.0**0.5 if len(steps) else 0.0
    before, after = np.append(0.0, duration[:-1]), np.append(duration[1:], 0.0)
    stops = single | (duration > LONG * (before + after))
    # Where the wheel turns back it ends up somewhere within the step, too.
    stops[1:-1] |= jumps[:-1] * jumps[1:] < 0.0
    inset = np.concatenate([[0.0], np.where(single, 0.5, INTO_REST) * duration, [0.0]])
    middle = (time[first] + time[last]) / 2.0
    begin = np.clip(bounds[:-1] + inset[:-2], time[first], middle)[stops]
    end = np.clip(bounds[1:] - inset[2:], middle, time[last])[stops]
    unknown = np.full(len(level), deviation)[stops]
    knots = np.concatenate([bounds[1:-1], begin, end])
    angles = np.concatenate([(level[:-1] + level[1:]) / 2.0, level[stops], level[stops]])
    deviations = np.concatenate([0.0 * jumps, unknown, unknown])
    order = np.argsort(knots, kind='stable')
    knots = knots[order]
    return np.interp(time, knots, angles[order]), np.interp(time, knots, deviations[order])


def densified(time: Array, angles: Array) -> tuple[Array, Array]:
    """Return times at most about `PERIOD` apart and the angles there, by monotone cubic interpolation.

    Args:
        time: Increasing, shape (m,), m at least 2 (s).
        angles: Shape (m, 2) (rad).
    """
    parts = max(1, int(np.ceil(float(np.median(np.diff(time))) / PERIOD - 1e-6)))
    h = np.diff(time)[:, None]
    speed = np.diff(angles, axis=0) / h
    # The harmonic mean of the speeds before and after keeps each piece monotone (Fritsch and Butland).
    before, after = speed[:-1], speed[1:]
    product = np.maximum(before * after, 0.0)
    mean = np.where(product > 0.0, 2.0 * product / np.where(product > 0.0, before + after, 1.0), 0.0)
    slope = np.concatenate([speed[:1], mean, speed[-1:]])
    first, second = angles[:-1], angles[1:]
    times, values = [], []
    for u in (np.arange(parts) / parts).tolist():
        times.append(time[:-1] + u * h[:, 0])
        values.append(
            first
            + (second - first) * u**2 * (3.0 - 2.0 * u)
            + h * u * (1.0 - u) * (slope[:-1] * (1.0 - u) - slope[1:] * u)
        )
    dense = np.stack(values, axis=1).reshape(-1, 2)
    return (
        np.append(np.stack(times, axis=1).reshape(-1), time[-1]),
        np.concatenate([dense, angles[-1:]]),
    )


def poses_apart(segment: Segment, steps: float) -> int:
    """Return after how many poses, at least 1, the wheels have usually turned by some encoder steps."""
    step = 12.0**0.5 * float(np.max(segment.wheel_errors, initial=0.0))
    angles = [np.interp(segment.time, segment.wheel_time, one) for one in segment.wheel_angles.T]
    turned = float(np.median(np.abs(np.diff(angles)).max(axis=0)))
    return max(1, math.ceil(steps * step / turned)) if turned > 0.0 else 1
