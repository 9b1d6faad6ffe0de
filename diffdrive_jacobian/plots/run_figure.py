"""A figure of one or several runs.

It shows the paths in the plane, and over time the distance to the goal, the bearing error, v, omega and
the wheel speeds with their limits. Where the heading of a goal counts, its error is beside that of the
bearing. matplotlib is imported when it is drawn. No display is needed.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import cycle, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.bags.timeline import (
    Array,
    Timeline,
    commanded,
    jumps,
    limits,
    line,
    measured,
    timeline,
    tolerance,
)
from diffdrive_jacobian.messages.topics import SENSORS
from diffdrive_jacobian.plots.fault_marks import ViolationMark, mark_faults
from diffdrive_jacobian.plots.output_files import FORMATS, create
from diffdrive_jacobian.plots.rendering import render, styled
from diffdrive_jacobian.plots.uncertainty import draw_uncertainty, uncertainty_marks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

__all__ = ['draw', 'figure']

STYLE: Any = (0, (1, 1))
WIDTH, COLOR = 1.8, '#222222'


def draw_ground_truth(plane: Axes, run: Run, color: str = COLOR) -> None:
    """Draw the true path with its end, if it was recorded."""
    series = run.ground_truth
    if not len(series):
        return
    places = series.values[:, :2]
    plane.plot(*line(places, jumps(series)).T, color=color, ls=STYLE, lw=WIDTH, zorder=2.2)
    plane.plot(*places[-1], 'D', ms=6, mfc='white', mec=color, mew=1.5, zorder=5)


def ground_truth_mark(color: str = COLOR) -> Line2D:
    """Return the legend of the true path."""
    from matplotlib.lines import Line2D

    label = 'ground truth and its end'
    return Line2D(
        [], [], ls=STYLE, lw=WIDTH, color=color, marker='D', ms=6, mfc='white', mew=1.5, label=label
    )


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

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
_FIXED = {
    'distance': 'distance to goal [m]',
    'bearing_error': 'bearing error [rad]',
    'across': 'across path [m]',
    'along': 'along path [m]',
    'path_heading_error': 'heading to path [rad]',
    'v': r'speed $v$ [m/s]',
    'omega': r'yaw rate $\omega$ [rad/s]',
    'right': r'right wheel $\omega_R$ [rad/s]',
    'left': r'left wheel $\omega_L$ [rad/s]',
}
LABELS = {
    **_FIXED,
    **{name: f'{name} [{unit}]' for topic in SENSORS for name, unit in topic.readings.items()},
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
    ending = path.suffix.lower().removeprefix('.')
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
        *path_quantities(timelines),
        *('v', 'omega'),
        *(('right', 'left') if any(len(run.wheels) + len(run.wheel_commands) for run in runs) else ()),
        *(
            column
            for topic in SENSORS
            if any(len(getattr(run, topic.series)) for run in runs)
            for column in topic.columns
        ),
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
            draw_ground_truth(plane, one.run, *([color] if len(runs) > 1 else []))
            draw_planned_paths(plane, one)
            for quantity, panel in panels.items():
                _draw_over_time(panel, one, quantity, color, style, alone=len(runs) == 1)
        if len(runs) == 1:
            _draw_goal_changes(panels.values(), timelines[0])
        _draw_goals(plane, timelines)
        _finish(plane, timelines)
        below = drawing.add_subplot(grid[-1, :])
        below.axis('off')
        marks = [*_marks(timelines), *(uncertainty_marks() if uncertain else [])]
        if len(runs) == 1:
            mark_faults(drawing, list(panels.values()), timelines[0], violations)
        if any(len(run.ground_truth) for run in runs):
            marks.append(ground_truth_mark(*([GREY] if len(runs) > 1 else [])))
        below.legend(handles=marks, loc='center', ncol=4 if uncertain else 6, borderaxespad=0.0)
        if notes := _notes(runs, labels):
            drawing.supxlabel(notes, fontsize=8.0, color=GREY)
    return drawing


def path_quantities(timelines: Sequence[Timeline]) -> tuple[str, ...]:
    """Return the two errors that are drawn: along where there is a trajectory, else of the heading."""
    if not any(one.paths for one in timelines):
        return ()
    trajectory = any(np.isfinite(one.along).any() for one in timelines)
    return 'across', 'along' if trajectory else 'path_heading_error'


def draw_planned_paths(plane: Axes, one: Timeline) -> None:
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
    poses = one.run.odometry.values[:, :3]
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    steps[one.breaks - 1] = 0.0
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    name = name if len(name) <= LABEL else f'{name[: LABEL // 2]}…{name[-LABEL // 2 :]}'
    # matplotlib reads a dollar as a formula, and hides labels that start with an underscore.
    label = f'{name}: {np.ptp(one.time):.1f} s, {travelled[-1]:.2f} m'.replace('$', r'\$')
    label = f' {label}' if label.startswith('_') else label
    plane.plot(*line(poses[:, :2], one.breaks).T, color=color, ls=style, lw=1.8, label=label)
    evenly = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], ARROWS, endpoint=False))
    x, y, theta = poses[np.unique([*evenly, len(travelled) - 1])].T
    plane.quiver(x, y, np.cos(theta), np.sin(theta), color=color, zorder=3, **_ARROW)
    x, y, _ = poses[[0, *one.breaks[:MARKED]]].T
    plane.plot(x, y, 'o', ms=9, mfc='white', mec=color, mew=1.8, zorder=2.5)
    plane.plot(*poses[-1, :2], 's', ms=7, mfc=color, mec='white', mew=0.8, zorder=5)


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
    if quantity == 'bearing_error' and _heading_counts(one):
        panel.plot(*measured(one, 'goal_heading_error').T, color=color, ls=HEADING, lw=2.2)
    for bound in limits(one).get(quantity, ()):
        panel.plot(*bound.T, color='black', ls=LIMIT, lw=1.0, drawstyle='steps-post', zorder=3)


def _heading_counts(one: Timeline) -> bool:
    return bool(np.isfinite(one.goal_heading_error).any())


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
    plane.legend(
        loc='lower left',
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.2,
        handlelength=3.0,
        fontsize=min(9.5, 90.0 / len(timelines)),
    )


def _marks(timelines: Sequence[Timeline]) -> list[Line2D]:
    """Return the legend of the marks that were drawn."""
    from matplotlib.lines import Line2D

    alone = len(timelines) == 1
    marks = [
        Line2D([], [], ls='', marker='o', ms=9, mfc='white', mew=1.8, color=GREY, label='start'),
        Line2D([], [], ls='', marker='s', ms=7, color=GREY, label='end'),
    ]
    if any(len(one.run.goals) for one in timelines):
        label = 'goal with its tolerance'
        marks.append(Line2D([], [], ls='', marker=r'$\oplus$', ms=12, color='black', label=label))
    if any(one.paths for one in timelines):
        marks.append(Line2D([], [], lw=5.0, color=PLANNED, alpha=0.6, label='planned path'))
    if alone and 0 < np.count_nonzero(np.diff(timelines[0].goal)) <= MARKED:
        marks.append(Line2D([], [], ls=':', lw=0.9, color=GREY, label='goal begins or ends'))
    if alone and any(len(commanded(timelines[0], quantity)) for quantity in LABELS):
        marks.append(Line2D([], [], lw=4.5, color=COMMAND, label='commanded'))
    if any(map(_heading_counts, timelines)):
        label = 'error of the heading at the goal'
        marks.append(Line2D([], [], ls=HEADING, lw=2.2, color=GREY, label=label))
    if any(np.isfinite(bounds[..., 1]).any() for one in timelines for bounds in limits(one).values()):
        marks.append(Line2D([], [], ls=LIMIT, lw=1.0, color='black', label='limit'))
    return marks
