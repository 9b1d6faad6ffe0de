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

"""The angle of a wheel from the readings of its encoder, also where its steps or its samples are coarse.

It is the mean given all readings: a line through these points, by time and angle.

    moving            halfway between two readings, at the time of the change
    stopping          in the middle of a step (its reading), some time after the change into it
    at rest           there
    starting          there, until as long before the change out of it

    turning by more than a step from sample to sample: the reading

At rest, and where the reading changes with each sample, the error is that of a uniform distribution
within the step. At rest it does not correlate with the angle, as that of the readings themselves would.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.model import Array

INTO_REST = 2.0 / 3.0
"""Time from a change of the reading to the middle of a step in which the wheel stops, relative to the
duration of the step before. It is the straight line nearest to the mean of wheels that stop anywhere."""
LONG = 1.25
"""Duration of a step in which the wheel stops, relative to those before and after together."""
ROUNDED, MULTIPLES, ALTERNATING = 0.1, 0.9, 0.1
"""How far from a multiple of a step a number is, share of the numbers that are no farther (of any
numbers it is 0.2), and share of changes that differ by one step from the one before."""
PERIOD = 0.025
"""Period to which the angles are interpolated where they are recorded less often (s)."""


def located(time: Array, readings: Array) -> tuple[Array, Array, Array]:
    """Return times at most about `PERIOD` apart, the angles of both wheels, and their deviations.

    Args:
        time: Times of the readings, shape (m,) (s).
        readings: Of the right and the left wheel, shape (m, 2) (rad).
    """
    both = [between_readings(time, one) for one in readings.T]
    dense, angles = densified(time, np.column_stack([angles for angles, _ in both]))
    errors = [np.interp(dense, time, deviations) for _, deviations in both]
    return dense, angles, np.column_stack(errors)


def between_readings(time: Array, readings: Array) -> tuple[Array, Array]:
    """Return the angles of a wheel at the times of its readings, and their standard deviations.

    Readings that change with each sample are returned as they are. The deviation is 0 where the wheel is
    located between two changes of its reading. Elsewhere, also where the reading changes with each
    sample, it is that of a step, if the readings show one.
    """
    changes = np.flatnonzero(np.diff(readings))
    first, last = np.append(0, changes + 1), np.append(changes, len(time) - 1)
    level = readings[first]
    bounds = np.concatenate([time[:1], (time[changes] + time[changes + 1]) / 2.0, time[-1:]])
    single = first == last
    jumps, duration = np.diff(level), np.diff(bounds)
    deviation = encoder_step(jumps, ~single[:-1] & ~single[1:]) / 12.0**0.5
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


def encoder_step(jumps: Array, repeated: NDArray[np.bool_]) -> float:
    """Return the step of an encoder, from the changes of its readings; 0: there is none.

    Args:
        jumps: All changes, shape (n,).
        repeated: Whether both readings, before and after, stay for several samples, shape (n,).
    """
    if repeated.any():
        return float(np.median(np.abs(jumps[repeated])))
    # At a constant speed of some steps for each sample, successive changes differ by one step or none.
    differences = np.abs(np.diff(jumps))
    differences = differences[differences > 1e-9]
    if not len(differences):
        return 0.0
    step = float(np.min(differences))
    multiples = np.round(differences / step)
    of_step = np.abs(differences / step - multiples) < ROUNDED
    single = np.count_nonzero(of_step & (multiples == 1.0))
    return step if np.mean(of_step) > MULTIPLES and single > ALTERNATING * len(jumps) else 0.0


def densified(time: Array, angles: Array) -> tuple[Array, Array]:
    """Return times at most about `PERIOD` apart and angles there, by monotone cubic interpolation."""
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
