# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Pictures of a robot with two wheels: its symbols (B, E), its velocities (B), and a wheel (C).

In figures 1 to 4, as in document E, wheel 1 is the left one and wheel 2 the right one, `l` is the wheel
separation, and the vectors i, j, k are along x, y and z of the frame at hand.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics import contact, diff_drive, rigid_body
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, FILL, GREEN, GREY, INK, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

ORIGIN = (0.0, 0.0, 0.0)
OMEGA_1, OMEGA_2 = 8.0, 18.0
"""Speeds of the wheels in figures 1 to 4 (rad/s)."""
SECONDS = 0.2
"""Velocities in them are drawn as the distance travelled in this time (s)."""
PALE_BLUE = '#85BFE0'


@picture
def geometry(r: float = 0.033, L: float = 0.16, d: float = 0.1) -> Figure:
    """Draw the robot from above with its symbols, to scale (the top views of B, figure 1 of E).

    Args:
        r: Wheel radius (m).
        L: Wheel separation (m).
        d: Coordinate x of the offset point in the body frame (m).
    """
    x, y, theta = pose = np.array([1.25 * L, L, 0.6])
    C, p_d, (right, left) = pose[:2], diff_drive.offset_point(pose, d), diff_drive.wheel_centres(pose, L)
    e_f, e_l = np.array([np.cos(theta), np.sin(theta)]), np.array([np.sin(theta), -np.cos(theta)])
    drawing, axes = sketch.canvas(6.6, (-0.3 * L, 2.8 * L), (-0.2 * L, 2.25 * L))
    # The world, and the pose in it.
    sketch.frame(axes, ORIGIN, 0.44 * L, '$x_W$', '$y_W$')
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


@picture
def figure_1(r: float = 0.033, L: float = 0.16) -> Figure:
    """Draw the robot along the x axis: its wheels and their speeds, C, v and theta_dot (figure 1 of E).

    Wheel radius and separation `r`, `L` (m).
    """
    drawing, axes = sketch.canvas(6.0, (-1.0 * L, 1.65 * L), (-0.85 * L, 1.05 * L))
    C = ORIGIN[:2]
    sketch.robot(axes, ORIGIN, r, L)
    sketch.arrow(axes, C, [1.45 * L, 0.0], '$x$', (10.0, 0.0), lw=1.0)
    sketch.arrow(axes, C, [0.0, 0.85 * L], '$y$', (0.0, 10.0), lw=1.0)
    v_x, _ = diff_drive.wheel_to_body(OMEGA_2, OMEGA_1, r, L)
    sketch.arrow(axes, C, [SECONDS * float(v_x), 0.0], '$v_x$', (0.0, 13.0), color=BLUE, lw=2.6)
    sketch.angle(axes, C, 0.22 * L, 2.2, 4.1, r'$\dot\theta$', color=BLUE)
    sketch.point(axes, C, '$C$', (11.0, -12.0))
    C_2, C_1 = diff_drive.wheel_centres(ORIGIN, L)
    for C_i, omega_i, i in ((C_1, OMEGA_1, 1), (C_2, OMEGA_2, 2)):
        rim = [SECONDS * r * omega_i, 0.0]
        sketch.arrow(axes, C_i, rim, rf'$r\,\omega_{i}$', (17.0, 0.0), color=GREEN, lw=2.0)
        sketch.point(axes, C_i, f'$C_{i}$', (-13.0, 0.0))
    sketch.dimension(axes, C_1, C_2, -0.55 * L, '$l$')
    sketch.dimension(axes, [-r, -L / 2.0], [r, -L / 2.0], -0.15 * L, '$2r$')
    return drawing


@picture
def figure_2(r: float = 0.033, L: float = 0.16) -> Figure:
    """Draw the frames: C half way between C_1 and C_2, with e_f, e_l and v_C (figure 2 of E).

    Wheel radius and separation `r`, `L` (m).
    """
    pose = np.array([1.35 * L, 1.1 * L, 0.55])
    C, theta, (C_2, C_1) = pose[:2], pose[2], diff_drive.wheel_centres(pose, L)
    e_f = diff_drive.unicycle_jacobian(theta)[:2, 0]
    e_l = diff_drive.no_lateral_slip_constraint(theta)[0, :2]
    drawing, axes = sketch.canvas(6.4, (-0.35 * L, 3.1 * L), (-0.3 * L, 2.3 * L))
    sketch.frame(axes, ORIGIN, 0.45 * L, '$X$', '$Y$')
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
    """Draw a wheel of radius r (m) from its right side: its contact P has no velocity (figure 3 of E).

    The arrows are the velocities of the points above P: `v_P + phi_dot j × (height k)`.
    """
    from matplotlib.patches import Circle

    drawing, axes = sketch.canvas(5.6, (-2.2 * r, 3.0 * r), (-0.7 * r, 2.7 * r))
    P, C = ORIGIN[:2], (0.0, r)
    axes.add_patch(Circle(C, r, fc=FILL, ec=INK, lw=1.6))
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

    Wheel radius and separation `r`, `L` (m).
    """
    drawing, axes = sketch.canvas(6.4, (-0.75 * L, 1.4 * L), (-0.7 * L, 0.85 * L))
    O, (C_2, C_1) = ORIGIN[:2], diff_drive.wheel_centres(ORIGIN, L)  # noqa: E741 - the document's O
    sketch.wheels(axes, ORIGIN, r, L)
    # The tips of the velocities along the axle are on a line, for it is rigid.
    omega = [0.0, 0.0, (r * OMEGA_2 - r * OMEGA_1) / L]
    along = np.column_stack([np.linspace(0.0, 1.0, 9)[:, np.newaxis] * (C_2 - C_1), np.zeros(9)])
    velocities = SECONDS * rigid_body.point_velocity([r * OMEGA_1, 0.0, 0.0], omega, along)[:, :2]
    for down, velocity in zip(along, velocities, strict=True):
        sketch.arrow(axes, C_1 + down[:2], velocity, color=BLUE, lw=0.8)
    sketch.line(axes, C_1 + velocities[0], C_2 + velocities[-1], color=BLUE, lw=0.8, ls=DASHED)
    for point, velocity, i, text in (
        (C_1, velocities[0], '_1', r'$v_{C_1} = r\,\dot\phi_1\,i$'),
        (O, velocities[4], '', '$v_O = (v_{C_1} + v_{C_2})/2$'),
        (C_2, velocities[-1], '_2', r'$v_{C_2} = r\,\dot\phi_2\,i = v_{C_1} + l\,\dot\theta\,i$'),
    ):
        sketch.arrow(axes, point, velocity, color=BLUE, lw=2.6)
        sketch.label(axes, text, point + velocity, (8.0, 0.0), color=BLUE, ha='left')
        if i:
            sketch.arrow(axes, point, [0.24 * L, 0.0], '$i$', (-3.0, 11.0), lw=2.0)
            sketch.arrow(axes, point, [0.0, 0.24 * L], '$j$', (-10.0, -3.0), lw=2.0)
            sketch.point(axes, point, f'$C{i}$', (-13.0, 0.0))
    sketch.point(axes, O, '$O$', (-11.0, 0.0))
    sketch.angle(axes, O, 0.3 * L, 2.6, 3.7, r'$\dot\theta\,k$', color=BLUE)
    sketch.dimension(axes, C_1, C_2, -0.6 * L, '$l$')
    return drawing


CIRCLE = np.array(
    [np.cos(np.linspace(0.0, 2.0 * np.pi, 121)), np.sin(np.linspace(0.0, 2.0 * np.pi, 121))]
)
"""Wheel speeds of norm 1, as columns `[omega_R, omega_L]`."""


@picture
def velocity_ellipses(r: float = 0.033, L: float = 0.16) -> Figure:
    """Draw which velocities of four points follow from wheel speeds of norm 1 (B).

    At the axle they are on a line: both columns of the Jacobian are parallel, and its rank is 1. At the
    distance d the ellipse has the semi-axes `r / sqrt(2)` along the heading and `sqrt(2) d r / L` to the
    side, which are equal at `d = L/2`. Wheel radius and separation `r`, `L` (m).
    """
    drawing, axes = sketch.canvas(8.0, (-1.7 * L, 1.25 * L), (-0.8 * L, 0.62 * L))
    circle, radius, below = np.array([-1.2 * L, 0.0]), 0.28 * L, -0.7 * L
    sketch.outline(axes, circle + radius * CIRCLE.T, lw=1.4)
    sketch.arrow(axes, circle, [radius, 0.0], r'$\omega_R$', (14.0, 0.0), color=BLUE)
    sketch.arrow(axes, circle, [0.0, radius], r'$\omega_L$', (0.0, 11.0), color=RED, ls='--')
    sketch.point(axes, circle)
    sketch.label(axes, 'wheel speeds of norm 1', [circle[0], below])
    sketch.robot(axes, ORIGIN, r, L)
    sketch.label(axes, 'velocities that they give to points at the distance $d$', [0.35 * L, below])
    # All ellipses are as long along the heading: 0.12 L from their centre.
    seconds = 0.12 * L / (r / np.sqrt(2.0))
    _draw_image(axes, ORIGIN[:2], seconds * diff_drive.wheel_to_position_jacobian(0.0, r, L))
    _draw_note(axes, [-0.19 * L, 0.0], '$d = 0$', 'a line:\nrank 1')
    for share, name, shape in ((0.25, 'L/4', ''), (0.5, 'L/2', 'a circle'), (1.0, 'L', '')):
        p_d = diff_drive.offset_point(ORIGIN, share * L)
        _draw_image(axes, p_d, seconds * diff_drive.offset_point_jacobian(0.0, r, L, share * L))
        _draw_note(axes, p_d, f'$d = {name}$', shape)
    return drawing


def _draw_image(axes: Axes, at: ArrayLike, J: NDArray[np.float64]) -> None:
    """Draw the image of the circle under a Jacobian at a point, and the columns of the Jacobian."""
    sketch.outline(axes, np.asarray(at) + (J @ CIRCLE).T, lw=1.4, zorder=3)
    for column, color, style in zip(J.T, (BLUE, RED), ('-', '--'), strict=True):
        sketch.arrow(axes, at, column, color=color, ls=style, lw=1.2, zorder=5)
    sketch.point(axes, at)


def _draw_note(axes: Axes, at: ArrayLike, distance: str, shape: str) -> None:
    """Write the distance of a point below its ellipse, and its shape above it."""
    sketch.label(axes, distance, at, (0.0, -60.0))
    sketch.label(axes, shape, at, (0.0, 44.0))


@picture
def wheel(r: float = 0.5) -> Figure:
    """Draw a wheel with a point P of its rim, phi = 0 on top: its position, and the columns of J_P.

    The velocity of a point is `x_dot` times the first column plus `phi_dot` times the second. The wheel
    rolls, `x_dot = r phi_dot`, so the two cancel at the ground.

    Args:
        r: Wheel radius (m).

    Raises:
        ValueError: r is not positive and finite.
    """
    from matplotlib.patches import Circle

    # The velocities at 1 rad/s, drawn as the distance travelled in 0.8 s.
    q_dot = 0.8 * contact.rolling_direction(r)
    x, C, phi_P = 2.0 * r, np.array([2.0 * r, r]), 0.9
    drawing, axes = sketch.canvas(6.9, (-0.45 * r, 5.1 * r), (-0.75 * r, 2.55 * r))
    axes.add_patch(Circle((x, r), r, fc=FILL, ec=INK, lw=1.6))
    sketch.line(axes, [-0.3 * r, 0.0], [4.4 * r, 0.0], lw=1.6)
    sketch.frame(axes, ORIGIN, 0.5 * r, '', 'up')
    sketch.point(axes, ORIGIN[:2], '$O$', (-9.0, -10.0))
    sketch.dimension(axes, ORIGIN[:2], [x, 0.0], -0.45 * r, '$x$')
    top = contact.wheel_contact_position(x, 0.0, r)[:2]
    sketch.line(axes, C, top, color=GREY, lw=0.9, ls=DASHED)
    sketch.point(axes, top, r'$\phi = 0$', (-8.0, 12.0))
    for phi, text, offset, by_x, by_phi in (
        (phi_P, '$P$', (-12.0, 0.0),
         (r'$\dot x\ [1, 0]$', (30.0, 0.0)),
         (r'$\dot\phi\ [r\,\cos\phi, -r\,\sin\phi]$', (70.0, -6.0))),
        (contact.AT_GROUND, r'$\phi = \pi$', (-20.0, 13.0),
         (r'$\dot x$', (6.0, -13.0)),
         (r'$-r\,\dot\phi$', (-4.0, -13.0))),
    ):  # fmt: skip
        P = contact.wheel_contact_position(x, phi, r)[:2]
        along, around = (contact.wheel_contact_jacobian(phi, r)[:2] * q_dot).T
        sketch.line(axes, C, P, color=GREY, lw=0.9)
        sketch.arrow(axes, P, along, *by_x, color=GREEN, lw=2.4)
        sketch.arrow(axes, P, around, *by_phi, color=BLUE, lw=2.4)
        sketch.point(axes, P, text, offset)
    sketch.label(axes, r'rolls: $v_P = 0$', [x + 1.6 * r, 0.0], (0.0, 13.0))
    sketch.angle(axes, C, 0.35 * r, np.pi / 2.0, np.pi / 2.0 - phi_P, r'$\phi$')
    sketch.dimension(axes, C, C - [r, 0.0], 0.0, '$r$')
    sketch.point(axes, C)
    return drawing
