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

"""The panels of a figure of runs: quantities over time with commands, limits, faults and violations."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from diffdrive_jacobian.bags.timeline import Array, Timeline, on_axis
from diffdrive_jacobian.plots.run_lines import commanded, limits, measured
from diffdrive_jacobian.plots.run_plane import MARKED
from diffdrive_jacobian.text import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

STILL = 1e-3
"""Least range of a quantity over time, in its unit."""
NEAR = 0.7
"""Share of a limit that a quantity must reach so that the limit is drawn."""
LIMIT = (0, (6, 3))
HEADING = (0, (1, 1.2))
COMMAND = '#d2d2d2'
FAULT_COLORS, FAULT_ALPHA = ('#E69F00', '#56B4E9', '#CC79A7', '#F0E442', '#009E73'), 0.25
"""Colors of the faults. Later ones share them."""
VIOLATION = '#B00020'
"""Color of violations."""
LATE = 0.1
"""Lateness of a trajectory from which on it is drawn (s)."""
NAMED, FAULT_LABEL = 6, 60
"""Number of faults that the legend names, and length beyond which a name is cut."""
LABELS = {
    'distance': 'distance to goal [m]',
    'bearing_error': 'bearing error [rad]',
    'across': 'across path [m]',
    'along': 'along path [m]',
    'path_heading_error': 'heading to path [rad]',
    'v': r'speed $v$ [m/s]',
    'omega': r'yaw rate $\omega$ [rad/s]',
    'right': r'right wheel $\omega_R$ [rad/s]',
    'left': r'left wheel $\omega_L$ [rad/s]',
    'late': 'behind the times [s]',
}
"""Quantities over time in their order, and the titles of their panels."""
MOTION = 1e-3
"""Distance from the first place at which the robot has begun to move (m)."""


class FaultSpan(NamedTuple):
    """When a fault was there."""

    fault: str
    """The fault as Python source."""
    begin: float
    """Time since the first odometry (s)."""
    end: float
    """End (s); that of the run if it is not known."""


class ViolationMark(NamedTuple):
    """When a property was violated."""

    time: int
    """Time of the recorder's clock (ns)."""
    label: str
    """The property, for the legend."""


def quantities(timelines: Sequence[Timeline]) -> list[str]:
    """Return the quantities that are drawn.

    Of the errors on a path along where there is a trajectory, else of the heading. And how late the
    robot is, where the times of a trajectory waited for it.
    """
    runs = [one.run for one in timelines]
    shown = {'v', 'omega'}
    if any(len(one.goals) for one in timelines):
        shown |= {'distance', 'bearing_error'}
    if any(len(run.wheels) + len(run.wheel_commands) for run in runs):
        shown |= {'right', 'left'}
    if any(one.paths for one in timelines):
        timed = any(np.isfinite(one.along).any() for one in timelines)
        shown |= {'across', 'along' if timed else 'path_heading_error'}
        if any(np.nanmax(one.late, initial=0.0) > LATE for one in timelines):
            shown.add('late')
    return [name for name in LABELS if name in shown]


def zero(one: Timeline) -> float:
    """Return where the axis of time has its zero: at the first goal, else at the first odometry (s)."""
    return 0.0 if np.isnan(one.start) else one.start


def beginning(one: Timeline) -> float:
    """Return the first time at which something happens: the first goal, or motion before it (s)."""
    places = one.run.odometry.values[:, :2]
    # Time may go back.
    moved = one.time[np.hypot(*(places - places[0]).T) > MOTION]
    return float(np.min(moved, initial=zero(one))) - zero(one)


def window(timelines: Sequence[Timeline]) -> tuple[float, float]:
    """Return the ends of the axis of time (s), without the waiting for the first goal."""
    begins = [*map(beginning, timelines)]
    ends = [max(float(np.max(one.time)) - zero(one), 0.0) for one in timelines]
    margin = 0.02 * max(max(ends) - min(begins), STILL)
    return min(begins) - margin, max(ends) + margin


def draw(
    panel: Axes, one: Timeline, quantity: str, color: str, style: Any, *, alone: bool
) -> set[float]:
    """Draw a quantity and, where it comes near them, its limits; of a single run its commands.

    Returns:
        The limits that were drawn, in the unit of the quantity.
    """
    shift = np.array([zero(one), 0.0])
    panel.axhline(0.0, color='#bbbbbb', lw=0.8, zorder=1)
    # So that the rounding of a robot at rest does not fill the panel.
    panel.update_datalim([(0.0, -STILL), (0.0, STILL)])
    command, measurement = commanded(one, quantity) - shift, measured(one, quantity) - shift
    if alone:
        panel.plot(*command.T, color=COMMAND, lw=4.5, drawstyle='steps-post', zorder=1.5)
    elif not len(measurement):
        panel.plot(*command.T, color=color, ls=style, lw=1.5, drawstyle='steps-post')
    panel.plot(*measurement.T, color=color, ls=style, lw=1.5)
    if quantity == 'bearing_error' and np.isfinite(one.goal_heading_error).any():
        error = measured(one, 'goal_heading_error') - shift
        panel.plot(*error.T, color=color, ls=HEADING, lw=2.2)
    drawn = set()
    for bound in limits(one).get(quantity, ()):
        if _is_near(bound[:, 1], [command[:, 1], measurement[:, 1]]):
            line = (bound - shift).T
            panel.plot(*line, color='black', ls=LIMIT, lw=1.0, drawstyle='steps-post', zorder=3)
            drawn |= {float(limit) for limit in bound[:, 1] if np.isfinite(limit)}
    return drawn


def _is_near(bound: Array, values: Sequence[Array]) -> bool:
    """Return whether values reach a large part of the least bound, on its side of zero."""
    if not np.isfinite(bound).any():
        return False
    least = bound[np.nanargmin(np.abs(bound))]
    reached = [np.nanmax(np.sign(least) * one, initial=0.0) for one in values]
    return bool(max(reached) >= NEAR * abs(least))


def goal_changes(one: Timeline) -> Array:
    """Return when goals and paths begin or end on the axis of time; none if they are too many (s)."""
    changes = np.flatnonzero(np.diff(one.goal) | np.diff(one.path)) + 1
    return one.time[changes] - zero(one) if len(changes) <= MARKED else np.empty(0)


# --- Faults of a lockstep world


def fault_spans(one: Timeline) -> list[FaultSpan]:
    """Return when the faults of a run began and ended, in the order in which they began."""
    run = one.run
    begun: dict[str, float] = {}
    spans: list[FaultSpan] = []
    times = on_axis(run, [received for received, _ in run.fault_events]).tolist()
    for (_, event), time in zip(run.fault_events, times, strict=True):
        if not event.what.startswith('ends'):
            begun.setdefault(event.fault, time)
        elif event.fault in begun:
            spans.append(FaultSpan(event.fault, begun.pop(event.fault), time))
    last = float(one.time[-1])
    spans += [FaultSpan(fault, begin, max(begin, last)) for fault, begin in begun.items()]
    return sorted(spans, key=lambda span: span.begin)


def mark_faults(
    panels: Iterable[Axes], one: Timeline, violations: Sequence[ViolationMark]
) -> list[Line2D]:
    """Draw faults as bands and violations as lines into panels; return their legend."""
    from matplotlib.lines import Line2D

    spans = [*zip(fault_spans(one), cycle(FAULT_COLORS), strict=False)]
    times = on_axis(one.run, [violation.time for violation in violations]) - zero(one)
    style: Any = {'color': VIOLATION, 'lw': 1.6, 'ls': '--'}
    for panel in panels:
        for span, color in spans:
            begin, end = span.begin - zero(one), span.end - zero(one)
            panel.axvspan(begin, end, color=color, alpha=FAULT_ALPHA, lw=0.0, zorder=0.5)
            panel.axvline(begin, color=color, lw=1.2, zorder=0.6)
        for time in times:
            panel.axvline(time, zorder=4, **style)
    handles = [
        Line2D([], [], color=color, alpha=2.0 * FAULT_ALPHA, lw=6.0, label=_label(span, zero(one)))
        for span, color in spans[:NAMED]
    ]
    if len(spans) > NAMED:
        handles[-1].set_label(f'and {len(spans) - NAMED + 1} more faults')
    labels = [
        f'{time:.1f} s: {fault_label(mark.label)}' for time, mark in zip(times, violations, strict=True)
    ]
    return handles + [Line2D([], [], label=label, **style) for label in labels]


def _label(span: FaultSpan, start: float) -> str:
    """Return when a fault was there on the axis of time, and itself, in the time of its world."""
    return f'{span.begin - start:.1f} to {span.end - start:.1f} s: {fault_label(span.fault)}'


def fault_label(name: str) -> str:
    """Return the source of a fault or of a property for the legend, its numbers in two decimals."""
    name = re.sub(r'\d+\.\d{3,}(?:e[-+]\d+)?', _short, printable(name))
    # matplotlib reads a dollar as a formula.
    return (name if len(name) <= FAULT_LABEL else f'{name[: FAULT_LABEL - 1]}…').replace('$', r'\$')


def _short(found: re.Match[str]) -> str:
    value = float(found[0])
    return f'{value:.2f}' if 0.1 <= value < 1e6 else f'{value:.2g}'
