"""The Lie bracket of the unicycle: four motions that do not close, and the sideways gap they leave."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics import diff_drive, se2
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREY, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

R, L = 0.033, 0.16
"""Wheel radius and separation of the robot that is drawn (m)."""
A, B = 0.5, 0.8
"""Distance forward and back (m), angle turned and turned back (rad)."""
OBLIQUE = np.array([[1.0, 0.0], [0.5, 0.35], [0.0, 0.55]])
"""Where a metre along x, a metre along y and a radian are in the drawing of the poses."""
EDGES = ('1 forward', '2 turn', '3 back', '4 turn back')


@picture
def lie_bracket() -> Figure:
    """Draw the parallelogram of the Lie bracket: from above, over the poses, and as it gets smaller.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(9.0, 3.2), layout='constrained')
    above, poses, order = drawing.subplots(1, 3, width_ratios=[1.2, 1.2, 1.0])
    corners = parallelogram(A, B)
    _draw_from_above(above, corners)
    _draw_poses(poses, corners)
    _draw_order(order)
    return drawing


def parallelogram(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Return the corners of forward, turn, back, turn back, from the pose 0; shape (5, ..., 3).

    Args:
        a: Distance forward and back, shape (...) (m).
        b: Angle, shape (...) (rad).
    """
    forward = np.stack(np.broadcast_arrays(a, 0.0 * np.asarray(b)), axis=-1)
    turn = np.stack(np.broadcast_arrays(0.0 * np.asarray(a), b), axis=-1)
    corners = [np.zeros((*forward.shape[:-1], 3))]
    for twist in (forward, turn, -forward, -turn):
        corners.append(se2.integrate(corners[-1], twist, 1.0))
    return np.array(corners)


def _draw_from_above(axes: Axes, corners: NDArray[np.float64]) -> None:
    """Draw the way of the robot, and the robot at its start and at its end."""
    start, ahead, turned, back, end = corners
    sketch.robot(axes, start, R, L)
    sketch.robot(axes, end, R, L)
    sketch.arrow(axes, start[:2], ahead[:2] - start[:2], color=BLUE)
    sketch.arrow(axes, turned[:2], back[:2] - turned[:2], color=BLUE)
    sketch.angle(axes, ahead[:2], 0.09, ahead[2], turned[2], '2', color=BLUE)
    sketch.label(axes, '1', (start + ahead)[:2] / 2.0, (0.0, 9.0), color=BLUE)
    sketch.label(axes, '3', (turned + back)[:2] / 2.0, (6.0, -9.0), color=BLUE)
    sketch.angle(axes, back[:2], 0.11, back[2], end[2], '4', color=BLUE)
    sketch.arrow(axes, start[:2], (end - start)[:2], color=RED, lw=3.2, mutation_scale=18.0, zorder=6)
    sketch.label(axes, 'gap', (start + end)[:2] / 2.0, (18.0, 0.0), color=RED)
    bracket = A * B * diff_drive.lie_bracket(0.0)[:2]
    sketch.arrow(axes, start[:2], bracket, lw=1.2, ls=DASHED)
    sketch.label(axes, '$ab\\,[g_1, g_2]$', bracket, (0.0, -17.0), fontsize=9.5)
    axes.set(title=f'from above: a = {A:g} m, b = {B:g} rad', xlabel='x [m]', ylabel='y [m]')
    axes.set_aspect('equal', adjustable='datalim')
    axes.margins(0.15)


def _draw_poses(axes: Axes, corners: NDArray[np.float64]) -> None:
    """Draw the four motions as straight lines in the space of poses, obliquely."""
    flat = corners @ OBLIQUE
    for direction, text, offset in zip(
        0.75 * np.diag([1.0, 0.6, 1.5]),
        ('$x$', '$y$', r'$\theta$'),
        ((10.0, 0.0), (8.0, 6.0), (0.0, 9.0)),
        strict=True,
    ):
        sketch.arrow(axes, [0.0, 0.0], direction @ OBLIQUE, text, offset, color=GREY, lw=1.0)
    offsets = ((0.0, -10.0), (26.0, 0.0), (0.0, 12.0), (-40.0, 0.0))
    for edge, first, last, offset in zip(EDGES, flat[:-1], flat[1:], offsets, strict=True):
        sketch.arrow(axes, first, last - first, color=BLUE)
        sketch.label(axes, edge, (first + last) / 2.0, offset, color=BLUE, fontsize=9.5)
    sketch.arrow(axes, flat[0], flat[-1] - flat[0], color=RED, lw=3.2, mutation_scale=16.0, zorder=6)
    text = r'gap $\approx ab\,[g_1, g_2]$'
    sketch.label(axes, text, flat[-1], (-6.0, -14.0), color=RED, fontsize=9.5)
    axes.set(title=r'over the poses $(x, y, \theta)$', aspect='equal')
    axes.set(xlim=(-0.35, 0.95), ylim=(-0.3, 0.75))
    axes.set_axis_off()


def _draw_order(axes: Axes) -> None:
    """Draw how fast the gap tends to the bracket as the parallelogram gets smaller."""
    size = np.geomspace(1e-2, 1.0, 50)
    gap = parallelogram(size, size)[-1]
    bracket = size[:, np.newaxis] ** 2 * diff_drive.lie_bracket(0.0)
    axes.loglog(size, np.linalg.norm(gap, axis=-1), color=RED, lw=3.6, label='gap')
    axes.loglog(size, size**2, color='black', lw=1.0, ls=DASHED, label='$ab$, the bracket')
    axes.loglog(
        size, np.linalg.norm(gap - bracket, axis=-1), color=GREY, lw=1.8, ls=':', label='difference'
    )
    axes.set(title='of second order', xlabel='$a = b$ [m, rad]', ylabel='length [m]')
    axes.set(xticks=[0.01, 0.1, 1.0], yticks=10.0 ** np.arange(-6.0, 1.0), ylim=(1e-7, 1e3))
    axes.legend(loc='upper left')
