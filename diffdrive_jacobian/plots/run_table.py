"""A recorded run as a table with one row for each odometry message, and as a CSV file."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.run import Run, Series
from diffdrive_jacobian.bags.timeline import Timeline, seconds, timeline
from diffdrive_jacobian.plots.output_files import create
from diffdrive_jacobian.time_units import NANOSECONDS

__all__ = ['COLUMNS', 'table', 'write_csv']

COLUMNS = (
    *('time_s', 'x_m', 'y_m', 'theta_rad', 'v_mps', 'omega_radps'),
    *('distance_m', 'bearing_error_rad', 'v_command_mps', 'omega_command_radps'),
    *('omega_right_radps', 'omega_left_radps', 'goal_heading_error_rad', 'beyond_goal_m'),
    *('path_progress_m', 'along_path_m', 'across_path_m', 'path_heading_error_rad'),
    'late_s',
)
"""Columns of the table, with their units."""
DECIMALS = 9
"""Decimal places of the values in a CSV file. Its times are exact to the nanosecond."""


def table(run: Run) -> NDArray[np.float64]:
    """Return a run as an array, one row for each odometry message and one column for each of `COLUMNS`.

    Time counts from the first odometry message. The command is the latest one at that time: as applied
    (`cmd_vel_out`), or as sent (`cmd_vel`) if that was not recorded. Wheel speeds are interpolated
    linearly between the messages of `joint_states`. Beyond the goal is along the line from where the
    robot was when it began to drive there, negative before it: the largest value is the overshoot.
    Unknown values are NaN.

    Raises:
        BagError: There is no odometry.
    """
    one = timeline(run)
    commands = run.cmd_vel_out if len(run.cmd_vel_out) else run.cmd_vel
    return np.column_stack(
        [
            one.time,
            run.odometry.values,
            one.distance,
            one.bearing_error,
            _latest(one, commands),
            _interpolated(one, run.wheels),
            one.goal_heading_error,
            _beyond_goal(one),
            *(one.progress, one.along, one.across, one.path_heading_error, one.late),
        ]
    )


def _beyond_goal(one: Timeline) -> NDArray[np.float64]:
    """Return how far the axle centre is beyond its goal at each odometry message, shape (n,) (m)."""
    places, found = one.run.odometry.values[:, :2], np.full(len(one.time), np.nan)
    for goal in np.unique(one.goal[one.goal >= 0]):
        rows = np.flatnonzero(one.goal == goal)
        target = one.run.goals.values[goal, :2]
        line = target - places[rows[0]]
        found[rows] = (places[rows] - target) @ (line / (np.hypot(*line) or 1.0))
    return found


def _latest(one: Timeline, series: Series) -> NDArray[np.float64]:
    """Return the latest values at each odometry message, NaN before the first one, shape (n, k)."""
    at, known = _clocks(one, series)
    last = np.searchsorted(known, at, side='right')
    return np.vstack([np.full((1, series.values.shape[1]), np.nan), series.values])[last]


def _interpolated(one: Timeline, series: Series) -> NDArray[np.float64]:
    """Return the value at each odometry message, NaN outside of the recorded times, shape (n, 2)."""
    at, known = _clocks(one, series)
    if not len(series):
        return np.full((len(at), 2), np.nan)
    columns = [np.interp(at, known, values, np.nan, np.nan) for values in series.values.T]
    return np.column_stack(columns)


def _clocks(one: Timeline, series: Series) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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


def write_csv(run: Run, path: Path, *, replace: bool = False) -> None:
    """Write a run to a new CSV file with a header line; the fields of unknown values are empty.

    Times are exact, values are rounded to `DECIMALS` places. `replace`: as for `draw`.

    Raises:
        BagError: The run has no odometry.
        FileExistsError: The file exists.
        OSError: The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(COLUMNS)
    stamps = (run.odometry.stamps - run.odometry.stamps[0]).tolist()
    for stamp, (_, *values) in zip(stamps, table(run).tolist(), strict=True):
        writer.writerow([decimal_seconds(stamp), *map(_decimal, values)])
    create(path, text.getvalue().encode(), replace=replace)
