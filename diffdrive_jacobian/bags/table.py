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

"""A recorded run as a table with one row for each odometry message, and as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping

import numpy as np

from diffdrive_jacobian.bags.run import Run, Series
from diffdrive_jacobian.bags.timeline import Array, Timeline, seconds, timeline
from diffdrive_jacobian.time_units import NANOSECONDS

DECIMALS = 9
"""Decimal places of the values in a CSV file. Its times are exact to the nanosecond."""
COLUMNS: Mapping[str, Callable[[Timeline], Array]] = {
    'time_s': lambda one: one.time,
    'x_m': lambda one: one.run.odometry.values[:, 0],
    'y_m': lambda one: one.run.odometry.values[:, 1],
    'theta_rad': lambda one: one.run.odometry.values[:, 2],
    'v_mps': lambda one: one.run.odometry.values[:, 3],
    'omega_radps': lambda one: one.run.odometry.values[:, 4],
    'distance_m': lambda one: one.distance,
    'bearing_error_rad': lambda one: one.bearing_error,
    'v_command_mps': lambda one: _command(one)[:, 0],
    'omega_command_radps': lambda one: _command(one)[:, 1],
    'omega_right_radps': lambda one: _interpolated(one, one.run.wheels)[:, 0],
    'omega_left_radps': lambda one: _interpolated(one, one.run.wheels)[:, 1],
    'goal_heading_error_rad': lambda one: one.goal_heading_error,
    'beyond_goal_m': lambda one: _beyond_goal(one),
    'path_progress_m': lambda one: one.progress,
    'along_path_m': lambda one: one.along,
    'across_path_m': lambda one: one.across,
    'path_heading_error_rad': lambda one: one.path_heading_error,
    'late_s': lambda one: one.late,
}
"""The columns with their units, and how each is computed, shape (n,)."""


def table(run: Run) -> dict[str, Array]:
    """Return the `COLUMNS` of a run by name, each with one value for each odometry message.

    Time counts from the first odometry message. The command is the latest one at that time: as applied
    (`cmd_vel_out`), or as sent (`cmd_vel`) if that was not recorded. Wheel speeds are interpolated
    linearly between the messages of `joint_states`. Beyond the goal is along the line from where the
    robot was when it began to drive there, negative before it: the largest value is the overshoot.
    Unknown values are NaN.

    Raises:
        BagError: There is no odometry.
    """
    one = timeline(run)
    return {name: column(one) for name, column in COLUMNS.items()}


def _command(one: Timeline) -> Array:
    """Return the latest command at each odometry message, shape (n, 2)."""
    run = one.run
    return _latest(one, run.cmd_vel_out if len(run.cmd_vel_out) else run.cmd_vel)


def _beyond_goal(one: Timeline) -> Array:
    """Return how far the axle centre is beyond its goal at each odometry message, shape (n,) (m)."""
    places, found = one.run.odometry.values[:, :2], np.full(len(one.time), np.nan)
    for goal in np.unique(one.goal[one.goal >= 0]):
        rows = np.flatnonzero(one.goal == goal)
        target = one.run.goals.values[goal, :2]
        line = target - places[rows[0]]
        found[rows] = (places[rows] - target) @ (line / (np.hypot(*line) or 1.0))
    return found


def _latest(one: Timeline, series: Series) -> Array:
    """Return the latest values at each odometry message, NaN before the first one, shape (n, k)."""
    at, known = _clocks(one, series)
    last = np.searchsorted(known, at, side='right')
    return np.vstack([np.full((1, series.values.shape[1]), np.nan), series.values])[last]


def _interpolated(one: Timeline, series: Series) -> Array:
    """Return the value at each odometry message, NaN outside of the recorded times, shape (n, 2)."""
    at, known = _clocks(one, series)
    if not len(series):
        return np.full((len(at), 2), np.nan)
    columns = [np.interp(at, known, values, np.nan, np.nan) for values in series.values.T]
    return np.column_stack(columns)


def _clocks(one: Timeline, series: Series) -> tuple[Array, Array]:
    """Return times of the odometry and of a series that can be compared and do not decrease (s)."""
    times = one.time, seconds(one.run, series)
    if all((np.diff(time) >= 0.0).all() for time in times):
        return times
    start = one.run.odometry.received[0]
    return (one.run.odometry.received - start) / 1e9, (series.received - start) / 1e9


def decimal_seconds(nanoseconds: int) -> str:
    """Return a time as an exact decimal number (s)."""
    sign, (whole, rest) = '-' * (nanoseconds < 0), divmod(abs(nanoseconds), NANOSECONDS)
    return f'{sign}{whole}.{rest:09d}'.rstrip('0').rstrip('.')


def _decimal(value: float) -> str:
    """Return a number rounded to `DECIMALS` places; '': NaN."""
    if math.isnan(value):
        return ''
    text = f'{value:.{DECIMALS}f}'.rstrip('0').rstrip('.')
    return '0' if text == '-0' else text


def csv_text(run: Run) -> str:
    """Return a run as CSV, with a header line; the fields of unknown values are empty.

    Times are exact, values are rounded to `DECIMALS` places.

    Raises:
        BagError: The run has no odometry.
    """
    rows = np.column_stack([*table(run).values()]).tolist()
    stamps = (run.odometry.stamps - run.odometry.stamps[0]).tolist()
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(COLUMNS)
    for stamp, (_, *values) in zip(stamps, rows, strict=True):
        writer.writerow([decimal_seconds(stamp), *map(_decimal, values)])
    return text.getvalue()
