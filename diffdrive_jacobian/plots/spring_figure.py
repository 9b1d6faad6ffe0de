"""The spring of document D: it pulls and twists the end effector towards its desired pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics.inverse_kinematics import pose_difference
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREY, INK, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from diffdrive_jacobian.numerics.formula import Array

LENGTHS = (1.0, 0.9, 0.4)
Q = (0.35, 0.95, -0.75)
"""Joint angles (rad)."""
TARGET = (2.05, 0.75, -0.45)
"""Desired pose of the end effector."""
GAMMA, STEP = 1.0, 0.05
"""Stiffness of the spring (N/m, N m/rad), and 1 / B times the time of a step (rad/(N m))."""
TURNS = 7
"""Turns of the spring."""


@picture
def spring(gamma: float = GAMMA, step: float = STEP) -> Figure:
    """Draw an arm, its desired pose, the spring between both, its wrench, and the torques `Q = J^T W`.

    The dashed arm is the one after the step `q + step Q`.

    Args:
        gamma: Stiffness of the spring, of the pull (N/m) and of the twist (N m/rad).
        step: 1/B of the friction B times the time of a step (rad/(N m)).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    arm, q = PlanarArm(LENGTHS), np.array(Q)
    pose = arm.forward_kinematics(q)
    W = gamma * pose_difference(TARGET, pose)
    torques = arm.joint_torques(q, W)
    drawing, axes = sketch.canvas(7.2, (-0.45, 2.75), (-0.3, 1.75))
    after = arm.joint_positions(q + step * torques)
    _draw_arm(axes, after, color=GREY, lw=1.4, ls=DASHED)
    # Its tip is on the spring.
    axes.plot(*after[-1], 's', color=GREY, mec='white', ms=9.0, zorder=4)
    sketch.label(axes, r'$q + \delta_q$', (after[1] + after[2]) / 2.0, (28.0, -4.0))
    _draw_arm(axes, arm.joint_positions(q), color=INK, lw=3.0)
    turns = 0.3 + 0.7 * np.abs(torques) / np.abs(torques).max()
    for joint, (at, half) in enumerate(
        zip(arm.joint_positions(q), np.copysign(turns, torques), strict=False), 1
    ):
        _draw_turn(axes, at, 0.2, half, 2.45, f'$Q_{joint}$', BLUE)
    # The wrench: beside the spring the pull, and the twist.
    aside = 0.13 * np.array([-W[1], W[0]]) / np.hypot(*W[:2])
    sketch.arrow(axes, pose[:2] + aside, 0.6 * W[:2], r'$\gamma t$', (14.0, 4.0), color=RED, lw=2.4)
    _draw_turn(axes, pose[:2], 0.36, np.copysign(0.45, W[2]), 0.15, r'$\gamma \theta$', RED)
    _draw_spring(axes, pose[:2], np.array(TARGET[:2]))
    for there, name, offset in ((pose, '$E$', (2.0, 24.0)), (np.array(TARGET), '$E^*$', (-2.0, -16.0))):
        sketch.frame(axes, there, 0.24, '', '', lw=1.4)
        sketch.label(axes, name, there[:2], offset)
    return drawing


def _draw_arm(axes: Axes, joints: Array, **style: object) -> None:
    axes.plot(*joints.T, solid_capstyle='round', **style)  # type: ignore[arg-type]
    axes.plot(*joints[:-1].T, 'o', color='white', mec=style['color'], ms=7.0, zorder=3)


def _draw_turn(
    axes: Axes, centre: Array, radius: float, half: float, where: float, text: str, color: str
) -> None:
    """Draw a moment as an arc around the direction `where`, to both sides by half (rad)."""
    sketch.angle(axes, centre, radius, where - half, where + half, text, color=color, lw=1.8)


def _draw_spring(axes: Axes, start: Array, end: Array) -> None:
    """Draw a spring, straight at both ends."""
    along = end - start
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    share = np.linspace(0.15, 0.85, 40 * TURNS)
    wave = 0.05 * np.sin(2.0 * np.pi * TURNS * (share - 0.15) / 0.7)
    coil = start + share[:, np.newaxis] * along + wave[:, np.newaxis] * across
    sketch.line(axes, start, *coil, end, color=RED, lw=1.2)
