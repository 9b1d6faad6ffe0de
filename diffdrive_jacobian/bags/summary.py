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

"""A run in a few numbers: what became of its goals, how long it took, and its greatest errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_jacobian.bags.timeline import Array, Indices, Timeline, on_axis, seconds
from diffdrive_jacobian.parameters.chosen_law import chosen_law
from diffdrive_jacobian.text import printable

ROUNDING = 1e-6
"""Tolerance of times (s)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RunSummary:
    """A run. Greatest values are absolute ones; NaN: there is none."""

    outcome: str
    """Of the last goal or path: `arrived`, `canceled`, `aborted` or `not arrived`. `refused`: all were.
    `no goal`: there was none."""
    seconds: float
    """From the first goal or path to the end of the last one, or of the run (s). All is of this time."""
    length: float
    """Distance travelled (m)."""
    distance: float
    """Distance to the last goal at the end (m)."""
    bearing_error: float
    """Greatest error of the heading towards a goal (rad)."""
    across: float
    """Greatest distance from a path (m)."""
    late: float
    """How late a trajectory was at the end (s)."""
    v: float
    """Greatest speed (m/s)."""
    omega: float
    """Greatest yaw rate (rad/s)."""
    true_distance: float
    """Distance to the last goal, or the end of the last path, at the end by ground truth (m)."""
    laws: Mapping[str, Mapping[str, str]]
    """The control laws that drove, in order, with their gains and units by name: the first and the last
    value of those that were changed."""

    @property
    def described(self) -> str:
        """What became of the goals and when, and the distance travelled."""
        if self.outcome in ('no goal', 'refused'):
            return f'{self.outcome}, {self.seconds:.1f} s, {self.length:.2f} m driven'
        when = 'within' if self.outcome == 'not arrived' else 'after'
        text = f'{self.outcome} {when} {self.seconds:.1f} s, {self.length:.2f} m driven'
        if np.isnan(self.true_distance):
            return text
        # An arrival is the opinion of the odometry.
        opinion = 'by odometry ' if self.outcome == 'arrived' else ''
        return f'{opinion}{text}; truly {self.true_distance:.2f} m away'


def summary(one: Timeline) -> RunSummary:
    """Summarise a run: what it did from its first goal or path to the end of the last one."""
    driven = not np.isnan(one.start)
    start = one.start if driven else np.min(one.time)
    # Time may go back, and a goal may come after the last odometry.
    end = max(np.max(one.time) if np.isnan(one.end) else one.end, start)
    here = (one.time >= start - ROUNDING) & (one.time <= end + ROUNDING)
    speeds = one.run.odometry.values[here, 3:]
    on_path = _latest(one.path) > _latest(one.goal)
    outcome = 'not arrived' if driven else 'no goal'
    if not driven and len(one.run.goals) + len(one.run.planned_path):
        outcome = 'refused'
    if one.outcome.ended:
        outcome = one.outcome.word
    return RunSummary(
        outcome=outcome,
        seconds=float(end - start),
        length=float(np.ptp(one.travelled()[here])) if here.any() else 0.0,
        distance=np.nan if on_path else _last(one.distance[here]),
        bearing_error=_greatest(one.bearing_error[here]),
        across=_greatest(one.across[here]),
        late=_last(one.late[here]),
        v=_greatest(speeds[:, 0]),
        omega=_greatest(speeds[:, 1]),
        true_distance=_true_distance(one, end, on_path=on_path),
        laws=_laws(one) if driven else {},
    )


def table_of(names: Sequence[str], summaries: Sequence[RunSummary]) -> list[str]:
    """Return the lines of a table of runs. Columns that no run has are left out."""
    columns = {
        'run': [printable(name) for name in names],
        'outcome': [one.outcome for one in summaries],
        'time': [f'{one.seconds:.1f} s' for one in summaries],
        'length': [f'{one.length:.2f} m' for one in summaries],
        'to the goal': [_with_unit(one.distance, '.3f', 'm') for one in summaries],
        'truly': [_with_unit(one.true_distance, '.3f', 'm') for one in summaries],
        'late': [_with_unit(one.late, '.1f', 's') for one in summaries],
        'max across': [_with_unit(one.across, '.3f', 'm') for one in summaries],
        'max bearing error': [_with_unit(one.bearing_error, '.2f', 'rad') for one in summaries],
        'max v': [_with_unit(one.v, '.2f', 'm/s') for one in summaries],
        'max omega': [_with_unit(one.omega, '.2f', 'rad/s') for one in summaries],
    }
    shown = [[name, *cells] for name, cells in columns.items() if any(cells)]
    widths = [max(map(len, column)) for column in shown]
    return [
        '  '.join(
            f'{cell:{"<" if index < 2 else ">"}{width}}'
            for index, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in zip(*shown, strict=True)
    ]


def _with_unit(value: float, digits: str, unit: str) -> str:
    return '' if np.isnan(value) else f'{value:{digits}} {unit}'


def _greatest(values: Array) -> float:
    return float(np.nanmax(np.abs(values), initial=-1.0)) if np.isfinite(values).any() else np.nan


def _last(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known[-1]) if len(known) else np.nan


def _latest(which: Indices) -> int:
    """Return the last odometry at which there is a goal or a path; -1: none."""
    return int(np.flatnonzero(which >= 0)[-1]) if (which >= 0).any() else -1


def _true_distance(one: Timeline, end: float, *, on_path: bool) -> float:
    """Return the distance by ground truth at the end (m). NaN: it is not known."""
    truth = one.run.ground_truth
    here = np.flatnonzero(seconds(one.run, truth) <= end + ROUNDING)
    if not len(here) or np.isnan(one.start):
        return np.nan
    target = one.paths[-1].poses[-1] if on_path else one.run.goals.values[one.goals[-1]]
    return float(np.hypot(*(truth.values[here[-1], :2] - target[:2])))


def _laws(one: Timeline) -> dict[str, dict[str, str]]:
    """Return the laws that drove, and what their gains were while they did."""
    since, runs = zip(*one.run.configurations(), strict=True)
    at = on_axis(one.run, since)
    laws: dict[str, dict[str, list[str]]] = {}
    kinds = [(one.goal, False), (one.path, True)]
    for which, path in sorted(kinds, key=lambda kind: int(np.argmax(kind[0] >= 0))):
        driven = one.time[(which >= 0) & (np.isnan(one.end) | (one.time <= one.end + ROUNDING))]
        if not len(driven):
            continue
        # From the one that was valid at the start to the last before the end.
        first = max(int(np.count_nonzero(at <= driven.min() + ROUNDING)) - 1, 0)
        last = int(np.count_nonzero(at <= driven.max() + ROUNDING))
        for run in runs[first : max(last, first + 1)]:
            law = chosen_law(run.of_node('go_to_goal'), path=path)
            gains = laws.setdefault(law.name, {}) if law.name else {}
            for gain in law.gains:
                value, values = law.values[gain.name], gains.setdefault(gain.name, [])
                text = f'{value:g}{f" {gain.unit}" if gain.unit else ""}'
                if not np.isnan(value) and values[-1:] != [text]:
                    values.append(text)
    return {
        name: {gain: _changes(values) for gain, values in gains.items() if values}
        for name, gains in laws.items()
    }


def _changes(values: Sequence[str]) -> str:
    between = ', ..., ' if len(values) > 2 else ', then '
    return values[0] if len(values) == 1 else f'{values[0]}{between}{values[-1]}'
