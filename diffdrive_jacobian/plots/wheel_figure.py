"""A wheel as a contact: a point of its rim at the angle phi, and the columns of its Jacobian (C)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics import contact
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREEN, GREY

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PHI = 0.9
"""Angle of the point P that is drawn beside the one at the ground (rad)."""
SECONDS = 0.8
"""Velocities are drawn as the way that is made in this time, at one radian per second (s)."""


@picture
def wheel(r: float = 0.5) -> Figure:
    """Draw a wheel with a point P of its rim, phi = 0 on top: its position, and the columns of J_P.

    The velocity of a point is `x_dot` times the first column plus `phi_dot` times the second. The wheel
    rolls, `x_dot = r phi_dot`, so the two cancel at the ground.

    Args:
        r: Wheel radius (m).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
        ValueError: r is not positive and finite.
    """
    from matplotlib.patches import Circle

    x_dot, phi_dot = contact.rolling_direction(r)
    x = 2.0 * r
    drawing, axes = sketch.canvas(6.9, (-0.45 * r, 5.1 * r), (-0.75 * r, 2.55 * r))
    C = np.array([x, r])
    axes.add_patch(Circle((x, r), r, fc=sketch.FILL, ec=sketch.INK, lw=1.6))
    sketch.line(axes, [-0.3 * r, 0.0], [4.4 * r, 0.0], lw=1.6)
    sketch.frame(axes, [0.0, 0.0, 0.0], 0.5 * r, '', 'up')
    sketch.point(axes, [0.0, 0.0], '$O$', (-9.0, -10.0))
    sketch.dimension(axes, [0.0, 0.0], [x, 0.0], -0.45 * r, '$x$')
    top = contact.wheel_contact_position(x, 0.0, r)[:2]
    sketch.line(axes, C, top, color=GREY, lw=0.9, ls=DASHED)
    sketch.point(axes, top, r'$\phi = 0$', (-8.0, 12.0))
    tips = []
    for phi, text, offset in (
        (PHI, '$P$', (-12.0, 0.0)),
        (contact.AT_GROUND, r'$\phi = \pi$', (-20.0, 13.0)),
    ):
        P = contact.wheel_contact_position(x, phi, r)[:2]
        along, around = SECONDS * (contact.wheel_contact_jacobian(phi, r)[:2] * [x_dot, phi_dot]).T
        sketch.line(axes, C, P, color=GREY, lw=0.9)
        sketch.arrow(axes, P, along, color=GREEN, lw=2.4)
        sketch.arrow(axes, P, around, color=BLUE, lw=2.4)
        sketch.point(axes, P, text, offset)
        tips += [P + along, P + around]
    labels = (
        (r'$\dot x\ [1, 0]$', (30.0, 0.0), GREEN),
        (r'$\dot\phi\ [r\,\cos\phi, -r\,\sin\phi]$', (70.0, -6.0), BLUE),
        (r'$\dot x$', (6.0, -13.0), GREEN),
        (r'$-r\,\dot\phi$', (-4.0, -13.0), BLUE),
    )
    for tip, (label, offset, color) in zip(tips, labels, strict=True):
        sketch.label(axes, label, tip, offset, color=color)
    sketch.label(axes, r'rolls: $v_P = 0$', [x + 1.6 * r, 0.0], (0.0, 13.0))
    sketch.angle(axes, C, 0.35 * r, np.pi / 2.0, np.pi / 2.0 - PHI, r'$\phi$')
    sketch.dimension(axes, C, C - [r, 0.0], 0.0, '$r$')
    sketch.point(axes, C)
    return drawing
