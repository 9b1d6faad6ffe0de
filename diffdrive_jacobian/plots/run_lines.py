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

"""The lines of a run that are drawn: measured, commanded, and limits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from diffdrive_jacobian.bags.run import number
from diffdrive_jacobian.bags.timeline import Array, Indices, Timeline, on_axis, seconds

_TWIST = {'v': 0, 'omega': 1}
_WHEEL = {'right': 0, 'left': 1}
_BODY = ('virtual_robot', 'go_to_goal')
_LIMITS = {
    'v': (_BODY, 'linear.x.max_velocity', 'linear.x.min_velocity'),
    'omega': (_BODY, 'angular.z.max_velocity', 'angular.z.min_velocity'),
    'right': (('virtual_robot', 'wheel_bridge'), 'max_wheel_velocity', ''),
}
"""Quantity to the nodes that limit it, and their parameters of the upper and the lower limit."""


def measured(one: Timeline, quantity: str) -> Array:
    """Return the measured values of a quantity, shape (m, 2); m may be 0."""
    run = one.run
    if quantity in _WHEEL:
        values = np.column_stack([seconds(run, run.wheels), run.wheels.values[:, _WHEEL[quantity]]])
        return line(values, _back_in_time(values))
    if quantity in _TWIST:
        values = run.odometry.values[:, 3 + _TWIST[quantity]]
        return line(np.column_stack([one.time, values]), one.breaks)
    error: Array = getattr(one, quantity)
    jumps = np.abs(np.diff(error)) > (np.inf if quantity == 'distance' else np.pi)
    breaks = np.union1d(one.breaks, np.flatnonzero(jumps | (np.diff(one.goal) != 0)) + 1)
    return line(np.column_stack([one.time, error]), breaks)


def commanded(one: Timeline, quantity: str) -> Array:
    """Return the commanded values of a quantity, each valid until the next, shape (m, 2); m may be 0."""
    run = one.run
    if quantity in _WHEEL:
        series, column = run.wheel_commands, _WHEEL[quantity]
    elif quantity in _TWIST:
        series, column = run.cmd_vel if len(run.cmd_vel) else run.cmd_vel_out, _TWIST[quantity]
    else:
        return np.empty((0, 2))
    return _continued(one, np.column_stack([seconds(run, series), series.values[:, column]]))


def limits(one: Timeline) -> dict[str, Array]:
    """Return the tightest limits of all nodes, by quantity: the lower and the upper one, each a line
    (s, and m/s or rad/s), shape (2, m, 2). NaN: no limit.
    """
    rows: dict[str, list[list[list[float]]]] = {name: [] for name in _LIMITS}
    for since, run in one.run.configurations():
        time = max(0.0, float(on_axis(run, [since])[0])) if since else 0.0
        for name, (nodes, upper, lower) in _LIMITS.items():
            values = [run.of_node(node) for node in nodes]
            most = [number(one.get(upper)) for one in values]
            least = [number(one.get(lower)) for one in values]
            least = [-high if np.isnan(low) else low for low, high in zip(least, most, strict=True)]
            bounds = _tightest(max, least), _tightest(min, most)
            rows[name].append([[time, bound] for bound in bounds])
    found = {
        name: np.array([_continued(one, bound) for bound in np.swapaxes(np.array(values), 0, 1)])
        for name, values in rows.items()
    }
    return {**found, 'left': found['right']}


def _tightest(choose: Callable[[list[float]], float], bounds: list[float]) -> float:
    return choose([bound for bound in bounds if not np.isnan(bound)] or [np.nan])


def _continued(one: Timeline, rows: Array) -> Array:
    """Return a line whose last value is continued to the end of the run, broken where time goes back."""
    if len(rows):
        rows = np.vstack([rows, [max(one.time[-1], rows[-1, 0]), rows[-1, 1]]])
    return line(rows, _back_in_time(rows))


def _back_in_time(rows: Array) -> Indices:
    """Return before which rows time goes back."""
    return np.flatnonzero(np.diff(rows[:, 0]) < 0.0) + 1


def line(rows: Array, breaks: Indices) -> Array:
    """Return a line that is broken before some of its rows, and where it is not finite."""
    return np.insert(np.where(np.isfinite(rows), rows, np.nan), breaks, np.nan, axis=0)
