"""Velocity ellipses of the points of a differential drive: a line at the axle, a circle at d = L/2."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics import diff_drive
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

CIRCLE = np.array([np.cos(np.linspace(0.0, 2.0 * pi, 121)), np.sin(np.linspace(0.0, 2.0 * pi, 121))])
"""Wheel speeds of norm 1, as columns `[omega_R, omega_L]`."""
SIZE = 0.12
"""Length along the heading of all ellipses in the figure, from their centre, in wheel separations."""


@picture
def velocity_ellipses(r: float = 0.033, L: float = 0.16) -> Figure:
    """Draw which velocities of four points follow from wheel speeds of norm 1 (B).

    At the axle they are on a line: both columns of the Jacobian are parallel, and its rank is 1. At the
    distance d the ellipse has the semi-axes `r / sqrt(2)` along the heading and `sqrt(2) d r / L` to the
    side, which are equal at `d = L/2`.

    Args:
        r: Wheel radius (m).
        L: Wheel separation (m).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    drawing, axes = sketch.canvas(8.0, (-1.7 * L, 1.25 * L), (-0.8 * L, 0.62 * L))
    left, below = -1.2 * L, -0.7 * L
    _wheel_speeds(axes, np.array([left, 0.0]), 0.28 * L)
    sketch.label(axes, 'wheel speeds of norm 1', [left, below])
    sketch.robot(axes, [0.0, 0.0, 0.0], r, L)
    sketch.label(axes, 'velocities that they give to points at the distance $d$', [0.35 * L, below])
    seconds = SIZE * L / (r / np.sqrt(2.0))
    _image(axes, [0.0, 0.0], seconds * diff_drive.wheel_to_position_jacobian(0.0, r, L))
    _note(axes, [-0.19 * L, 0.0], '$d = 0$', 'a line:\nrank 1')
    for share, name, shape in ((0.25, 'L/4', ''), (0.5, 'L/2', 'a circle'), (1.0, 'L', '')):
        p_d = diff_drive.offset_point([0.0, 0.0, 0.0], share * L)
        _image(axes, p_d, seconds * diff_drive.offset_point_jacobian(0.0, r, L, share * L))
        _note(axes, p_d, f'$d = {name}$', shape)
    return drawing


def _wheel_speeds(axes: Axes, centre: NDArray[np.float64], radius: float) -> None:
    """Draw the circle of wheel speeds, with those of one wheel alone."""
    sketch.outline(axes, centre + radius * CIRCLE.T, lw=1.4)
    sketch.arrow(axes, centre, [radius, 0.0], r'$\omega_R$', (14.0, 0.0), color=BLUE)
    sketch.arrow(axes, centre, [0.0, radius], r'$\omega_L$', (0.0, 11.0), color=RED, ls='--')
    sketch.point(axes, centre)


def _image(axes: Axes, at: ArrayLike, J: NDArray[np.float64]) -> None:
    """Draw the image of the circle under a Jacobian at a point, and the columns of the Jacobian."""
    sketch.outline(axes, np.asarray(at) + (J @ CIRCLE).T, lw=1.4, zorder=3)
    for column, color, style in zip(J.T, (BLUE, RED), ('-', '--'), strict=True):
        sketch.arrow(axes, at, column, color=color, ls=style, lw=1.2, zorder=5)
    sketch.point(axes, at)


def _note(axes: Axes, at: ArrayLike, distance: str, shape: str) -> None:
    """Write the distance of a point below its ellipse, and its shape above it."""
    sketch.label(axes, distance, at, (0.0, -60.0))
    sketch.label(axes, shape, at, (0.0, 44.0))
