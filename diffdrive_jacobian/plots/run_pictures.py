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

"""A figure of one or several runs: paths in the plane, and quantities over time."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable, Mapping, Sequence, Set
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.bags.summary import RunSummary, summary
from diffdrive_jacobian.bags.timeline import Timeline, timeline
from diffdrive_jacobian.numerics.checks import short
from diffdrive_jacobian.plots import run_panels
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.run_layout import GREY, Texts, arrange, lay_out
from diffdrive_jacobian.plots.run_lines import commanded
from diffdrive_jacobian.plots.run_panels import COMMAND, HEADING, LABELS, LIMIT, ViolationMark
from diffdrive_jacobian.plots.run_plane import COLOR, PLANNED, TRUTH, Plane, extent
from diffdrive_jacobian.plots.uncertainty import draw_uncertainty, uncertainties, uncertainty_marks
from diffdrive_jacobian.text import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LABEL = 40
"""Length beyond which the name of a bag is shortened in the middle."""
NOTED = 4
"""Number of lines of notes below the figure."""
HEADER_WIDTH, ENTRY_WIDTH, NOTE_WIDTH = 125, 145, 150
"""Numbers of characters in a line of the title, about a run, and of a note."""
COLORS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
"""The colors of Okabe and Ito that contrast with white. The line styles differ between runs as well."""
STYLES: tuple[Any, ...] = ('-', (0, (5, 1.5)), '-.', (0, (1.2, 1)), (0, (7, 1.5, 1, 1.5, 1, 1.5)))


@picture
def run_figure(runs: Any, violations: Sequence[ViolationMark] = ()) -> Figure:
    """Return a figure of one or several runs. The plane is the first of its axes.

    Time counts from the first goal or path of each run. A single run is drawn with its commands, the
    changes of its goals, its faults, and the uncertainty along its path, see `plots.uncertainty`.

    Args:
        runs: A `Run` or several, or what has one, as the outcome of a drive; or these by the names that
            the figure shows. They must have odometry.
        violations: Violated properties of a single run.

    Raises:
        BagError: A run has no odometry.
        ModuleNotFoundError: matplotlib is not installed.
        ValueError: There is no run.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    labels = [str(name) for name in runs] if isinstance(runs, Mapping) else None
    runs = as_runs(runs)
    if not runs:
        raise ValueError('runs must have at least one run, got none')
    timelines = [timeline(run) for run in runs]
    alone = timelines[0] if len(runs) == 1 else None
    uncertain = [] if alone is None else uncertainties(alone)
    bounds = extent(timelines, [one.extent for one in uncertain])
    names = run_panels.quantities(timelines)
    arrangement = arrange(bounds, len(names))
    # The axes get their places at the end: what is drawn decides how much text is around them.
    drawing = Figure()
    axes, *others = (drawing.add_axes((0.0, 0.0, 1.0, 1.0), label=name) for name in ('plane', *names))
    panels = dict(zip(names, others, strict=True))
    plane = Plane(axes, bounds, arrangement.plane_width, timelines)
    ellipses = draw_uncertainty(axes, uncertain)
    limits: dict[str, set[float]] = {name: set() for name in names}
    styles = [*zip(timelines, cycle(COLORS), cycle(STYLES), strict=False)]
    for one, color, style in styles:
        plane.planned_paths(one)
        plane.path(one, color, style, alone=alone is not None)
        plane.ground_truth(one.run, COLOR if alone else color)
        for name, panel in panels.items():
            limits[name] |= run_panels.draw(panel, one, name, color, style, alone=alone is not None)
    plane.goals(timelines)
    marks = _marks(timelines, plane, limited=any(limits.values()))
    marks += uncertainty_marks(alone.run, ellipses=ellipses) if alone and uncertain else []
    if alone is not None:
        for panel in panels.values():
            for change in run_panels.goal_changes(alone):
                panel.axvline(change, color=GREY, lw=0.9, ls=':', zorder=1)
        marks += run_panels.mark_faults(panels.values(), alone, violations)
    _finish(panels, timelines, limits)
    labels = labels or names_of([run.path for run in runs])
    header, entries = _header(labels, [summary(one) for one in timelines])
    samples = [
        Line2D([], [], color=color, ls=style, lw=1.8, label=entry)
        for entry, (_, color, style) in zip(entries, styles, strict=False)
    ]
    texts = Texts(header, samples, marks, _notes(runs, labels))
    lay_out(drawing, axes, others, arrangement, texts, _time_label(timelines))
    return drawing


def as_runs(given: Any) -> list[Run]:
    """Return runs of a `Run`, of what has one (`run`), or of several of them, also by name.

    Raises:
        ValueError: Something else was given.
    """
    several = [given] if isinstance(given, Run) or hasattr(given, 'run') else given
    several = several.values() if isinstance(several, Mapping) else several
    if not isinstance(several, Iterable):
        raise ValueError(f'runs must be a Run or several, got {short(given, repr)}')
    found: list[Any] = [one if isinstance(one, Run) else getattr(one, 'run', None) for one in several]
    if not all(isinstance(one, Run) for one in found):
        raise ValueError(f'runs must be a Run or several, got {short(given, repr)}')
    return found


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return names for bags: as many last parts of their paths as make them different.

    Those of the same path have numbers, as the outcomes of drives that were not recorded.
    """
    parts = [path.resolve().parts for path in paths]
    count = 1
    while count < max(map(len, parts)) and len({one[-count:] for one in parts}) < len(set(parts)):
        count += 1
    names = [os.fsencode('/'.join(one[-count:])).decode(errors='replace') for one in parts]
    return [
        name if names.count(name) == 1 else f'{name} {names[: index + 1].count(name)}'
        for index, name in enumerate(names)
    ]


def _header(labels: Sequence[str], found: Sequence[RunSummary]) -> tuple[list[str], list[str]]:
    """Return the lines above the figure: its title, and of several runs one for each.

    The laws and those gains that all runs have stand in the title.
    """
    laws = found[0].laws
    same = all([*one.laws] == [*laws] for one in found)
    common = {
        name: {
            gain: text
            for gain, text in gains.items()
            if all(one.laws[name].get(gain) == text for one in found)
        }
        for name, gains in (laws if same else {}).items()
    }
    header = [
        part
        for name, gains in common.items()
        for part in textwrap.wrap(f'control law {_law(name, gains)}', HEADER_WIDTH)
    ]
    names = [_plain(name) for name in labels]
    if len(found) == 1:
        return [f'{names[0]}: {found[0].described}', *header], []
    entries = []
    for label, one in zip(names, found, strict=True):
        own = [
            _law(
                '' if same else name,
                {gain: text for gain, text in gains.items() if gain not in common.get(name, {})},
            )
            for name, gains in one.laws.items()
        ]
        entry = f'{label}: {"; ".join(filter(None, [one.described, *own]))}'
        entries.append(textwrap.shorten(entry, ENTRY_WIDTH, placeholder=' …'))
    return header, entries


def _law(name: str, gains: Mapping[str, str]) -> str:
    """Return a text about a law and gains; '': there is nothing to say."""
    values = ', '.join(f'{gain} = {text}' for gain, text in gains.items()).replace('^2', '²')
    return ': '.join(filter(None, [_plain(name), values]))


def _plain(text: str) -> str:
    text = printable(text)
    text = text if len(text) <= LABEL else f'{text[: LABEL // 2]}…{text[-LABEL // 2 :]}'
    # matplotlib reads a dollar as a formula.
    return text.replace('$', r'\$')


def _notes(runs: Sequence[Run], labels: Sequence[str]) -> list[str]:
    """Return the lines below the figure, with the names of the runs if there are several."""
    lines = [
        f'{f"{label}: " if len(runs) > 1 else ""}{note}'.replace('$', r'\$')
        for run, label in zip(runs, labels, strict=True)
        for note in run.notes
    ]
    if len(lines) > NOTED:
        lines[NOTED - 1 :] = [f'and {len(lines) - NOTED + 1} more notes']
    return [part for one in lines for part in textwrap.wrap(one, NOTE_WIDTH)]


def _time_label(timelines: Sequence[Timeline]) -> str:
    if any(np.isnan(one.start) for one in timelines):
        return 'time [s]'
    goals, paths = any(len(one.goals) for one in timelines), any(one.paths for one in timelines)
    since = 'the start' if goals and paths else 'the first path' if paths else 'the first goal'
    return f'time since {since} [s]'


def _finish(
    panels: Mapping[str, Axes], timelines: Sequence[Timeline], limits: Mapping[str, Set[float]]
) -> None:
    """Set titles, with the limits that were drawn, and scales of the panels, which the wheels share."""
    first, last = run_panels.window(timelines)
    for name, panel in panels.items():
        bounds = ' and '.join(f'{limit:.3g}' for limit in sorted(limits[name])[:2])
        title = LABELS[name] + (f', limit {bounds}' if bounds else '')
        panel.set_title(title, loc='left', fontsize=9.5, pad=4.0)
        panel.ticklabel_format(axis='y', style='plain', useOffset=False)
        panel.set_xlim(first, last)
    if 'right' in panels:
        low, high = zip(*(panels[name].get_ylim() for name in ('right', 'left')), strict=True)
        for name in ('right', 'left'):
            panels[name].set_ylim(min(low), max(high))


def _marks(timelines: Sequence[Timeline], plane: Plane, *, limited: bool) -> list[Any]:
    """Return the legend of the marks that were drawn."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    alone, marks = len(timelines) == 1, list[Any]()
    color = COLORS[0] if alone else GREY

    def mark(label: str, **style: Any) -> None:
        marks.append(Line2D([], [], label=label, **{'color': color, **style}))

    if plane.to_scale:
        marks += [
            Patch(fc='white', ec=color, ls='--', alpha=0.6, label='robot at the start, to scale'),
            Patch(fc=color, ec=color, alpha=0.5, label='robot at the end'),
        ]
    else:
        mark('start', ls='', marker='o', ms=9, mfc='white', mew=1.8)
        mark('end', ls='', marker='s', ms=7)
    if any(len(one.goals) for one in timelines):
        with_what = 'tolerance and heading' if plane.headings else 'tolerance'
        mark(f'goal with its {with_what}', ls='', marker=r'$\oplus$', ms=11, color='black')
    if any(one.paths for one in timelines):
        mark('planned path', lw=5.0, color=PLANNED, alpha=0.6)
    if any(len(one.run.ground_truth) for one in timelines):
        truth = {'color': COLOR if alone else GREY}
        mark('where the robot truly was', marker='D', ms=5, mfc='white', mew=1.5, **TRUTH, **truth)
    if alone and any(len(commanded(timelines[0], quantity)) for quantity in LABELS):
        mark('measured by the wheels (odom, joint_states)', lw=1.5)
        mark('commanded', lw=4.5, color=COMMAND)
    if any(np.isfinite(one.goal_heading_error).any() for one in timelines):
        mark('heading error at the goal', ls=HEADING, lw=2.2)
    if limited:
        mark('limit', ls=LIMIT, lw=1.0, color='black')
    if alone and len(run_panels.goal_changes(timelines[0])):
        mark('a goal or path begins or ends', ls=':', lw=0.9, color=GREY)
    return marks
