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

"""Pictures of arms and legs: damping and the null space (A), legs (C), ellipses and a spring (D)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.control import StraightLine
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.inverse_kinematics import pose_difference
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, FILL, GREEN, GREY, INK, RED
from diffdrive_jacobian.simulation import track_line
from diffdrive_jacobian.simulation.tracking import Tracking

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from diffdrive_jacobian.kinematics.inverse_velocity import Ellipsoid
    from diffdrive_jacobian.numerics.formula import Array

# --- Ellipses along a motion

SCALE = 0.1
"""Size of the ellipses (m for 1 m/s, and for 1 N)."""
SHOWN = 4
"""How many configurations of the motion are drawn."""


@picture
def arm_ellipses(
    lengths: ArrayLike = (1.0, 1.0), start: ArrayLike | None = None, end: ArrayLike | None = None
) -> Figure:
    """Draw an arm of two links whose tip moves along a line, with its ellipses, and its measures below.

    Args:
        lengths: Lengths of both links, shape (2,) (m).
        start: Where the tip starts, elbow up, shape (2,) (m). None: near the base.
        end: Where it ends, shape (2,) (m). None: where the arm is almost stretched.

    Raises:
        ValueError: The line is out of reach.
    """
    from matplotlib.figure import Figure

    arm = PlanarArm(lengths)
    reach, hole = float(np.sum(arm.lengths)), float(abs(arm.lengths[0] - arm.lengths[-1]))
    start = [max(0.25 * reach, hole + 0.05 * reach), 0.0] if start is None else start
    end = [0.93 * reach, 0.0] if end is None else end
    line = StraightLine(start, end, speed=0.1)
    q = track_line(arm, arm.inverse_kinematics(start)[1], line).q
    drawing = Figure(figsize=(5.4, 4.7), layout='constrained')
    above, below = drawing.subplots(2, 1, height_ratios=[1.6, 1.0])
    above.set(aspect='equal', xlabel='x [m]', ylabel='y [m]')
    velocities: Any = {'color': BLUE, 'lw': 1.8}
    forces: Any = {'color': RED, 'lw': 1.4, 'ls': DASHED}
    for share, index in enumerate(np.linspace(0, len(q) - 1, SHOWN).astype(int)):
        J, shade = arm.jacobian(q[index]), str(0.75 - 0.75 * share / (SHOWN - 1))
        joints = arm.joint_positions(q[index])
        above.plot(*joints.T, 'o-', color=shade, lw=2.2, ms=5.0, solid_capstyle='round')
        _draw_ellipse(above, joints[-1], iv.velocity_ellipsoid(J), **velocities)
        _draw_ellipse(above, joints[-1], iv.force_ellipsoid(J), **forces)
    for what, unit, style in (
        (r'velocities, $|\dot q| \leq 1$ rad/s', 'm/s', velocities),
        (r'forces, $|\tau| \leq 1$ N m', 'N', forces),
    ):
        above.plot([], [], label=f'{what} ({SCALE:g} m for 1 {unit})', **style)
    above.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0))
    above.set(ylim=(-0.35, None))
    above.grid(False)
    sketch.line(above, start, end, color=GREY, lw=0.8)
    # The measures of manipulability, over the distance that the tip has travelled.
    travelled = np.linspace(0.0, float(line.duration * line.speed), len(q))
    J = arm.jacobian(q)
    for values, style, text in (
        (iv.manipulability(J), '-', '$w$ [m²]'),
        (iv.smallest_singular_value(J), '--', '$s_2$ [m]'),
        (1.0 / iv.condition_number(J), ':', '$s_2/s_1$'),
    ):
        below.plot(travelled, values, style, color='black', lw=1.6)
        sketch.label(below, text, [travelled[-1], np.ravel(values)[-1]], (6.0, 0.0), ha='left')
    below.set(xlabel='distance travelled by the tip [m]', ylim=(0.0, None), xlim=travelled[[0, -1]])
    return drawing


def _draw_ellipse(axes: Axes, centre: Array, ellipsoid: Ellipsoid, **style: Any) -> None:
    U, semi_axes = ellipsoid
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    unit = np.stack([np.cos(turn), np.sin(turn)])
    x, y = centre[:, np.newaxis] + SCALE * U @ (semi_axes[:, np.newaxis] * unit)
    axes.plot(x, y, **style)


# --- Damping

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
    tip = arm.forward_kinematics(q)
    factor = iv.damping(iv.manipulability(arm.jacobian(q)), threshold, maximum)
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
    J, tip = arm.jacobian(q), arm.forward_kinematics(q)[:, :2]
    factor = iv.damping(iv.manipulability(J), threshold, maximum)
    x_dot = SPEED * tip / np.linalg.norm(tip, axis=-1, keepdims=True)
    exact = np.linalg.norm(iv.damped_least_squares(J, x_dot, 0.0), axis=-1)
    damped = iv.damped_least_squares(J, x_dot, factor)
    missing = np.linalg.norm(x_dot - (J @ damped[..., np.newaxis])[..., 0], axis=-1)
    degrees = np.degrees(bend)
    with np.errstate(divide='ignore'):
        bound = SPEED / (2.0 * factor)
    for values, color, line, text in (
        (exact, RED, DASHED, 'exact inverse'),
        (np.linalg.norm(damped, axis=-1), BLUE, '-', 'damped'),
        (bound, GREY, ':', r'$|\dot x| / 2\lambda$'),
    ):
        speeds.semilogy(degrees, values, color=color, ls=line, lw=1.8, label=text)
    speeds.set(ylim=(0.05, 50.0), yticks=[0.1, 1.0, 10.0], ylabel=r'$|\dot q|$ [rad/s]')
    speeds.set_title(f'desired: {SPEED:g} m/s away from the base')
    speeds.legend(loc='upper center')
    speeds.tick_params(labelbottom=False)
    errors.plot(degrees, 100.0 * missing / SPEED, color=BLUE, lw=1.8)
    errors.set(xlabel='$q_2$ [degrees]', ylabel='not done [%]', xlim=(0.0, 180.0), ylim=(0.0, 105.0))
    errors.set_xticks(range(0, 181, 30))
    for axes in (speeds, errors):
        axes.fill_between(
            degrees, 0, 1, where=factor > 0.0, color='#e8e8e8', transform=axes.get_xaxis_transform()
        )
    errors.text(90.0, 55.0, 'no damping:\n$w \\geq w_0$', ha='center', va='center')
    for middle in (15.0, 165.0):
        speeds.text(middle, 0.065, r'$w < w_0$', ha='center', va='bottom')


# --- The null space

ARM = PlanarArm([0.5, 0.4, 0.3])
START = (0.9, -1.5, 1.0)
"""Joint angles at which both motions start (rad)."""
END = (0.25, 0.45)
"""Where the tip is led, along a straight line (m)."""
OBSTACLE = (0.1, 0.5)
PUSH = 4.0
"""Gain k of the secondary task `k * clearance_gradient` (rad^2/(m s))."""
STEP = 0.01


@picture
def null_space() -> Figure:
    """Draw the null-space motion of three links: with the tip at rest, and around an obstacle."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(8.6, 3.3), layout='constrained')
    at_rest, around, clearance = drawing.subplots(1, 3, width_ratios=[1.0, 1.15, 0.9])
    _draw_at_rest(at_rest)
    without, avoiding = tracked(avoid=False), tracked(avoid=True)
    _draw_around(around, without, avoiding)
    for run, color, style, label in (
        (without, GREY, DASHED, r'$J^+ \dot x$'),
        (avoiding, BLUE, '-', r'$J^+ \dot x + N k \nabla c$'),
    ):
        distance = ARM.clearance(run.q, OBSTACLE)
        clearance.plot(run.times, distance, color=color, ls=style, label=label)
    clearance.set(title='clearance $c$', xlabel='time [s]', ylabel='$c$ [m]')
    clearance.set(xticks=[0.0, 2.0, 4.0, 6.0], ylim=(0.0, 0.55))
    clearance.legend(loc='upper center')
    return drawing


def tracked(*, avoid: bool) -> Tracking:
    """Lead the tip along the line by the least joint velocities, or also away from the obstacle."""
    line = StraightLine(ARM.forward_kinematics(START)[:2], END, speed=0.1)

    def away(q: NDArray[np.float64]) -> NDArray[np.float64]:
        return PUSH * ARM.clearance_gradient(q, OBSTACLE)

    return track_line(ARM, START, line, secondary=away if avoid else None)


def self_motion(steps: int = 800) -> NDArray[np.float64]:
    """Return configurations with the same tip, shape (steps + 1, 3), along the null space of J."""
    q, tip = np.array(START), ARM.forward_kinematics(START)[:2]
    track, direction = [q], np.array([-1.0, 1.0, 0.0])
    for _ in range(steps):
        J, error = ARM.jacobian(q), tip - ARM.forward_kinematics(q)[:2]
        direction = iv.null_space_projector(J) @ direction
        direction = direction / np.linalg.norm(direction)
        q = q + iv.redundant(J, error, STEP * direction)
        track.append(q)
    return np.array(track)


def _draw_at_rest(axes: Axes) -> None:
    shown = self_motion()[::200]
    for shade, q in zip(np.linspace(0.75, 0.0, len(shown)), shown, strict=True):
        _draw_redundant(axes, q, color=str(shade))
    sketch.point(axes, ARM.forward_kinematics(START)[:2], 'tip', (14.0, -6.0), color=RED)
    first, last = ARM.joint_positions(shown[[0, -1]])
    sketch.label(axes, 'first', first[1], (0.0, 11.0), fontsize=9.5)
    sketch.label(axes, 'last', last[2], (0.0, 11.0), fontsize=9.5)
    axes.set(title=r'tip at rest: $\dot q = N \dot q_0$', xlabel='x [m]', ylabel='y [m]')
    axes.set_aspect('equal', adjustable='datalim')


def _draw_around(axes: Axes, without: Tracking, avoiding: Tracking) -> None:
    tip = ARM.forward_kinematics(START)[:2]
    sketch.line(axes, tip, END, color=RED, lw=1.4, label='line of the tip')
    nearest = int(np.argmin(ARM.clearance(without.q, OBSTACLE)))
    _draw_redundant(axes, START, color='0.75', lw=4.0, label='start')
    _draw_redundant(axes, without.q[nearest], color=GREY, ls=':', label='without, nearest')
    _draw_redundant(axes, without.q[-1], color=GREY, ls=DASHED, label='without, end')
    _draw_redundant(axes, avoiding.q[-1], color=BLUE, label='away from it, end')
    axes.plot(*OBSTACLE, 'X', color=INK, ms=8.0, zorder=5, label='obstacle', ls='none')
    axes.set(title='past an obstacle', xlabel='x [m]', ylabel='y [m]', aspect='equal')
    axes.set(xlim=(-0.35, 1.0), ylim=(-0.08, 1.5), xticks=[0.0, 0.5, 1.0], yticks=[0.0, 0.5])
    axes.legend(loc='upper center', fontsize=8.0, labelspacing=0.3)


def _draw_redundant(axes: Axes, q: ArrayLike, **style: Any) -> None:
    style = {'lw': 2.2, 'marker': 'o', 'ms': 4.0, 'solid_capstyle': 'round', **style}
    sketch.line(axes, *ARM.joint_positions(q), **style)


# --- The spring

Q = (0.35, 0.95, -0.75)
"""Joint angles (rad)."""
TARGET = np.array([2.05, 0.75, -0.45])
"""Desired pose of the end effector."""
TURNS = 7
"""Turns of the spring."""


@picture
def spring(gamma: float = 1.0, step: float = 0.05) -> Figure:
    """Draw an arm, its desired pose, the spring between both, its wrench, and the torques `Q = J^T W`.

    The dashed arm is the one after the step `q + step Q`.

    Args:
        gamma: Stiffness of the spring, of the pull (N/m) and of the twist (N m/rad).
        step: 1/B of the friction B times the time of a step (rad/(N m)).
    """
    arm, q = PlanarArm([1.0, 0.9, 0.4]), np.array(Q)
    pose, joints = arm.forward_kinematics(q), arm.joint_positions(q)
    W = gamma * pose_difference(TARGET, pose)
    torques = arm.joint_torques(q, W)
    drawing, axes = sketch.canvas(7.2, (-0.45, 2.75), (-0.3, 1.75))
    after = arm.joint_positions(q + step * torques)
    _draw_arm(axes, after, color=GREY, lw=1.4, ls=DASHED)
    # Its tip is on the spring.
    axes.plot(*after[-1], 's', color=GREY, mec='white', ms=9.0, zorder=4)
    sketch.label(axes, r'$q + \delta_q$', (after[1] + after[2]) / 2.0, (28.0, -4.0))
    _draw_arm(axes, joints, color=INK, lw=3.0)
    turns = np.copysign(0.3 + 0.7 * np.abs(torques) / np.abs(torques).max(), torques)
    for joint, (at, half) in enumerate(zip(joints, turns, strict=False), 1):
        _draw_turn(axes, at, 0.2, half, 2.45, f'$Q_{joint}$', BLUE)
    # The wrench: beside the spring the pull, and the twist.
    aside = 0.13 * np.array([-W[1], W[0]]) / np.hypot(*W[:2])
    sketch.arrow(axes, pose[:2] + aside, 0.6 * W[:2], r'$\gamma t$', (14.0, 4.0), color=RED, lw=2.4)
    _draw_turn(axes, pose[:2], 0.36, np.copysign(0.45, W[2]), 0.15, r'$\gamma \theta$', RED)
    _draw_spring(axes, pose[:2], TARGET[:2])
    for there, name, offset in ((pose, '$E$', (2.0, 24.0)), (TARGET, '$E^*$', (-2.0, -16.0))):
        sketch.frame(axes, there, 0.24, '', '', lw=1.4)
        sketch.label(axes, name, there[:2], offset)
    return drawing


def _draw_arm(axes: Axes, joints: Array, color: str, **style: Any) -> None:
    axes.plot(*joints.T, solid_capstyle='round', color=color, **style)
    axes.plot(*joints[:-1].T, 'o', color='white', mec=color, ms=7.0, zorder=3)


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


# --- Legs

LEG = PlanarArm([0.4, 0.4])
"""Thigh and shank."""
HIPS = ((-0.25, 0.0), (0.25, 0.0))
"""The hips in the frame of the body (m)."""
BASE = (0.0, 0.0, 0.2)
"""Pose of the body, `[x, z, pitch]`, with the origin of the drawing below it (m, m, rad)."""
GROUND = -0.66
FEET = ((-0.28, GROUND), (0.22, GROUND))
"""Where the feet stand (m)."""


@picture
def legs() -> Figure:
    """Draw a body on two legs from its right side: `q = [x, z, pitch, hip, knee, hip, knee]`."""
    drawing, axes = sketch.canvas(6.9, (-1.0, 1.08), (-0.8, 0.32))
    sketch.line(axes, [-0.95, GROUND], [0.9, GROUND], lw=1.6)
    sketch.frame(axes, [-0.88, GROUND, 0.0], 0.2, '', '$z$')
    sketch.label(axes, '$x$', [-0.68, GROUND], (0.0, -10.0))
    theta = BASE[2]
    body = [[-0.3, -0.06], [0.36, -0.06], [0.42, 0.0], [0.36, 0.06], [-0.3, 0.06]]
    sketch.outline(axes, sketch.placed(body, BASE), fc=FILL, ec=GREY)
    for end in (sketch.placed([0.8, 0.0], BASE), [BASE[0] + 0.8, BASE[1]]):
        sketch.line(axes, BASE[:2], end, color=GREY, lw=0.9, ls=DASHED)
    sketch.angle(axes, BASE[:2], 0.72, 0.0, theta, '', color=RED)
    sketch.label(axes, 'pitch > 0', [0.72, 0.0], (36.0, 14.0), color=RED)
    sketch.point(axes, BASE[:2], '$(x, z)$', (-4.0, 22.0))
    for number, (hip, foot) in enumerate(zip(HIPS, FEET, strict=True), 1):
        at = sketch.placed(hip, BASE)
        # The thigh is measured from the horizontal, the knee is bent upward.
        x, z = foot - at
        q_knee = 2.0 * np.arccos(np.hypot(x, z) / (2.0 * LEG.lengths[0]))
        q_hip = np.arctan2(z, x) - q_knee / 2.0
        hip_joint, knee_joint, end = at + LEG.joint_positions([q_hip, q_knee])
        sketch.line(axes, hip_joint, knee_joint, end, lw=4.0, color='#555555', zorder=2)
        # A hip is measured from the body, a knee from the thigh that goes on.
        thigh = knee_joint - hip_joint
        sketch.line(axes, knee_joint, knee_joint + 0.6 * thigh, color=GREY, lw=0.9, ls=DASHED)
        sketch.angle(axes, hip_joint, 0.13, theta, q_hip, '', color=BLUE)
        sketch.label(axes, f'hip$_{number}$ < 0', at, (34.0, -38.0), color=BLUE)
        sketch.angle(axes, knee_joint, 0.18, q_hip, q_hip + q_knee, '', color=GREEN)
        sketch.label(axes, f'knee$_{number}$ > 0', knee_joint, (-46.0, -12.0), color=GREEN)
        for joint in (hip_joint, knee_joint):
            sketch.point(axes, joint)
        sketch.point(axes, end, f'$F_{number}$', (0.0, -12.0))
    return drawing
