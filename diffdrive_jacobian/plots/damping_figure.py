"""Where the damping of least squares acts: in the workspace of two links, and at what price (A)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREY, RED
from diffdrive_jacobian.plots.style import picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

LEVELS = 6
"""Values of lambda at which the shade changes."""
SPEED = 0.1
"""Speed of the tip that is asked for, along the line from the base (m/s)."""


@picture
def damping(lengths: ArrayLike = (1.0, 0.7), threshold: float = 0.45, maximum: float = 0.1) -> Figure:
    """Draw where the damping of two links acts: lambda in the workspace, joint speeds and errors.

    Args:
        lengths: Lengths of the two links, shape (2,) (m).
        threshold: w_0, the manipulability below which there is damping (m^2).
        maximum: lambda_max, the damping of a singular Jacobian (m).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    arm = PlanarArm(lengths)
    drawing = Figure(figsize=(8.2, 3.5), layout='constrained')
    grid = drawing.add_gridspec(2, 2, width_ratios=[1.15, 1.0])
    _draw_workspace(drawing, drawing.add_subplot(grid[:, 0]), arm, threshold, maximum)
    speeds = drawing.add_subplot(grid[0, 1])
    _draw_over_bend(speeds, drawing.add_subplot(grid[1, 1], sharex=speeds), arm, threshold, maximum)
    return drawing


def _draw_workspace(
    drawing: Figure, axes: Axes, arm: PlanarArm, threshold: float, maximum: float
) -> None:
    """Draw lambda where the tip is, which depends on the bend q_2 alone, and three configurations."""
    bend, around = np.linspace(0.0, np.pi, 181), np.linspace(-np.pi, np.pi, 181)
    q = np.stack(np.meshgrid(around, bend), axis=-1)
    tip, factor = arm.forward_kinematics(q), _damping(arm, q, threshold, maximum)
    # Where there is no damping there is no shade.
    levels = [1e-6 * maximum, *np.linspace(0.0, maximum, LEVELS)[1:]]
    shade = axes.contourf(tip[..., 0], tip[..., 1], factor, levels, cmap='Greys', vmax=1.5 * maximum)
    scale = drawing.colorbar(shade, ax=axes, shrink=0.8, aspect=30, pad=0.02)
    scale.set_label(r'damping $\lambda$ [m]')
    for angles, joint, text, offset in (
        ([0.9, 0.06], 1, 'stretched', (-34.0, 2.0)),
        ([2.7, 1.4], 2, 'bent:\nnot damped', (22.0, -22.0)),
        ([-0.9, 3.0], 1, 'folded', (28.0, -2.0)),
    ):
        joints = arm.joint_positions(angles)
        sketch.line(axes, *joints, color=BLUE, lw=2.6, marker='o', ms=5.0, solid_capstyle='round')
        sketch.label(axes, text, joints[joint], offset, fontsize=9.5)
    axes.set(aspect='equal', title='where the tip is damped', xlabel='x [m]', ylabel='y [m]')
    axes.set(xticks=[-1.0, 0.0, 1.0], yticks=[-1.0, 0.0, 1.0])


def _draw_over_bend(
    speeds: Axes, errors: Axes, arm: PlanarArm, threshold: float, maximum: float
) -> None:
    """Draw joint speeds, and what is missing of the task, over the bend."""
    bend = np.linspace(0.0, np.pi, 2001)[1:-1]
    q = np.stack([0.0 * bend, bend], axis=-1)
    J, factor = arm.jacobian(q), _damping(arm, q, threshold, maximum)
    tip = arm.forward_kinematics(q)[:, :2]
    x_dot = SPEED * tip / np.linalg.norm(tip, axis=-1, keepdims=True)
    exact = iv.damped_least_squares(J, x_dot, 0.0)
    damped = iv.damped_least_squares(J, x_dot, factor)
    missing = x_dot - (J @ damped[..., np.newaxis])[..., 0]
    degrees = np.degrees(bend)
    style: Any = {'lw': 1.8}
    speeds.semilogy(degrees, _norm(exact), color=RED, ls=DASHED, label='exact inverse', **style)
    speeds.semilogy(degrees, _norm(damped), color=BLUE, label='damped', **style)
    with np.errstate(divide='ignore'):
        bound = SPEED / (2.0 * factor)
    speeds.semilogy(degrees, bound, color=GREY, ls=':', label=r'$|\dot x| / 2\lambda$', **style)
    speeds.set(ylim=(0.05, 50.0), yticks=[0.1, 1.0, 10.0], ylabel=r'$|\dot q|$ [rad/s]')
    speeds.set_title(f'desired: {SPEED:g} m/s away from the base')
    speeds.legend(loc='upper center')
    speeds.tick_params(labelbottom=False)
    errors.plot(degrees, 100.0 * _norm(missing) / SPEED, color=BLUE, **style)
    errors.set(xlabel='$q_2$ [degrees]', ylabel='not done [%]', xlim=(0.0, 180.0), ylim=(0.0, 105.0))
    errors.set_xticks(range(0, 181, 30))
    for axes in (speeds, errors):
        axes.fill_between(
            degrees, 0, 1, where=factor > 0.0, color='#e8e8e8', transform=axes.get_xaxis_transform()
        )
    errors.text(90.0, 55.0, 'no damping:\n$w \\geq w_0$', ha='center', va='center')
    errors.text(6.0, 88.0, r'$w < w_0$', va='center')


def _damping(
    arm: PlanarArm, q: NDArray[np.float64], threshold: float, maximum: float
) -> NDArray[np.float64]:
    w = iv.manipulability(arm.jacobian(q))
    return np.asarray(iv.damping(w, threshold, maximum))


def _norm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(vectors, axis=-1))
