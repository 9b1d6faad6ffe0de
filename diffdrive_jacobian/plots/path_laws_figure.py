"""The laws of paths over one figure eight, from a start beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.control.path import Path
from diffdrive_jacobian.control.path_following import PathSettings
from diffdrive_jacobian.control.path_laws import PATH_CONTROLLERS
from diffdrive_jacobian.control.path_source import figure_eight_path
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, GREEN, INK, RED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE, SPEED = 1.0, 0.4
"""Half of the length of the figure eight (m), and the speed (m/s)."""
START = (-0.2, 0.0, -0.97)
"""Where the robot starts: 20 cm beside the path, and not along it (m, m, rad)."""
STYLES = {
    'pure_pursuit': (RED, '-'),
    'kanayama': (BLUE, '-'),
    'offset_point': (GREEN, '--'),
    'dynamic_feedback': (INK, '-.'),
}
"""Colour and line of each law."""
LEAST = 1e-5
"""Smallest error that is drawn (m)."""


@picture
def path_laws() -> Figure:
    """Draw an ideal robot under each law of paths: from above, and its error across the path.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    from diffdrive_jacobian.simulation.tracking import follow_path

    drawing = Figure(figsize=(5.0, 4.2), layout='constrained')
    above, errors = drawing.subplots(2, 1, height_ratios=[1.1, 1.0])
    path = Path(se2.compose([0.0, 0.0, -np.pi / 2.0], figure_eight_path(SIZE).poses))
    x, y, _ = path.poses_at(np.linspace(0.0, path.length, 200)).T
    above.plot(x, y, color='#cccccc', lw=5.0, label='planned')
    for law in PATH_CONTROLLERS:
        settings = PathSettings(speed=SPEED, lookahead=law.lookahead_distance(law.defaults))
        driven = follow_path(law, path, start=START, settings=settings)
        colour, line = STYLES[law.name]
        style = {'color': colour, 'ls': line, 'lw': 1.2}
        above.plot(driven.poses[:, 0], driven.poses[:, 1], label=law.name, **style)
        across = np.maximum(abs(driven.errors[::4, 1]), LEAST)
        errors.semilogy(driven.references[::4, 7], 1e3 * across, **style)
    above.plot(*START[:2], 'k.', ms=6.0)
    above.annotate('start', START[:2], xytext=(-6.0, 6.0), textcoords='offset points')
    above.set(xlabel='x [m]', ylabel='y [m]', aspect='equal')
    drawing.legend(loc='outside lower center', ncols=3, handlelength=2.5)
    errors.set(xlabel='distance along the path [m]', ylabel='error across [mm]')
    return drawing
