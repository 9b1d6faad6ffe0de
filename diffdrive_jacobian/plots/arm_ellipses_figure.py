"""An arm along a motion, with the ellipses of what its tip can do: velocities and forces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.control import StraightLine
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREY, RED
from diffdrive_jacobian.simulation import track_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from diffdrive_jacobian.kinematics.inverse_velocity import Ellipsoid
    from diffdrive_jacobian.numerics.formula import Array

LENGTHS = (1.0, 1.0)
START, END = (0.5, 0.0), (1.86, 0.0)
SCALE = 0.1
"""Size of the ellipses (m for 1 m/s, and for 1 N)."""
SHOWN = 4
"""How many configurations of the motion are drawn."""


@picture
def arm_ellipses(lengths: ArrayLike = LENGTHS, start: ArrayLike = START, end: ArrayLike = END) -> Figure:
    """Draw an arm of two links whose tip moves along a line, with its ellipses, and its measures below.

    Args:
        lengths: Lengths of both links, shape (2,) (m).
        start: Where the tip starts, elbow up, shape (2,) (m).
        end: Where it ends, shape (2,) (m).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
        ValueError: The line is out of reach.
    """
    from matplotlib.figure import Figure

    arm = PlanarArm(lengths)
    line = StraightLine(start, end, speed=0.1)
    q = track_line(arm, arm.inverse_kinematics(start)[1], line).q
    drawing = Figure(figsize=(5.4, 4.7), layout='constrained')
    above, below = drawing.subplots(2, 1, height_ratios=[1.6, 1.0])
    above.set(aspect='equal', xlabel='x [m]', ylabel='y [m]')
    for share, index in enumerate(np.linspace(0, len(q) - 1, SHOWN).astype(int)):
        J, shade = arm.jacobian(q[index]), str(0.75 - 0.75 * share / (SHOWN - 1))
        joints = arm.joint_positions(q[index])
        above.plot(*joints.T, 'o-', color=shade, lw=2.2, ms=5.0, solid_capstyle='round')
        _draw_ellipse(above, joints[-1], iv.velocity_ellipsoid(J), color=BLUE, lw=1.8)
        _draw_ellipse(above, joints[-1], iv.force_ellipsoid(J), color=RED, lw=1.4, ls=DASHED)
    for what, unit, style in (
        (r'velocities, $|\dot q| \leq 1$ rad/s', 'm/s', {'color': BLUE, 'lw': 1.8}),
        (r'forces, $|\tau| \leq 1$ N m', 'N', {'color': RED, 'lw': 1.4, 'ls': DASHED}),
    ):
        above.plot([], [], label=f'{what} ({SCALE:g} m for 1 {unit})', **style)
    above.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0))
    above.set(ylim=(-0.35, None))
    above.grid(False)
    sketch.line(above, start, end, color=GREY, lw=0.8)
    _draw_measures(below, arm, q, line)
    return drawing


def _draw_ellipse(axes: Axes, centre: Array, ellipsoid: Ellipsoid, **style: object) -> None:
    U, semi_axes = ellipsoid
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    unit = np.stack([np.cos(turn), np.sin(turn)])
    x, y = centre[:, np.newaxis] + SCALE * U @ (semi_axes[:, np.newaxis] * unit)
    axes.plot(x, y, **style)  # type: ignore[arg-type]


def _draw_measures(axes: Axes, arm: PlanarArm, q: Array, line: StraightLine) -> None:
    """Draw the measures of manipulability over the distance that the tip has travelled."""
    travelled = np.linspace(0.0, float(line.duration * line.speed), len(q))
    J = arm.jacobian(q)
    for values, style, text in (
        (iv.manipulability(J), '-', '$w$ [m²]'),
        (iv.smallest_singular_value(J), '--', '$s_2$ [m]'),
        (1.0 / iv.condition_number(J), ':', '$s_2/s_1$'),
    ):
        axes.plot(travelled, values, style, color='black', lw=1.6)
        sketch.label(axes, text, [travelled[-1], values[-1]], (6.0, 0.0), ha='left')
    axes.set(xlabel='distance travelled by the tip [m]', ylim=(0.0, None), xlim=travelled[[0, -1]])
