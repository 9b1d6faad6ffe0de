"""Figures 1 to 4 of document E, drawn from the geometry that its text describes.

As in that document wheel 1 is the left one and wheel 2 the right one, `l` is the wheel separation, and
the vectors i, j, k are along x, y and z of the frame at hand.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics import diff_drive, rigid_body
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREEN, GREY, placed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OMEGA_1, OMEGA_2 = 8.0, 18.0
"""Speeds of the wheels in the figures (rad/s)."""
PALE_BLUE = '#85BFE0'
SECONDS = 0.2
"""Velocities are drawn as the way that is made in this time (s)."""


@picture
def figure_1(r: float = 0.033, L: float = 0.16) -> Figure:
    """Draw the robot along the x axis: its wheels and their speeds, C, v and theta_dot (figure 1 of E).

    Args:
        r: Wheel radius (m).
        L: Wheel separation (m).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    drawing, axes = sketch.canvas(6.0, (-1.0 * L, 1.65 * L), (-0.85 * L, 1.05 * L))
    sketch.robot(axes, [0.0, 0.0, 0.0], r, L)
    sketch.arrow(axes, [0.0, 0.0], [1.45 * L, 0.0], '$x$', (10.0, 0.0), lw=1.0)
    sketch.arrow(axes, [0.0, 0.0], [0.0, 0.85 * L], '$y$', (0.0, 10.0), lw=1.0)
    v_x, _ = diff_drive.wheel_to_body(OMEGA_2, OMEGA_1, r, L)
    sketch.arrow(axes, [0.0, 0.0], [SECONDS * v_x, 0.0], '$v_x$', (0.0, 13.0), color=BLUE, lw=2.6)
    sketch.angle(axes, [0.0, 0.0], 0.22 * L, 2.2, 4.1, r'$\dot\theta$', color=BLUE)
    sketch.point(axes, [0.0, 0.0], '$C$', (11.0, -12.0))
    C_2, C_1 = diff_drive.wheel_centres([0.0, 0.0, 0.0], L)
    for C_i, omega_i, i in ((C_1, OMEGA_1, 1), (C_2, OMEGA_2, 2)):
        rim = [SECONDS * r * omega_i, 0.0]
        sketch.arrow(axes, C_i, rim, rf'$r\,\omega_{i}$', (17.0, 0.0), color=GREEN, lw=2.0)
        sketch.point(axes, C_i, f'$C_{i}$', (-13.0, 0.0))
    sketch.dimension(axes, C_1, C_2, -0.55 * L, '$l$')
    back, front = placed([[-r, -L / 2.0], [r, -L / 2.0]], [0.0, 0.0, 0.0])
    sketch.dimension(axes, back, front, -0.15 * L, '$2r$')
    return drawing


@picture
def figure_2(r: float = 0.033, L: float = 0.16) -> Figure:
    """Draw the frames: C half way between C_1 and C_2, with e_f, e_l and v_C (figure 2 of E).

    Args:
        r: Wheel radius (m).
        L: Wheel separation (m).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    pose = np.array([1.35 * L, 1.1 * L, 0.55])
    C, theta, (C_2, C_1) = pose[:2], pose[2], diff_drive.wheel_centres(pose, L)
    e_f = diff_drive.unicycle_jacobian(theta)[:2, 0]
    e_l = diff_drive.no_lateral_slip_constraint(theta)[0, :2]
    drawing, axes = sketch.canvas(6.4, (-0.35 * L, 3.1 * L), (-0.3 * L, 2.3 * L))
    sketch.frame(axes, [0.0, 0.0, 0.0], 0.45 * L, '$X$', '$Y$')
    sketch.robot(axes, pose, r, L)
    for point, side in ((C_1, '_1'), (C, ''), (C_2, '_2')):
        sketch.line(axes, [point[0], 0.0], point, [0.0, point[1]], color=GREY, lw=0.8, ls=DASHED)
        sketch.label(axes, f'$x{side}$', [point[0], 0.0], (0.0, -9.0))
        sketch.label(axes, f'$y{side}$', [0.0, point[1]], (-10.0, 0.0))
    sketch.line(axes, C, [C[0] + 1.3 * L, C[1]], color=GREY, lw=0.8, ls=DASHED)
    sketch.angle(axes, C, 1.05 * L, 0.0, theta, r'$\theta$')
    q_dot = diff_drive.wheel_to_world_jacobian(theta, r, L) @ [OMEGA_2, OMEGA_1]
    sketch.arrow(axes, C, 1.6 * L * e_f, color=GREY, lw=0.8)
    # v_C is along e_f, so it is wide and pale, below it.
    v_C = SECONDS * q_dot[:2]
    sketch.arrow(axes, C, v_C, color=PALE_BLUE, lw=4.5, mutation_scale=17.0)
    sketch.label(axes, '$v_C$', C + v_C, (10.0, -12.0), color=BLUE)
    sketch.arrow(axes, C, 0.32 * L * e_f, '$e_f$', (-8.0, 13.0), lw=1.6)
    sketch.arrow(axes, C, 0.32 * L * e_l, '$e_l$', (12.0, 2.0), lw=1.6)
    sketch.point(axes, C_1, '$C_1$', (-8.0, 18.0))
    sketch.point(axes, C_2, '$C_2$', (14.0, -16.0))
    sketch.point(axes, C, '$C$', (-11.0, -9.0))
    return drawing


@picture
def figure_3(r: float = 0.033) -> Figure:
    """Draw a wheel from its right side: it rolls, so its contact P has no velocity (figure 3 of E).

    The arrows are the velocities of the points above P: `v_P + phi_dot j × (height k)`.

    Args:
        r: Wheel radius (m).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.patches import Circle

    drawing, axes = sketch.canvas(5.6, (-2.2 * r, 3.0 * r), (-0.7 * r, 2.7 * r))
    P, C = np.array([0.0, 0.0]), np.array([0.0, r])
    axes.add_patch(Circle((0.0, r), r, fc=sketch.FILL, ec=sketch.INK, lw=1.6))
    sketch.line(axes, [-1.5 * r, 0.0], [2.3 * r, 0.0], lw=1.6)
    sketch.label(axes, 'ground', [1.9 * r, 0.0], (0.0, -10.0))
    # Seen along j, which points into the page: i to the right, k up.
    sketch.frame(axes, [-2.0 * r, 1.7 * r, 0.0], 0.5 * r, '$i$', '$k$')
    sketch.point(axes, [-2.0 * r, 1.7 * r], r'$j \otimes$', (6.0, -12.0))
    sketch.line(axes, P, [0.0, 2.0 * r], color=GREY, lw=0.8, ls=DASHED)
    heights = np.linspace(0.0, 2.0 * r, 9)
    above = np.column_stack([np.zeros(9), np.zeros(9), heights])
    speeds = rigid_body.point_velocity([0.0, 0.0, 0.0], [0.0, 1.0, 0.0], above)[:, 0]
    sketch.line(axes, P, [speeds[-1], heights[-1]], color=BLUE, lw=0.8, ls=DASHED)
    for height, speed in zip(heights[1:], speeds[1:], strict=True):
        sketch.arrow(axes, [0.0, height], [speed, 0.0], color=BLUE, lw=1.0)
    sketch.arrow(axes, C, [r, 0.0], r'$v_C = r\,\dot\phi\,i$', (42.0, 0.0), color=BLUE, lw=2.6)
    sketch.label(axes, r'$2r\,\dot\phi\,i$', [2.0 * r, 2.0 * r], (22.0, 0.0), color=BLUE)
    sketch.angle(axes, C, 1.15 * r, 2.6, 1.8, r'$\dot\phi$')
    sketch.dimension(axes, P, C, 1.35 * r, '$r$')
    sketch.point(axes, C, '$C$', (-11.0, 8.0))
    sketch.point(axes, P, '$P$: $v_P = 0$', (0.0, -13.0))
    return drawing


@picture
def figure_4(r: float = 0.033, L: float = 0.16) -> Figure:
    """Draw the frames of both wheels and the velocities along the axle (figure 4 of E).

    Args:
        r: Wheel radius (m).
        L: Wheel separation (m).

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    drawing, axes = sketch.canvas(6.4, (-0.75 * L, 1.4 * L), (-0.7 * L, 0.85 * L))
    C_2, C_1 = diff_drive.wheel_centres([0.0, 0.0, 0.0], L)
    sketch.wheels(axes, [0.0, 0.0, 0.0], r, L)
    # The tips of the velocities along the axle are on a line, for it is rigid.
    omega = [0.0, 0.0, (r * OMEGA_2 - r * OMEGA_1) / L]
    ways = []
    for share in np.linspace(0.0, 1.0, 9):
        down = share * (C_2 - C_1)
        v = rigid_body.point_velocity([r * OMEGA_1, 0.0, 0.0], omega, [*down, 0.0])
        ways.append(SECONDS * v[:2])
        sketch.arrow(axes, C_1 + down, ways[-1], color=BLUE, lw=0.8)
    sketch.line(axes, C_1 + ways[0], C_2 + ways[-1], color=BLUE, lw=0.8, ls=DASHED)
    for point, way, i, text in (
        (C_1, ways[0], '_1', r'$v_{C_1} = r\,\dot\phi_1\,i$'),
        ([0.0, 0.0], ways[4], '', '$v_O = (v_{C_1} + v_{C_2})/2$'),
        (C_2, ways[-1], '_2', r'$v_{C_2} = r\,\dot\phi_2\,i = v_{C_1} + l\,\dot\theta\,i$'),
    ):
        sketch.arrow(axes, point, way, color=BLUE, lw=2.6)
        sketch.label(axes, text, point + way, (8.0, 0.0), color=BLUE, ha='left')
        if i:
            sketch.arrow(axes, point, [0.24 * L, 0.0], '$i$', (-3.0, 11.0), lw=2.0)
            sketch.arrow(axes, point, [0.0, 0.24 * L], '$j$', (-10.0, -3.0), lw=2.0)
            sketch.point(axes, point, f'$C{i}$', (-13.0, 0.0))
    sketch.point(axes, [0.0, 0.0], '$O$', (-11.0, 0.0))
    sketch.angle(axes, [0.0, 0.0], 0.3 * L, 2.6, 3.7, r'$\dot\theta\,k$', color=BLUE)
    sketch.dimension(axes, C_1, C_2, -0.6 * L, '$l$')
    return drawing
