"""A sweep of gains as one picture: heat maps of time to goal, path length and overshoot.

matplotlib is imported when something is drawn; no display is needed.
"""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_jacobian.plots.style import DPI, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import NDArray

    from diffdrive_jacobian.sweeps.sweep import Setup, Sweep

SIZE = (13.0, 5.2)
"""Of the picture (inches)."""
TITLES = {
    'time': 'time to goal [s]',
    'path_length': 'path length [m]',
    'overshoot': 'overshoot beyond the goal [m]',
}
BORDERS = {
    'go_to_goal': (1.0, 'kp = kv', 'with a larger kv the robot spirals in'),
    'pose': (2.0, 'kp = 2 kv', 'with a larger kv the robot turns on the spot at the goal'),
}
"""Of each law the kp at the border, as a multiple of kv; its name, and what is beyond it."""
DOCUMENT_A = (3.0, 0.5)
"""kp and kv of document A (1/s)."""
MANY_TIMES = 4.0
"""Values that differ by a larger factor are told apart on a logarithmic scale."""
FINE = 10
"""Lines between fewer cells would tell nothing."""
COLORS = 'viridis'
"""Perceptually even, and the same to the colour-blind."""
TICKS = (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0)
"""Of a logarithmic scale, and their tenfold."""
LINE, LIT, EMPTY = 'black', 'white', '#dcdcdc'
DASHES = (0, (5, 2))


def draw(swept: Sweep, ending: str) -> bytes:
    """Draw a sweep; gives the content of a file.

    Args:
        swept: The sweep.
        ending: `png`, `svg` or `pdf`.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    drawn = io.BytesIO()
    with styled():
        figure(swept).savefig(drawn, format=ending, dpi=DPI)
    return drawn.getvalue()


def figure(swept: Sweep) -> Figure:
    """Draw a sweep; its axes are the heat maps, then the legend, then the scales.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    with styled():
        made = Figure(figsize=SIZE, layout='constrained')
        grid = made.add_gridspec(2, len(TITLES), height_ratios=[1.0, 0.02])
        panels = [made.add_subplot(grid[0, column]) for column in range(len(TITLES))]
        below = made.add_subplot(grid[1, :])
        for panel, (measure, title) in zip(panels, TITLES.items(), strict=True):
            _draw_map(made, panel, swept, measure)
            _draw_border(panel, swept.setup)
            _draw_marks(panel, swept)
            panel.set_title(title, pad=10.0)
            panel.set_xlabel('kp [1/s]')
        panels[0].set_ylabel('kv [1/s]')
        below.axis('off')
        below.legend(handles=_legend(swept), loc='center', ncol=4, borderaxespad=0.0)
        made.suptitle(describe(swept.setup))
    return made


def describe(setup: Setup) -> str:
    """Say in two lines what was swept, and how."""
    limits = setup.robot.limits
    held = [
        f'{name} {_within(low, high)} {unit}'
        for name, low, high, unit in (
            ('v', limits.min_v, limits.max_v, 'm/s'),
            (r'$\omega$', limits.min_omega, limits.max_omega, 'rad/s'),
            ('wheels', -limits.max_wheel_speed, limits.max_wheel_speed, 'rad/s'),
        )
        if math.isfinite(low) or math.isfinite(high)
    ]
    starts = f'{setup.starts} starts facing every way' if setup.starts > 1 else '1 start'
    there = f'{setup.tolerance:g} m'
    if setup.arrival.use_heading:
        there += f' and {setup.arrival.yaw_tolerance:g} rad'
    return (
        f'{setup.controller}: mean over {starts}, {setup.distance:g} m from the goal\n'
        f'asked at {setup.rate:g} Hz; limits: {", ".join(held) or "none"}; arrived within {there}'
    )


def _within(low: float, high: float) -> str:
    return f'±{high:g}' if -low == high else f'{low:g} to {high:g}'


def _draw_map(made: Figure, panel: Axes, swept: Sweep, measure: str) -> None:
    """Draw where all starts arrived, and its scale; hatched: not all have."""
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.ticker import FuncFormatter, LogLocator

    # What is NaN stays empty.
    values = np.where(swept.complete, swept.mean(measure), np.nan)
    found = values[swept.complete]
    low, high = _range(found, from_zero=measure == 'overshoot')
    many = low > 0.0 and high / low > MANY_TIMES
    norm: Any = LogNorm(low, high) if many else Normalize(low, high)
    mesh = panel.pcolormesh(
        _edges(swept.kp),
        _edges(swept.kv),
        values,
        norm=norm,
        cmap=COLORS,
        rasterized=True,
    )
    panel.set(xlim=swept.kp[[0, -1]], ylim=swept.kv[[0, -1]], facecolor=EMPTY)
    panel.patch.set(hatch='////', edgecolor='white', lw=0.0)
    panel.grid(False)
    panel.spines[:].set_visible(True)
    scale = made.colorbar(mesh, ax=panel, pad=0.02, aspect=28)
    outline: Any = scale.outline
    outline.set_linewidth(0.8)
    if many:
        scale.ax.yaxis.set_major_locator(LogLocator(subs=TICKS))
        scale.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
        scale.ax.minorticks_off()
    # The same lines in the map and on its scale spare the numbers in the map.
    levels = [level for level in scale.get_ticks() if (found < level).any() and (found > level).any()]
    if levels and swept.setup.grid >= FINE:
        how: Any = {'colors': LIT, 'linewidths': 0.7, 'alpha': 0.6}
        scale.add_lines(panel.contour(swept.kp, swept.kv, values, levels, **how))


def _range(values: NDArray[np.float64], *, from_zero: bool) -> tuple[float, float]:
    """Find the ends of a scale that have something between them."""
    low, high = (float(np.min(values)), float(np.max(values))) if len(values) else (0.0, 1.0)
    low = 0.0 if from_zero else low
    return (low, high) if high - low > 1e-3 else (low, low + 1e-3)


def _edges(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give the borders of the cells; the outermost end at the first and at the last gain."""
    return np.concatenate([centres[:1], (centres[1:] + centres[:-1]) / 2.0, centres[-1:]])


def _draw_border(panel: Axes, setup: Setup) -> None:
    """Draw the border where it lies in the picture, with its name along it where there is room."""
    from matplotlib.patheffects import withStroke

    low, high = _border(setup)
    if not low < high:
        return
    factor, name, _ = BORDERS[setup.controller]
    kv = np.array([low, high])
    panel.plot(factor * kv, kv, color=LIT, lw=3.6, alpha=0.55)
    panel.plot(factor * kv, kv, color=LINE, lw=1.6, ls=DASHES)
    ends = np.ptp(panel.transLimits.transform(np.column_stack([factor * kv, kv])), axis=0)
    if np.hypot(*ends) > 0.6:
        at = low + 0.62 * (high - low)
        panel.text(
            factor * at + 0.02 * (setup.kp[1] - setup.kp[0]),
            at,
            name,
            rotation=math.degrees(math.atan2(1.0, factor)),
            rotation_mode='anchor',
            transform_rotates_text=True,
            va='top',
            color=LIT,
            path_effects=[withStroke(linewidth=2.0, foreground='#000000b0')],
        )


def _border(setup: Setup) -> tuple[float, float]:
    """Give the first and the last kv of the border that lie in the picture."""
    factor = BORDERS[setup.controller][0]
    return max(setup.kp[0] / factor, setup.kv[0]), min(setup.kp[1] / factor, setup.kv[1])


def _draw_marks(panel: Axes, swept: Sweep) -> None:
    """Mark document A's gains and the fastest ones."""
    for mark in _marks(swept):
        mark.set_clip_on(False)
        panel.add_line(mark)


def _marks(swept: Sweep) -> list[Line2D]:
    from matplotlib.lines import Line2D

    marks = []
    how: Any = {'ls': '', 'mec': LINE, 'mfc': LIT, 'mew': 1.2, 'zorder': 5}
    setup, (kp, kv) = swept.setup, DOCUMENT_A
    inside = setup.kp[0] <= kp <= setup.kp[1] and setup.kv[0] <= kv <= setup.kv[1]
    if inside and setup.controller == 'go_to_goal':
        label = f"document A's gains: kp {kp:g}, kv {kv:g}"
        marks.append(Line2D([kp], [kv], marker='o', ms=8, label=label, **how))
    found = swept.fastest()
    if found is not None:
        kp, kv = float(swept.kp[found[1]]), float(swept.kv[found[0]])
        label = f'fastest: kp {kp:.4g}, kv {kv:.4g}, {swept.mean("time")[found]:.2f} s'
        marks.append(Line2D([kp], [kv], marker='*', ms=14, label=label, **how))
    return marks


def _legend(swept: Sweep) -> list[Any]:
    """Say what was drawn."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    setup = swept.setup
    entries: list[Any] = []
    low, high = _border(setup)
    if low < high:
        label = ': '.join(BORDERS[setup.controller][1:])
        entries.append(Line2D([], [], color=LINE, lw=1.6, ls=DASHES, label=label))
    entries += _marks(swept)
    if not swept.complete.all():
        label = f'not all starts arrived within {setup.duration:g} s'
        entries.append(Patch(fc=EMPTY, ec='white', hatch='////', lw=0.0, label=label))
    return entries
