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

"""A sweep of gains as one picture: heat maps of time to goal, path length and overshoot."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_jacobian.control.controller import KP, KV, Boundary, Gain
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.time_units import NANOSECONDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import NDArray

    from diffdrive_jacobian.simulation.gain_sweep import Sweep, SweepSetup

SIZE = (13.0, 5.2)
"""Size of the picture (inches)."""
TITLES = {
    'time': 'time to goal [s]',
    'path_length': 'path length [m]',
    'overshoot': 'overshoot beyond the goal [m]',
}
LOGARITHMIC_RATIO = 4.0
"""A logarithmic scale is used if the largest value is more than this times the smallest [-]."""
CONTOUR_GRID = 10
"""Smallest grid for which contour lines are drawn."""
COLORS = 'viridis'
"""Perceptually uniform, also for the colour-blind."""
TICKS = (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0)
"""Ticks of a logarithmic scale within one decade."""
LINE, LIT, EMPTY = 'black', 'white', '#dcdcdc'
DASHES = (0, (5, 2))


@picture
def sweep_figure(swept: Sweep) -> Figure:
    """Return a sweep as a figure. Its axes are the heat maps, then the legend, then the scales.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    drawn = Figure(figsize=SIZE, layout='constrained')
    grid = drawn.add_gridspec(2, len(TITLES), height_ratios=[1.0, 0.02])
    panels = [drawn.add_subplot(grid[0, column]) for column in range(len(TITLES))]
    below = drawn.add_subplot(grid[1, :])
    for panel, (measure, title) in zip(panels, TITLES.items(), strict=True):
        _draw_map(drawn, panel, swept, measure)
        _draw_boundary(panel, swept.setup)
        for mark in _marks(swept):
            mark.set_clip_on(False)
            panel.add_line(mark)
        panel.set_title(title, pad=10.0)
        panel.set_xlabel(_label(swept.setup.axes[0]))
    panels[0].set_ylabel(_label(swept.setup.axes[1]))
    below.axis('off')
    below.legend(handles=_legend(swept), loc='center', ncol=4, borderaxespad=0.0)
    drawn.suptitle(describe(swept.setup))
    return drawn


def describe(setup: SweepSetup) -> str:
    """Return two lines about the settings of a sweep, three for a robot that takes time."""
    limits, actuators = setup.robot.limits, setup.robot.actuators
    v, omega = actuators.acceleration.v, actuators.acceleration.omega
    wheels = actuators.acceleration.max_wheel_acceleration
    bounds, accelerations = (
        [
            f'{name} {_within(low, high)} {unit}'
            for name, low, high, unit in group
            if math.isfinite(low) or math.isfinite(high)
        ]
        for group in (
            [
                ('v', limits.min_v, limits.max_v, 'm/s'),
                (r'$\omega$', limits.min_omega, limits.max_omega, 'rad/s'),
                ('wheels', -limits.max_wheel_speed, limits.max_wheel_speed, 'rad/s'),
            ],
            [
                ('acceleration', v.max_deceleration, v.max_acceleration, 'm/s²'),
                ('angular', omega.max_deceleration, omega.max_acceleration, 'rad/s²'),
                ('of the wheels', -wheels, wheels, 'rad/s²'),
            ],
        )
    )
    accelerations += [
        f'{name} {seconds:g} s'
        for name, seconds in (('lag', actuators.lag), ('delay', actuators.delay / NANOSECONDS))
        if seconds
    ]
    starts = f'{setup.starts} starts in all directions' if setup.starts > 1 else '1 start'
    there = f'{setup.tolerance:g} m'
    if setup.arrival.use_heading:
        there += f' and {setup.arrival.yaw_tolerance:g} rad'
    return (
        f'{setup.resolved_controller.name}: mean over {starts}, {setup.distance:g} m from the goal\n'
        f'control rate {setup.rate:g} Hz; velocity limits: {", ".join(bounds) or "none"}; '
        f'arrived within {there}' + (f'\n{", ".join(accelerations)}' if accelerations else '')
    )


def _label(gain: Gain) -> str:
    return f'{gain.name} [{gain.unit}]' if gain.unit else gain.name


def _within(low: float, high: float) -> str:
    return f'±{high:g}' if -low == high else f'{low:g} to {high:g}'


def _draw_map(drawn: Figure, panel: Axes, swept: Sweep, measure: str) -> None:
    """Draw a heat map with its scale; hatched where the robot did not arrive from all starts."""
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.ticker import FuncFormatter, LogLocator

    # Cells with NaN stay empty.
    values = np.where(swept.complete, swept.mean(measure), np.nan)
    found = values[swept.complete]
    low, high = _range(found, from_zero=measure == 'overshoot')
    logarithmic = low > 0.0 and high / low > LOGARITHMIC_RATIO
    norm: Any = LogNorm(low, high) if logarithmic else Normalize(low, high)
    edges = _edges(swept.x), _edges(swept.y)
    mesh = panel.pcolormesh(*edges, values, norm=norm, cmap=COLORS, rasterized=True)
    panel.set(xlim=swept.x[[0, -1]], ylim=swept.y[[0, -1]], facecolor=EMPTY)
    panel.patch.set(hatch='////', edgecolor='white', lw=0.0)
    panel.grid(False)
    panel.spines[:].set_visible(True)
    scale = drawn.colorbar(mesh, ax=panel, pad=0.02, aspect=28)
    outline: Any = scale.outline
    outline.set_linewidth(0.8)
    if logarithmic:
        scale.ax.yaxis.set_major_locator(LogLocator(subs=TICKS))
        scale.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
        scale.ax.minorticks_off()
    # The same lines in the map and on its scale make numbers in the map unnecessary.
    levels = [level for level in scale.get_ticks() if (found < level).any() and (found > level).any()]
    if levels and swept.setup.grid >= CONTOUR_GRID:
        style: Any = {'colors': LIT, 'linewidths': 0.7, 'alpha': 0.6}
        scale.add_lines(panel.contour(swept.x, swept.y, values, levels, **style))


def _range(values: NDArray[np.float64], *, from_zero: bool) -> tuple[float, float]:
    """Return the ends of a scale, which are never equal."""
    low, high = (float(np.min(values)), float(np.max(values))) if len(values) else (0.0, 1.0)
    low = 0.0 if from_zero else low
    return (low, high) if high - low > 1e-3 else (low, low + 1e-3)


def _edges(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the edges of the cells; the outermost are the first and the last gain."""
    return np.concatenate([centres[:1], (centres[1:] + centres[:-1]) / 2.0, centres[-1:]])


def _draw_boundary(panel: Axes, setup: SweepSetup) -> None:
    """Draw the boundary of the controller where it lies in the picture, with its equation if it fits."""
    from matplotlib.patheffects import withStroke

    boundary, (low, high) = _visible_boundary(setup)
    if boundary is None:
        return
    ratio, kv = boundary.ratio, np.array([low, high])
    panel.plot(ratio * kv, kv, color=LIT, lw=3.6, alpha=0.55)
    panel.plot(ratio * kv, kv, color=LINE, lw=1.6, ls=DASHES)
    ends = np.ptp(panel.transLimits.transform(np.column_stack([ratio * kv, kv])), axis=0)
    if np.hypot(*ends) > 0.6:
        at = low + 0.62 * (high - low)
        panel.text(
            ratio * at + 0.02 * np.ptp(setup.ends(KP)),
            at,
            boundary.equation,
            rotation=math.degrees(math.atan2(1.0, ratio)),
            rotation_mode='anchor',
            transform_rotates_text=True,
            va='top',
            color=LIT,
            path_effects=[withStroke(linewidth=2.0, foreground='#000000b0')],
        )


def _visible_boundary(setup: SweepSetup) -> tuple[Boundary | None, tuple[float, float]]:
    """Return the boundary with its first and last kv in the picture; None: it is not in it."""
    boundary = setup.resolved_controller.boundary
    if boundary is None or setup.axes != (KP, KV):
        return None, (0.0, 0.0)
    kp, kv = setup.ends(KP), setup.ends(KV)
    low, high = max(kp[0] / boundary.ratio, kv[0]), min(kp[1] / boundary.ratio, kv[1])
    return boundary if low < high else None, (low, high)


def _marks(swept: Sweep) -> list[Line2D]:
    """Return the marks of the reference gains and of the fastest ones."""
    from matplotlib.lines import Line2D

    marks = []
    style: Any = {'ls': '', 'mec': LINE, 'mfc': LIT, 'mew': 1.2, 'zorder': 5}
    x, y = swept.setup.axes
    inside = [low <= gain.default <= high for gain in (x, y) for low, high in [swept.setup.ends(gain)]]
    if all(inside):
        label = f'defaults: {x.name} {x.default:g}, {y.name} {y.default:g}'
        marks.append(Line2D([x.default], [y.default], marker='o', ms=8, label=label, **style))
    found = swept.fastest()
    if found is not None:
        at = float(swept.x[found[1]]), float(swept.y[found[0]])
        label = f'fastest: {x.name} {at[0]:.4g}, {y.name} {at[1]:.4g}'
        label += f', {swept.mean("time")[found]:.2f} s'
        marks.append(Line2D([at[0]], [at[1]], marker='*', ms=14, label=label, **style))
    return marks


def _legend(swept: Sweep) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    setup = swept.setup
    entries: list[Any] = []
    boundary, _ = _visible_boundary(setup)
    if boundary is not None:
        label = f'{boundary.equation}: {boundary.beyond}'
        entries.append(Line2D([], [], color=LINE, lw=1.6, ls=DASHES, label=label))
    entries += _marks(swept)
    if not swept.complete.all():
        label = f'not all starts arrived within {setup.duration:g} s'
        entries.append(Patch(fc=EMPTY, ec='white', hatch='////', lw=0.0, label=label))
    return entries
