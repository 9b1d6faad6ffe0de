"""Where the damping of least squares acts: in the workspace of two links, and at what price (A)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREY, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

LEVELS = 6
"""Values of lambda at which the shade changes."""
SPEED = 0.1
"""Speed of the tip that is asked for, along the line from the base (m/s)."""


@picture
def damping(lengths: ArrayLike = (0.5, 0.4), threshold: float = 0.1, maximum: float = 0.05) -> Figure:
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
    drawing = Figure(figsize=(8.4, 3.7), layout='constrained')
    grid = drawing.add_gridspec(2, 2, width_ratios=[1.15, 1.0])
    _draw_workspace(drawing, drawing.add_subplot(grid[:, 0]), arm, threshold, maximum)
    speeds = drawing.add_subplot(grid[0, 1])
    _draw_over_bend(speeds, drawing.add_subplot(grid[1, 1], sharex=speeds), arm, threshold, maximum)
    l_1, l_2 = arm.lengths
    links = f'$l_1$ = {l_1:g} m, $l_2$ = {l_2:g} m'
    chosen = rf'$w_0$ = {threshold:g} m², $\lambda_{{max}}$ = {maximum:g} m'
    drawing.suptitle(f'{links};  {chosen}', fontsize=9.5)
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
        ([-0.9, 3.0], 1, 'folded', (26.0, 8.0)),
    ):
        joints = arm.joint_positions(angles)
        sketch.line(axes, *joints, color=BLUE, lw=2.6, marker='o', ms=5.0, solid_capstyle='round')
        sketch.label(axes, text, joints[joint], offset, fontsize=9.5)
    axes.set(aspect='equal', title='where the tip is damped', xlabel='x [m]', ylabel='y [m]')
    # The outer ring is thin: a part of it, larger.
    reach = float(np.sum(arm.lengths))
    part = axes.inset_axes((0.58, 0.02, 0.38, 0.22), xlim=(0.94 * reach, 1.005 * reach))
    part.set(ylim=np.array([-0.02, 0.02]) * reach, xticks=[], yticks=[])
    part.grid(visible=False)
    part.spines[:].set_visible(True)
    part.contourf(tip[..., 0], tip[..., 1], factor, levels, cmap='Greys', vmax=1.5 * maximum)
    axes.indicate_inset_zoom(part, edgecolor=GREY)
    axes.locator_params(nbins=5)
    axes.set(xlim=(-1.05 * reach, 1.1 * reach), ylim=(-1.45 * reach, 1.05 * reach))


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
    for middle in (15.0, 165.0):
        speeds.text(middle, 0.065, r'$w < w_0$', ha='center', va='bottom')


def _damping(
    arm: PlanarArm, q: NDArray[np.float64], threshold: float, maximum: float
) -> NDArray[np.float64]:
    w = iv.manipulability(arm.jacobian(q))
    return np.asarray(iv.damping(w, threshold, maximum))


def _norm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(vectors, axis=-1))
