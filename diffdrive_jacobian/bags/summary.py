"""A run in a few numbers: what became of its goals, how long it took, and its greatest errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_jacobian.bags.timeline import Array, Indices, Timeline
from diffdrive_jacobian.parameters.chosen_law import chosen_law
from diffdrive_jacobian.text import printable


@dataclass(frozen=True, kw_only=True, slots=True)
class Summary:
    """A run. Greatest values are absolute ones; NaN: there is none."""

    outcome: str
    """Of the last goal or path: `arrived`, `canceled`, `aborted` or `not arrived`; `no goal`."""
    seconds: float
    """From the first goal to the end of the last one; without goals, or an end, of the whole run (s)."""
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
    """Its gains with their units, by name; several values in order if they were changed."""

    @property
    def described(self) -> str:
        """What became of the goals and when, and the distance travelled."""
        when = 'within' if self.outcome == 'not arrived' else 'after'
        outcome = '' if self.outcome == 'no goal' else f'{self.outcome} {when} '
        return f'{outcome}{self.seconds:.1f} s, {self.length:.2f} m'


def summary(one: Timeline) -> Summary:
    """Summarise a run."""
    goals = not np.isnan(one.start)
    start = one.start if goals else one.time[0]
    end = one.time[-1] if np.isnan(one.end) else one.end
    odometry = one.run.odometry.values
    law, gains = _law(one)
    outcome = one.outcome.word if one.outcome.ended else 'not arrived' if goals else 'no goal'
    return Summary(
        outcome=outcome,
        seconds=float(end - start),
        length=float(one.travelled()[-1]),
        distance=_last(one.distance),
        bearing_error=_greatest(one.bearing_error),
        across=_greatest(one.across),
        late=_last(one.late),
        v=_greatest(odometry[:, 3]),
        omega=_greatest(odometry[:, 4]),
        law=law,
        gains=gains,
    )


def table_of(names: Sequence[str], summaries: Sequence[Summary]) -> list[str]:
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


def _law(one: Timeline) -> tuple[str, dict[str, str]]:
    """Return the law that drove last, and what its gains were over the run."""
    path = _latest(one.path) > _latest(one.goal)
    name, gains = '', dict[str, list[str]]()
    for _, run in one.run.configurations():
        chosen = chosen_law(run.of_node('go_to_goal'), path=path)
        if chosen.name != name:
            name, gains = chosen.name, {}
        for gain in chosen.gains:
            text = f'{chosen.values[gain.name]:g}{f" {gain.unit}" if gain.unit else ""}'
            values = gains.setdefault(gain.name, [])
            if values[-1:] != [text]:
                values.append(text)
    return name, {gain: ', then '.join(values) for gain, values in gains.items()}
