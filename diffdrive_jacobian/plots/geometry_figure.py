"""The robot from above with its symbols: pose, wheels, twist, and the offset point of document B."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics import diff_drive
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREY, RED, placed
from diffdrive_jacobian.plots.style import picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POSE = (0.2, 0.16, 0.6)
"""Pose of the robot."""


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
    x, y, theta = POSE
    C, p_d = np.array([x, y]), diff_drive.offset_point(POSE, d)
    e_f, e_l = np.array([np.cos(theta), np.sin(theta)]), np.array([np.sin(theta), -np.cos(theta)])
    drawing, axes = sketch.canvas(6.6, (-0.05, 0.45), (-0.03, 0.36))
    # The world, and the pose in it.
    sketch.frame(axes, [0.0, 0.0, 0.0], 0.07, '$x_W$', '$y_W$')
    sketch.line(axes, [x, 0.0], C, [0.0, y], color=GREY, lw=0.8, ls=DASHED)
    sketch.label(axes, '$x$', [x, 0.0], (0.0, -9.0))
    sketch.label(axes, '$y$', [0.0, y], (-9.0, 0.0))
    sketch.robot(axes, POSE, r, L)
    sketch.line(axes, C, [x + 0.19, y], color=GREY, lw=0.8, ls=DASHED)
    sketch.angle(axes, C, 0.165, 0.0, theta, r'$\theta$')
    # The body frame and its twist.
    sketch.arrow(axes, C, 0.25 * e_f, '$x_B$', (9.0, 6.0), lw=1.0)
    sketch.arrow(axes, C, -0.18 * e_l, '$y_B$', (-6.0, 9.0), lw=1.0)
    sketch.arrow(axes, C, 0.06 * e_f, '$v$', (5.0, -10.0), color=BLUE, lw=2.6)
    sketch.angle(axes, C, 0.03, theta + 1.9, theta + 3.9, r'$\omega$', color=BLUE)
    sketch.point(axes, C, '$C$', (13.0, -6.0))
    # The wheels.
    right, left = placed([[0.0, -L / 2.0], [0.0, L / 2.0]], POSE)
    back, front = placed([[-r, -L / 2.0], [r, -L / 2.0]], POSE)
    sketch.dimension(axes, left, right, -0.09, '$L$')
    sketch.dimension(axes, back, front, -0.03, '$2r$')
    sketch.label(axes, 'left wheel, $\\omega_L$', left, (-62.0, 12.0))
    sketch.label(axes, 'right wheel, $\\omega_R$', front, (44.0, 10.0))
    # The offset point.
    sketch.dimension(axes, C, p_d, 0.035, '$d$', color=RED)
    sketch.point(axes, p_d, '$p_d$', (9.0, -10.0), color=RED)
    return drawing
