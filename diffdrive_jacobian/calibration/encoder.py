"""Angles of a wheel from the readings of an encoder with finite steps, sampled at finite rate.

A reading is constant while the wheel turns by one step, so that only its changes tell where the wheel is.
In between, the wheel is taken to turn at the speed that the changes show. Where the reading is constant for
longer, the wheel may be anywhere within the step: the angle is its middle, and the reading error that of a
uniform distribution. An encoder that changes with each sample is taken at its word.

So an angle is about its mean given the readings, and the error does not correlate with it: it acts like
noise of the reference. Differences of the readings themselves would bias the estimate.
"""

from __future__ import annotations

import numpy as np

from diffdrive_jacobian.calibration.measurements import Array

INTO_REST = 2.0 / 3.0
"""Time from a change of the reading to the middle of a step in which the wheel stops, relative to the
duration of the step before. On average a wheel that may stop anywhere within the step follows that line."""
PERIOD = 0.025
"""Period to which the angles are interpolated where they are recorded less often (s)."""


def located(time: Array, readings: Array) -> tuple[Array, Array]:
    """Return the angles of a wheel at the times of its readings, and their standard deviations.

    Both have shape (m,). Readings that change with each sample are returned as they are, with the deviation
    of the step if other readings show one, else 0. Angles are those of the middle of a step if the readings
    are.

    Args:
        time: Increasing, shape (m,) (s).
        readings: Shape (m,) (rad).
    """
    changes = np.flatnonzero(np.diff(readings))
    first, last = np.append(0, changes + 1), np.append(changes, len(time) - 1)
    level = readings[first]
    edges = (time[changes] + time[changes + 1]) / 2.0
    at_edges = (level[:-1] + level[1:]) / 2.0
    bounds = np.concatenate([time[:1], edges, time[-1:]])
    durations = np.where(first == last, 0.0, np.diff(bounds))
    steps = np.abs(np.diff(level))[(durations[:-1] > 0.0) & (durations[1:] > 0.0)]
    deviation = float(np.median(steps)) / 12.0**0.5 if len(steps) else 0.0
    inset = np.concatenate([[0.0], INTO_REST * durations, [0.0]])
    begin = np.maximum(time[first], bounds[:-1] + inset[:-2])
    end = np.minimum(time[last], bounds[1:] - inset[2:])
    rest = begin <= end
    knots = np.concatenate([edges, begin[rest], end[rest]])
    angles = np.concatenate([at_edges, level[rest], level[rest]])
    known = np.concatenate([np.zeros(len(edges)), np.full(2 * np.count_nonzero(rest), deviation)])
    order = np.argsort(knots, kind='stable')
    return (
        np.interp(time, knots[order], angles[order]),
        np.interp(time, knots[order], known[order]),
    )


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
