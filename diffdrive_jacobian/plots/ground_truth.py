"""The true path of a robot whose odometry drifts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.bags.time_series import line
from diffdrive_jacobian.bags.timeline import jumps

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

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
