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

"""Pictures of any arm at one configuration (D), and of one in space whose elbow moves (A)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.control import resolved_rate
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.kinematics.spatial import pose_vector, pose_vector_difference
from diffdrive_jacobian.kinematics.spatial_arm import IIWA, SpatialArm
from diffdrive_jacobian.numerics.checks import array
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREY, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from diffdrive_jacobian.kinematics.inverse_velocity import Ellipsoid
    from diffdrive_jacobian.numerics.formula import Array

SHARE = 0.25
"""Largest semi-axis that is drawn, as a part of the reach of the arm."""
VIEW = {'elev': 22.0, 'azim': -58.0}
SIDE = {'elev': 18.0, 'azim': -25.0}

# --- One configuration

SMALLEST, LARGEST = 1e-6, 1e6
"""Sizes of arms that can be drawn (m)."""


@picture
def arm_at(arm: PlanarArm | SpatialArm | None = None, q: ArrayLike | None = None) -> Figure:
    """Draw an arm at one configuration with the ellipses of its velocities and forces.

    Those of an arm in space are of the position, and as large as the picture allows.

    Args:
        arm: The arm. None: two links.
        q: Its joints, shape (n,) (rad, or m where a joint slides). None: 0.5 each.

    Raises:
        ValueError: q has another shape, or the arm is too small or too large to be drawn.
    """
    from matplotlib.figure import Figure

    arm = PlanarArm([1.0, 0.7]) if arm is None else arm
    q = array('q', np.full(arm.joints, 0.5) if q is None else q, arm.joints)
    if q.ndim != 1:
        raise ValueError(f'q must have shape ({arm.joints},), got {q.shape}')
    joints, in_space = arm.joint_positions(q), isinstance(arm, SpatialArm)
    J = arm.jacobian(q)[:3] if in_space else arm.jacobian(q)
    drawing = Figure(figsize=(5.4, 4.6), layout='constrained')
    axes: Any = drawing.add_subplot(projection='3d' if in_space else None)
    axes.plot(*joints.T, 'o-', color='0.35', lw=2.6, ms=5.0, solid_capstyle='round')
    if not SMALLEST <= (size := float(np.max(np.abs(joints)))) <= LARGEST:
        raise ValueError(
            f'the size of an arm to draw must be {SMALLEST:g} to {LARGEST:g} m, got {size:g}'
        )
    reach = float(np.sum(np.linalg.norm(np.diff(joints, axis=0), axis=-1)))
    for ellipsoid, name, unit, style in (
        (iv.velocity_ellipsoid(J), r'velocities, $|\dot q| \leq 1$', 'm/s', {'color': BLUE, 'ls': '-'}),
        (iv.force_ellipsoid(J), r'forces, $|\tau| \leq 1$', 'N', {'color': RED, 'ls': DASHED}),
    ):
        finite = ellipsoid.semi_axes[np.isfinite(ellipsoid.semi_axes)]
        largest = float(np.max(finite, initial=0.0))
        scale = SHARE * reach / largest if largest > 0.0 else 1.0
        _draw_ellipsoid(axes, joints[-1], ellipsoid, scale, SHARE * reach, style)
        cut = '' if len(finite) == len(ellipsoid.semi_axes) else '; infinite, cut off'
        axes.plot([], [], label=f'{name} ({scale:.2g} m for 1 {unit}{cut})', lw=1.6, **style)
    axes.set(xlabel='x [m]', ylabel='y [m]')
    axes.set_aspect('equal', adjustable='datalim')
    if in_space:
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.labelpad = 8.0
        axes.set_zlabel('z [m]')
        axes.locator_params(nbins=3)
        axes.view_init(**VIEW)
    drawing.legend(loc='outside upper center', ncols=1)
    w, s = iv.manipulability(J), iv.smallest_singular_value(J)
    axes.set_title(f'w = {w:.3g}, smallest singular value {s:.3g} m', fontsize=9.5)
    return drawing


def _draw_ellipsoid(
    axes: Axes, centre: Array, ellipsoid: Ellipsoid, scale: float, far: float, style: dict[str, Any]
) -> None:
    """Draw an ellipse, or the three of an ellipsoid; an infinite one as two lines that end far away."""
    U, semi_axes = ellipsoid
    turn = np.linspace(0.0, 2.0 * np.pi, 100)
    ring = np.stack([np.cos(turn), np.sin(turn)])
    # On both sides of the axis that is infinite, the second one.
    lines = np.array([[1.0, 1.0, np.nan, -1.0, -1.0], [-1.0, 1.0, np.nan, 1.0, -1.0]])
    for first in range(len(semi_axes)):
        for second in range(first):
            pair = [first, second]
            endless = np.isinf(semi_axes[pair])
            if endless.all():
                continue
            half = np.where(endless, far, scale * semi_axes[pair])
            curve = lines if endless[1] else lines[::-1] if endless[0] else ring
            curve = centre[:, np.newaxis] + U[:, pair] @ (half[:, np.newaxis] * curve)
            axes.plot(*curve, lw=1.6 if len(semi_axes) == 2 else 1.0, **style)


# --- Seven joints

START = np.radians([0.0, 25.0, 0.0, -100.0, 0.0, 55.0, 0.0])
"""Joints at which the hand rests, and from which it moves outwards (rad)."""
PERIOD = 0.005
MARGIN = 1e-4
"""How far the arm is from being stretched at the end (m)."""
SPEED = 0.1
"""Speed of the hand on its way to the stretched arm (m/s)."""
THRESHOLD, MAXIMUM = 0.05, 0.1
"""Manipulability below which there is damping, and the damping of a singular Jacobian."""


def self_motion(steps: int = 400) -> Array:
    """Return configurations of the iiwa with the same pose of the hand, shape (steps + 1, 7)."""
    q, target = START, pose_vector(IIWA.forward_kinematics(START))
    track = [q]
    for _ in range(steps):
        J = IIWA.jacobian(q)
        e = pose_vector_difference(target, pose_vector(IIWA.forward_kinematics(q)))
        turn = iv.null_space_projector(J)[:, 2]
        q_dot = resolved_rate(
            *(J, np.zeros(6), e, np.zeros(6)), gain=20.0, q_dot_0=turn / np.linalg.norm(turn)
        )
        q = IIWA.integrate(q, q_dot, PERIOD)
        track.append(q)
    return np.array(track)


def outwards(*, damped: bool) -> tuple[Array, Array, Array, Array]:
    """Move the hand of the iiwa outwards until the arm is almost stretched, its orientation kept.

    Returns:
        Times (s), joints, joint velocities (rad/s), and distances of the hand from where it should be
        (m).
    """
    q, start = START, pose_vector(IIWA.forward_kinematics(START))
    positions = IIWA.joint_positions(START)
    shoulder, wrist = positions[1], positions[5]
    # As far as the wrist can go along x, or almost.
    reach = float(IIWA.d[2] + IIWA.d[4])
    height = wrist[2] - shoulder[2]
    way = float(np.sqrt(reach**2 - height**2) - (wrist[0] - shoulder[0])) - MARGIN
    nu = np.array([SPEED, 0.0, 0.0, 0.0, 0.0, 0.0])
    track, velocities, errors = [q], [], []
    steps = int(way / SPEED / PERIOD)
    for step in range(steps):
        J, desired = IIWA.jacobian(q), start + nu * step * PERIOD
        e = pose_vector_difference(desired, pose_vector(IIWA.forward_kinematics(q)))
        factor = iv.damping(iv.manipulability(J), THRESHOLD, MAXIMUM) if damped else 0.0
        q_dot = resolved_rate(J, np.zeros(6), e, nu, gain=20.0, damping=factor)
        q = IIWA.integrate(q, q_dot, PERIOD)
        track.append(q)
        velocities.append(q_dot)
        errors.append(np.linalg.norm(e[:3]))
    times = PERIOD * np.arange(steps, dtype=np.float64)
    return times, np.array(track[:-1]), np.array(velocities), np.array(errors, dtype=np.float64)


@picture
def elbow() -> Figure:
    """Draw an arm of seven joints: its elbow moves while the hand stays; and it is almost stretched."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(8.6, 4.2), layout='constrained')
    grid = drawing.add_gridspec(2, 2, width_ratios=[1.25, 1.0])
    rest: Any = drawing.add_subplot(grid[:, 0], projection='3d')
    shown = self_motion()[::100]
    for shade, q in zip(np.linspace(0.78, 0.0, len(shown)), shown, strict=True):
        rest.plot(*IIWA.joint_positions(q).T, 'o-', color=str(shade), lw=2.2, ms=4.0)
    hand = IIWA.joint_positions(START)[-1]
    rest.plot(*hand[:, np.newaxis], 's', color=RED, ms=8.0, label='hand')
    rest.plot(*IIWA.joint_positions(shown)[:, 3].T, color=BLUE, lw=1.4, ls=DASHED, label='elbow')
    rest.set(
        title=r'hand at rest: $\dot q = N \dot q_0$', xlabel='x [m]', ylabel='y [m]', zlabel='z [m]'
    )
    rest.set(xlim=(-0.05, 0.5), ylim=(-0.3, 0.1), zlim=(0.0, 0.8))
    rest.set(xticks=[0.0, 0.4], yticks=[-0.2, 0.0], zticks=[0.0, 0.2, 0.4, 0.6])
    rest.set_box_aspect((0.55, 0.4, 0.8), zoom=0.9)
    rest.view_init(**SIDE)
    rest.legend(loc='upper left')
    speeds = drawing.add_subplot(grid[0, 1])
    errors = drawing.add_subplot(grid[1, 1], sharex=speeds)
    for damped, color, line, label in (
        (False, RED, DASHED, r'$J^+$'),
        (True, BLUE, '-', r'damped: $J^T (J J^T + \lambda^2 I)^{-1}$'),
    ):
        times, _, velocities, off = outwards(damped=damped)
        speeds.plot(times, np.linalg.norm(velocities, axis=-1), color=color, ls=line, label=label)
        errors.plot(times, 1e3 * off, color=color, ls=line)
    speeds.set(title=f'hand outwards, {SPEED:g} m/s', ylabel=r'$|\dot q|$ [rad/s]')
    speeds.legend(loc='upper left')
    speeds.tick_params(labelbottom=False)
    errors.set(xlabel='time [s]', ylabel='hand is off [mm]')
    for axes in (speeds, errors):
        axes.grid(color=GREY, alpha=0.25)
        axes.set_xlim(1.0, None)
    return drawing
