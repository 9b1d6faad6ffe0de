"""A run in a few numbers: what became of its goals, how long it took, and its greatest errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_jacobian.bags.timeline import Array, Indices, Timeline, on_axis
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
    law: str
    """Control law of the last goal or path; '': not known."""
    gains: Mapping[str, str]
    """Its gains with their units, by name; the first and the last value of those that were changed."""

    @property
    def described(self) -> str:
        """What became of the goals and when, and the distance travelled."""
        when = 'within' if self.outcome == 'not arrived' else 'after'
        outcome = '' if self.outcome == 'no goal' else f'{self.outcome} {when} '
        outcome = 'refused, ' if self.outcome == 'refused' else outcome
        return f'{outcome}{self.seconds:.1f} s, {self.length:.2f} m'


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
    law, gains = _law(one, path=on_path) if driven else ('', {})
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
        law=law,
        gains=gains,
    )


def table_of(names: Sequence[str], summaries: Sequence[RunSummary]) -> list[str]:
    """Return the lines of a table of runs. Columns that no run has are left out."""
    columns = {
        'run': [printable(name) for name in names],
        'outcome': [one.outcome for one in summaries],
        'time': [f'{one.seconds:.1f} s' for one in summaries],
        'length': [f'{one.length:.2f} m' for one in summaries],
        'to the goal': [_with_unit(one.distance, '.3f', 'm') for one in summaries],
        'late': [_with_unit(one.late, '.1f', 's') for one in summaries],
        'max across': [_with_unit(one.across, '.3f', 'm') for one in summaries],
        'max bearing error': [_with_unit(one.bearing_error, '.2f', 'rad') for one in summaries],
        'max v': [f'{one.v:.2f} m/s' for one in summaries],
        'max omega': [f'{one.omega:.2f} rad/s' for one in summaries],
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


def _law(one: Timeline, *, path: bool) -> tuple[str, dict[str, str]]:
    """Return the law of goals or of paths that drove last, and what its gains were from the start."""
    since, runs = zip(*one.run.configurations(), strict=True)
    at = on_axis(one.run, since)
    # From the one that was valid at the start to the last before the end.
    first = max(int(np.count_nonzero(at <= one.start)) - 1, 0)
    last = len(at) if np.isnan(one.end) else int(np.count_nonzero(at <= one.end))
    name, gains = '', dict[str, list[str]]()
    for run in runs[first : max(last, first + 1)]:
        chosen = chosen_law(run.of_node('go_to_goal'), path=path)
        if chosen.name != name:
            name, gains = chosen.name, {}
        for gain in chosen.gains:
            value = chosen.values[gain.name]
            values = gains.setdefault(gain.name, [])
            text = f'{value:g}{f" {gain.unit}" if gain.unit else ""}'
            if not np.isnan(value) and values[-1:] != [text]:
                values.append(text)
    return name, {gain: _changes(values) for gain, values in gains.items() if values}


def _changes(values: Sequence[str]) -> str:
    between = ', ..., ' if len(values) > 2 else ', then '
    return values[0] if len(values) == 1 else f'{values[0]}{between}{values[-1]}'
