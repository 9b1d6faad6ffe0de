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

"""A calibration as one picture: paths before and after, and the errors over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_jacobian.calibration.description import Track, compared_distance, rms, tracks
from diffdrive_jacobian.calibration.result import Calibration
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.run_lines import line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

SIZE = (11.0, 6.4)
"""Size of the figure (inches)."""
BEFORE, AFTER, REFERENCE = '#D55E00', '#0072B2', '#444444'
MOST_TRACKS = 12
"""Number of continuous motions beyond which only the first are drawn in the plane."""
_NO_BREAKS = np.array([], dtype=np.intp)


@picture
def calibration_figure(result: Calibration) -> Figure:
    """Return a calibration as a figure. Its axes are the plane, then the errors over time.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    distance = compared_distance(result)
    before, after = (
        tracks(result, geometry, distance) for geometry in (result.nominal, result.geometry)
    )
    drawing = Figure(figsize=SIZE, layout='constrained')
    grid = drawing.add_gridspec(3, 2, width_ratios=[1.2, 1.0])
    plane = drawing.add_subplot(grid[:, 0])
    _draw_plane(plane, before, after)
    panels = [drawing.add_subplot(grid[0, 1])]
    panels += [drawing.add_subplot(grid[row, 1], sharex=panels[0]) for row in (1, 2)]
    for panel, name, unit in zip(panels, ('position', 'heading'), ('m', 'rad'), strict=False):
        for drawn, label, color in ((before, 'before', BEFORE), (after, 'after', AFTER)):
            values = [getattr(one, f'{name}_error') for one in drawn]
            rows = _over_time(drawn, values)
            panel.plot(*rows.T, color=color, lw=1.3, label=f'{label}: rms {rms(values):.3g} {unit}')
        panel.set(ylabel=f'{name} error\nafter {distance:.2g} m [{unit}]')
        panel.legend(loc='upper left', ncol=2, fontsize=8.5, bbox_to_anchor=(0.0, 1.25))
    _draw_residuals(panels[2], result)
    panels[2].set(xlabel='time [s]')
    names = ('left radius', 'right radius', 'separation')
    found = zip(names, result.multipliers, np.sqrt(np.diag(result.covariance)), strict=True)
    multipliers = ', '.join(f'{name} {one:.5f} ± {std:.5f}' for name, one, std in found)
    drawing.suptitle(f'multipliers: {multipliers}', fontsize=9.5)
    return drawing


def _draw_plane(plane: Axes, before: list[Track], after: list[Track]) -> None:
    """Draw the paths; those of the odometry start at the reference."""
    styles: tuple[tuple[list[Track], str, Any], ...] = (
        (before, 'odometry before', {'color': BEFORE, 'lw': 1.3}),
        (after, 'odometry after', {'color': AFTER, 'lw': 1.5}),
    )
    for drawn, label, style in styles:
        for index, one in enumerate(drawn[:MOST_TRACKS]):
            rows = line(one.odometry[:, :2], _NO_BREAKS)
            plane.plot(*rows.T, label=None if index else label, **style)
    for index, one in enumerate(after[:MOST_TRACKS]):
        rows = line(one.reference[:, :2], _NO_BREAKS)
        name = None if index else 'reference'
        plane.plot(*rows.T, color=REFERENCE, lw=1.0, ls=(0, (4, 1.5)), label=name)
        start = {'ls': '', 'marker': 'o', 'ms': 8, 'mfc': 'white', 'mec': REFERENCE, 'mew': 1.5}
        place = one.reference[:1, :2].T
        plane.plot(*place, label=None if index else 'start', **start)  # type: ignore[arg-type]
    plane.set_aspect('equal', adjustable='datalim')
    plane.margins(0.08)
    plane.set(xlabel='x [m]', ylabel='y [m]')
    plane.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncol=4, borderaxespad=0.2)


def _over_time(drawn: list[Track], values: list[Array]) -> Array:
    """Return the values of all tracks over the time since the first, broken between tracks."""
    parts: list[Array] = []
    begin = -float(drawn[0].time[0])
    for index, (one, value) in enumerate(zip(drawn, values, strict=True)):
        if index and one.recording != drawn[index - 1].recording:
            # Recordings follow each other, whenever they were made.
            begin += float(drawn[index - 1].time[-1] - one.time[0])
        parts += [np.column_stack([begin + one.time, value]), np.full((1, 2), np.nan)]
    return line(np.concatenate(parts), _NO_BREAKS)


def _draw_residuals(panel: Axes, result: Calibration) -> None:
    """Draw what remains between the reference and the most likely poses of the sensor."""
    residuals = result.residuals()
    time = np.concatenate([one[:, 0] for one in residuals])
    for column, name, color in ((1, 'x', '#009E73'), (2, 'y', '#CC79A7')):
        values = np.concatenate([one[:, column] for one in residuals])
        panel.plot(time, 1e3 * values, '.', ms=1.5, color=color, label=name, rasterized=True)
    sigma = 2e3 * result.estimate.noise.position
    for bound in (-sigma, sigma):
        panel.axhline(bound, color='black', lw=0.9, ls=(0, (6, 3)))
    panel.set(ylabel='residual of the\nreference [mm]')
    panel.plot([], [], color='black', lw=0.9, ls=(0, (6, 3)), label='±2 standard deviations')
    panel.legend(loc='upper left', ncol=3, fontsize=8.5, bbox_to_anchor=(0.0, 1.25), markerscale=5)
