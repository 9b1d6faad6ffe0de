"""A figure of one or several runs: paths in the plane, and quantities over time with their limits."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import cycle, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from diffdrive_jacobian.bags.run import Run, Series
from diffdrive_jacobian.bags.timeline import Array, Timeline, jumps, seconds, timeline, tolerance
from diffdrive_jacobian.plots.output_files import FORMATS, create, extension
from diffdrive_jacobian.plots.rendering import render, styled
from diffdrive_jacobian.plots.run_lines import commanded, limits, line, measured
from diffdrive_jacobian.plots.uncertainty import distance_travelled, draw_uncertainty, uncertainty_marks
from diffdrive_jacobian.text import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ['draw', 'figure']

SIZE = (11.0, 7.0)
"""Size of the figure (inches)."""
ARROWS = 14
"""Number of headings along a path."""
LABEL = 40
"""Length beyond which the name of a bag is shortened in the middle."""
STILL = 1e-3
"""Least range of a quantity over time, in its unit."""
NUMBERED, MARKED = 12, 30
"""Numbers of goals beyond which they have no numbers, and their changes are not marked over time."""
NOTED = 4
"""Number of lines of notes below the figure."""
COLORS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
"""The colors of Okabe and Ito that contrast with white. The line styles differ between runs as well."""
STYLES: tuple[Any, ...] = ('-', (0, (5, 1.5)), '-.', (0, (1.2, 1)), (0, (7, 1.5, 1, 1.5, 1, 1.5)))
LIMIT = (0, (6, 3))
HEADING = (0, (1, 1.2))
GREY, COMMAND = '#777777', '#d2d2d2'
PLANNED, PLANNED_POINTS = '#c8b273', 2000
COLOR = '#222222'
"""Color of the ground truth of a single run. Of several each has that of its path."""
TRUTH: Any = {'ls': (0, (1, 1)), 'lw': 1.8}
"""Line of the ground truth."""
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
    'late': 'behind the times [s]',
    'v': r'speed $v$ [m/s]',
    'omega': r'yaw rate $\omega$ [rad/s]',
    'right': r'right wheel $\omega_R$ [rad/s]',
    'left': r'left wheel $\omega_L$ [rad/s]',
}
"""Quantities over time, and the labels of their axes."""
_ARROW: Any = {
    'units': 'inches',
    'scale_units': 'inches',
    'scale': 5.0,
    'width': 0.022,
    'headwidth': 5.0,
    'headlength': 5.0,
    'headaxislength': 4.5,
}


class FaultSpan(NamedTuple):
    """When a fault was there."""

    fault: str
    """The fault as Python source."""
    begin: float
    """Time on the axis of the figure (s)."""
    end: float
    """End (s); that of the run if it is not known."""


class ViolationMark(NamedTuple):
    """When a property was violated."""

    time: int
    """Time of the recorder's clock (ns)."""
    label: str
    """The property, for the legend."""


def draw(
    runs: Sequence[Run],
    path: Path,
    *,
    replace: bool = False,
    violations: Sequence[ViolationMark] = (),
    drawing: AbstractContextManager[object] | None = None,
) -> None:
    """Draw runs into one set of axes, and write the figure to a new file.

    Args:
        runs: One or more, with odometry.
        path: Ends in .png, .svg or .pdf.
        replace: Whether to replace the file if it exists.
        violations: Violated properties of a single run.
        drawing: Is entered while the figure is drawn, before the file is written (default: nothing).

    Raises:
        BagError: A run has no odometry.
        FileExistsError: The file exists.
        ModuleNotFoundError: matplotlib is not installed.
        OSError: The file cannot be written.
        ValueError: The path has another ending.
    """
    ending = extension(path)
    if ending not in FORMATS:
        raise ValueError(f'{path} must end in .{", .".join(FORMATS)}')
    if path.exists() and not replace:
        raise FileExistsError(f'{path} exists already')
    with drawing or nullcontext(), warnings.catch_warnings(), styled():
        # The font may lack a letter of a bag's name.
        warnings.filterwarnings('ignore', message='Glyph')
        # With many runs there may be no room for their names.
        warnings.filterwarnings('ignore', message='constrained_layout not applied')
        content = render(figure(runs, violations), ending)
    create(path, content, replace=replace)


def names(paths: Sequence[Path]) -> list[str]:
    """Return names for bags: as many last parts of their paths as make them different."""
    parts = [path.resolve().parts for path in paths]
    count = 1
    while count < max(map(len, parts)) and len({one[-count:] for one in parts}) < len(set(parts)):
        count += 1
    return [os.fsencode('/'.join(one[-count:])).decode(errors='replace') for one in parts]


def figure(runs: Sequence[Run], violations: Sequence[ViolationMark] = ()) -> Figure:
    """Return a figure of runs in one set of axes. The plane is the first of its axes.

    A single run is drawn with its commands, the changes of its goals, and the uncertainty along its
    path, see `uncertainty`.

    Raises:
        BagError: A run has no odometry.
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    timelines = [timeline(run) for run in runs]
    quantities = [
        *(('distance', 'bearing_error') if any(len(run.goals) for run in runs) else ()),
        *_path_quantities(timelines),
        *('v', 'omega'),
        *(('right', 'left') if any(len(run.wheels) + len(run.wheel_commands) for run in runs) else ()),
    ]
    columns = 1 if len(quantities) == 2 else 2
    rows = -(-len(quantities) // columns)
    labels = names([run.path for run in runs])
    with styled():
        drawing = Figure(figsize=SIZE, layout='constrained')
        grid = drawing.add_gridspec(
            rows + 1,
            columns + 1,
            width_ratios=[1.55, *[2.0 / columns] * columns],
            height_ratios=[*[1.0] * rows, 0.03 * rows],
        )
        plane, panels = drawing.add_subplot(grid[:-1, 0]), _panels(drawing, grid, quantities, columns)
        uncertain = len(runs) == 1 and draw_uncertainty(plane, timelines[0])
        for one, label, color, style in zip(
            timelines, labels, cycle(COLORS), cycle(STYLES), strict=False
        ):
            _draw_path(plane, one, label, color, style)
            _draw_ground_truth(plane, one.run, COLOR if len(runs) == 1 else color)
            _draw_planned_paths(plane, one)
            for quantity, panel in panels.items():
                _draw_over_time(panel, one, quantity, color, style, alone=len(runs) == 1)
        if len(runs) == 1:
            _draw_goal_changes(panels.values(), timelines[0])
        _draw_goals(plane, timelines)
        _finish(plane, timelines)
        below = drawing.add_subplot(grid[-1, :])
        below.axis('off')
        marks = _marks(timelines, uncertain=uncertain)
        if len(runs) == 1:
            _mark_faults(drawing, panels.values(), timelines[0], violations)
        below.legend(handles=marks, loc='center', ncol=4 if uncertain else 6, borderaxespad=0.0)
        if notes := _notes(runs, labels):
            drawing.supxlabel(notes, fontsize=8.0, color=GREY)
    return drawing


def _path_quantities(timelines: Sequence[Timeline]) -> tuple[str, ...]:
    """Return the errors that are drawn: along where there is a trajectory, else of the heading.

    And how late the robot is, where the times of a trajectory waited for it.
    """
    if not any(one.paths for one in timelines):
        return ()
    if not any(np.isfinite(one.along).any() for one in timelines):
        return 'across', 'path_heading_error'
    late = any(np.nanmax(one.late, initial=0.0) > LATE for one in timelines)
    return ('across', 'along', 'late') if late else ('across', 'along')


def _draw_planned_paths(plane: Axes, one: Timeline) -> None:
    """Draw the paths that were sent, below the path that was driven."""
    for path in one.paths:
        places = path.poses_at(np.linspace(0.0, path.length, PLANNED_POINTS))[:, :2]
        # A closed path repeats its beginning, not its end.
        places[-1] = path.poses[-1, :2]
        plane.plot(*places.T, color=PLANNED, lw=5.0, alpha=0.6, zorder=1.2)


def _notes(runs: Sequence[Run], labels: Sequence[str]) -> str:
    """Return the notes of the runs, one line each, with the names of the runs if there are several."""
    lines = [
        f'{f"{label}: " if len(runs) > 1 else ""}{note}'.replace('$', r'\$')
        for run, label in zip(runs, labels, strict=True)
        for note in run.notes
    ]
    if len(lines) > NOTED:
        lines[NOTED - 1 :] = [f'and {len(lines) - NOTED + 1} more notes']
    return '\n'.join(lines)


def _panels(drawing: Figure, grid: Any, quantities: Sequence[str], columns: int) -> dict[str, Axes]:
    """Create the axes over time, one for each quantity. Those of the wheels share their scale."""
    panels: dict[str, Axes] = {}
    for index, quantity in enumerate(quantities):
        row, column = divmod(index, columns)
        panel = drawing.add_subplot(
            grid[row, 1 + column],
            sharex=panels.get(quantities[0]),
            sharey=panels.get('right') if quantity == 'left' else None,
        )
        last = index + columns >= len(quantities)
        panel.set(ylabel=LABELS[quantity], xlabel='time [s]' if last else '')
        panel.tick_params(labelbottom=last)
        panels[quantity] = panel
    return panels


def _draw_path(plane: Axes, one: Timeline, name: str, color: str, style: Any) -> None:
    """Draw the path with evenly spaced headings, its start and its end."""
    poses, travelled = one.run.odometry.values[:, :3], distance_travelled(one)
    name = name if len(name) <= LABEL else f'{name[: LABEL // 2]}…{name[-LABEL // 2 :]}'
    # matplotlib reads a dollar as a formula, and hides labels that start with an underscore.
    label = f'{name}: {np.ptp(one.time):.1f} s recorded, {travelled[-1]:.2f} m'.replace('$', r'\$')
    label = f' {label}' if label.startswith('_') else label
    plane.plot(*line(poses[:, :2], one.breaks).T, color=color, ls=style, lw=1.8, label=label)
    evenly = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], ARROWS, endpoint=False))
    x, y, theta = poses[np.unique([*evenly, len(travelled) - 1])].T
    plane.quiver(x, y, np.cos(theta), np.sin(theta), color=color, zorder=3, **_ARROW)
    x, y, _ = poses[[0, *one.breaks[:MARKED]]].T
    plane.plot(x, y, 'o', ms=9, mfc='white', mec=color, mew=1.8, zorder=2.5)
    plane.plot(*poses[-1, :2], 's', ms=7, mfc=color, mec='white', mew=0.8, zorder=5)


def _draw_ground_truth(plane: Axes, run: Run, color: str) -> None:
    """Draw the true path with its end, if it was recorded."""
    if len(run.ground_truth):
        places = run.ground_truth.values[:, :2]
        plane.plot(*line(places, jumps(run.ground_truth)).T, color=color, zorder=2.2, **TRUTH)
        plane.plot(*places[-1], 'D', ms=6, mfc='white', mec=color, mew=1.5, zorder=5)


def _draw_goals(plane: Axes, timelines: Sequence[Timeline]) -> None:
    """Draw each goal once with its tolerance, in the order in which they were sent."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle

    goals = {
        (round(x, 6), round(y, 6)): tolerance(one.run)
        for one in timelines
        for x, y in one.run.goals.values[:, :2].tolist()
    }
    size, depth = (13, 6.0) if len(goals) <= MARKED else (4, 1.5)
    circles = [Circle(place, radius) for place, radius in goals.items()]
    plane.add_collection(PatchCollection(circles, fc='none', ec='black', lw=1.0, zorder=depth))
    places = np.reshape([*goals], (-1, 2))
    plane.plot(*places.T, '+', ms=size, mew=1.4, color='black', zorder=depth)
    places = np.concatenate([line(one.run.odometry.values[:, :2], one.breaks) for one in timelines])
    for number, place in enumerate(goals if len(goals) <= NUMBERED else (), 1):
        right, up = _free_corner(places, place)
        plane.annotate(
            f'goal {number}' if len(goals) > 1 else 'goal',
            place,
            xytext=(7 * right, 7 * up),
            textcoords='offset points',
            ha='left' if right > 0 else 'right',
            va='bottom' if up > 0 else 'top',
            zorder=7,
        )


def _free_corner(places: Array, place: tuple[float, float]) -> tuple[int, int]:
    """Return the side of a place with the fewest poses: right 1 or left -1, above 1 or below -1."""
    reach = 0.2 * np.nanmax(np.nanmax(places, axis=0) - np.nanmin(places, axis=0))
    dx, dy = (places - place).T
    near = np.hypot(dx, dy) < reach

    def passages(corner: tuple[int, int]) -> int:
        return int(np.count_nonzero(near & (corner[0] * dx >= 0.0) & (corner[1] * dy >= 0.0)))

    return min(product((1, -1), (1, -1)), key=passages)


def _draw_over_time(
    panel: Axes, one: Timeline, quantity: str, color: str, style: Any, *, alone: bool
) -> None:
    """Draw a quantity and its limits, and for a single run its commands."""
    panel.axhline(0.0, color='#bbbbbb', lw=0.8, zorder=1)
    # So that the rounding of a robot at rest does not fill the panel.
    panel.update_datalim([(one.time[0], -STILL), (one.time[0], STILL)])
    command, measurement = commanded(one, quantity), measured(one, quantity)
    if not len(measurement):
        panel.plot(*command.T, color=color, ls=style, lw=1.5, drawstyle='steps-post')
    elif alone:
        panel.plot(*command.T, color=COMMAND, lw=4.5, drawstyle='steps-post', zorder=1.5)
    panel.plot(*measurement.T, color=color, ls=style, lw=1.5)
    if quantity == 'bearing_error' and np.isfinite(one.goal_heading_error).any():
        panel.plot(*measured(one, 'goal_heading_error').T, color=color, ls=HEADING, lw=2.2)
    for bound in limits(one).get(quantity, ()):
        panel.plot(*bound.T, color='black', ls=LIMIT, lw=1.0, drawstyle='steps-post', zorder=3)


def _draw_goal_changes(panels: Iterable[Axes], one: Timeline) -> None:
    """Draw the changes of goals into axes over time, whose lines are complete.

    After a new line, `axvline` computes the limits of all axes that share their time.
    """
    changes = np.flatnonzero(np.diff(one.goal)) + 1
    for panel in panels if len(changes) <= MARKED else ():
        for change in changes:
            panel.axvline(one.time[change], color=GREY, lw=0.9, ls=':', zorder=1)


def _finish(plane: Axes, timelines: Sequence[Timeline]) -> None:
    """Set equal scales of the plane's axes, and add the legend of the runs."""
    places = np.concatenate([one.run.odometry.values[:, :2] for one in timelines])
    # The noise of a robot at rest must not fill the figure.
    middle = (places.min(axis=0) + places.max(axis=0)) / 2.0
    plane.update_datalim([middle - 0.25, middle + 0.25])
    plane.set_aspect('equal', adjustable='datalim')
    plane.margins(0.2)
    plane.set(xlabel='x [m]', ylabel='y [m]')
    size = min(9.5, 90.0 / len(timelines))
    legend = plane.legend(
        loc='lower left', bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, handlelength=3.0, fontsize=size
    )
    # A long name must not make room for itself beside the path: lines of a title do above it.
    legend.set_in_layout(False)
    plane.set_title(' \n' * len(timelines), fontsize=size, linespacing=1.65)


def _marks(timelines: Sequence[Timeline], *, uncertain: bool) -> list[Any]:
    """Return the legend of the marks that were drawn."""
    from matplotlib.lines import Line2D

    alone, marks = len(timelines) == 1, list[Any]()

    def mark(label: str, **style: Any) -> None:
        marks.append(Line2D([], [], label=label, **{'color': GREY, **style}))

    mark('start', ls='', marker='o', ms=9, mfc='white', mew=1.8)
    mark('end', ls='', marker='s', ms=7)
    if any(len(one.run.goals) for one in timelines):
        mark('goal with its tolerance', ls='', marker=r'$\oplus$', ms=12, color='black')
    if any(one.paths for one in timelines):
        mark('planned path', lw=5.0, color=PLANNED, alpha=0.6)
    if alone and 0 < np.count_nonzero(np.diff(timelines[0].goal)) <= MARKED:
        mark('goal begins or ends', ls=':', lw=0.9)
    if alone and any(len(commanded(timelines[0], quantity)) for quantity in LABELS):
        mark('commanded', lw=4.5, color=COMMAND)
    if any(np.isfinite(one.goal_heading_error).any() for one in timelines):
        mark('error of the heading at the goal', ls=HEADING, lw=2.2)
    if any(np.isfinite(bounds[..., 1]).any() for one in timelines for bounds in limits(one).values()):
        mark('limit', ls=LIMIT, lw=1.0, color='black')
    marks += uncertainty_marks() if uncertain else []
    if any(len(one.run.ground_truth) for one in timelines):
        color = {'color': COLOR} if alone else {}
        mark('ground truth and its end', marker='D', ms=6, mfc='white', mew=1.5, **TRUTH, **color)
    return marks


# --- Faults of a lockstep world


def fault_spans(one: Timeline) -> list[FaultSpan]:
    """Return when the faults of a run began and ended, in the order in which they began."""
    run = one.run
    begun: dict[str, float] = {}
    spans: list[FaultSpan] = []
    times = _times(run, [received for received, _ in run.fault_events])
    for (_, event), time in zip(run.fault_events, times, strict=True):
        if not event.what.startswith('ends'):
            begun.setdefault(event.fault, time)
        elif event.fault in begun:
            spans.append(FaultSpan(event.fault, begun.pop(event.fault), time))
    last = float(one.time[-1])
    spans += [FaultSpan(fault, begin, max(begin, last)) for fault, begin in begun.items()]
    return sorted(spans, key=lambda span: span.begin)


def _times(run: Run, recorded: Sequence[int]) -> list[float]:
    """Return when events were recorded (ns) as times on the axis of the figure (s)."""
    received = np.array(recorded, dtype=np.int64)
    series = Series(received=received, stamps=received, values=np.empty((len(received), 0)))
    return [float(time) for time in seconds(run, series)]


def _mark_faults(
    drawing: Figure, panels: Iterable[Axes], one: Timeline, violations: Sequence[ViolationMark]
) -> None:
    """Draw faults as bands and violations as lines into axes over time, and add their legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    spans = [*zip(fault_spans(one), cycle(FAULT_COLORS), strict=False)]
    times = _times(one.run, [violation.time for violation in violations])
    style: Any = {'color': VIOLATION, 'lw': 1.6, 'ls': '--'}
    for panel in panels:
        for span, color in spans:
            panel.axvspan(span.begin, span.end, color=color, alpha=FAULT_ALPHA, lw=0.0, zorder=0.5)
            panel.axvline(span.begin, color=color, lw=1.2, zorder=0.6)
        for time in times:
            panel.axvline(time, zorder=4, **style)
    handles: list[Any] = [
        Patch(color=color, alpha=2.0 * FAULT_ALPHA, label=_fault_label(span.fault))
        for span, color in spans[:NAMED]
    ]
    if len(spans) > NAMED:
        handles[-1].set_label(f'and {len(spans) - NAMED + 1} more faults')
    handles += [Line2D([], [], label=_fault_label(one.label), **style) for one in violations]
    if handles:
        drawing.legend(handles=handles, loc='outside upper right', ncol=2, fontsize=8.0)


def _fault_label(name: str) -> str:
    name = printable(name)
    # matplotlib reads a dollar as a formula.
    return (name if len(name) <= FAULT_LABEL else f'{name[: FAULT_LABEL - 1]}…').replace('$', r'\$')
