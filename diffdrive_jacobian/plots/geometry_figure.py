"""The robot from above with its symbols: pose, wheels, twist, and the offset point of document B."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics.diff_drive import offset_point, wheel_centres
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREY, RED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

THETA = 0.6
"""Heading of the robot (rad)."""


@picture
def geometry(r: float = 0.033, L: float = 0.16, d: float = 0.1) -> Figure:
    """Draw the robot from above with its symbols, to scale (the top views of B, figure 1 of E).

    Args:
        r: Wheel radius (m).
        L: Wheel separation (m).
        d: Coordinate x of the offset point in the body frame (m).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    x, y, theta = pose = np.array([1.25 * L, L, THETA])
    C, p_d, (right, left) = pose[:2], offset_point(pose, d), wheel_centres(pose, L)
    e_f, e_l = np.array([np.cos(theta), np.sin(theta)]), np.array([np.sin(theta), -np.cos(theta)])
    drawing, axes = sketch.canvas(6.6, (-0.3 * L, 2.8 * L), (-0.2 * L, 2.25 * L))
    # The world, and the pose in it.
    sketch.frame(axes, [0.0, 0.0, 0.0], 0.44 * L, '$x_W$', '$y_W$')
    sketch.line(axes, [x, 0.0], C, [0.0, y], color=GREY, lw=0.8, ls=DASHED)
    sketch.label(axes, '$x$', [x, 0.0], (0.0, -9.0))
    sketch.label(axes, '$y$', [0.0, y], (-9.0, 0.0))
    sketch.robot(axes, pose, r, L)
    sketch.line(axes, C, [x + 1.2 * L, y], color=GREY, lw=0.8, ls=DASHED)
    sketch.angle(axes, C, 1.05 * L, 0.0, theta, r'$\theta$')
    # The body frame and its twist.
    sketch.arrow(axes, C, 1.55 * L * e_f, '$x_B$', (9.0, 6.0), lw=1.0)
    sketch.arrow(axes, C, -1.1 * L * e_l, '$y_B$', (-6.0, 9.0), lw=1.0)
    sketch.arrow(axes, C, 0.38 * L * e_f, '$v$', (5.0, -10.0), color=BLUE, lw=2.6)
    sketch.angle(axes, C, 0.19 * L, theta + 1.9, theta + 3.9, r'$\omega$', color=BLUE)
    sketch.point(axes, C, '$C$', (13.0, -6.0))
    # The wheels.
    back, front = right - r * e_f, right + r * e_f
    sketch.dimension(axes, left, right, -0.56 * L, '$L$')
    sketch.dimension(axes, back, front, -0.19 * L, '$2r$')
    sketch.label(axes, r'left wheel, $\omega_L$', left, (-62.0, 12.0))
    sketch.label(axes, r'right wheel, $\omega_R$', front, (44.0, 10.0))
    # The offset point.
    sketch.dimension(axes, C, p_d, 0.22 * L, '$d$', color=RED)
    sketch.point(axes, p_d, '$p_d$', (9.0, -10.0), color=RED)
    return drawing
