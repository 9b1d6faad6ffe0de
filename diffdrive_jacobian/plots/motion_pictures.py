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

"""Pictures of motions of a robot: the Lie bracket and parallel parking (A), the path laws (B)."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_jacobian.control.path import Path
from diffdrive_jacobian.control.path_following import PathSettings
from diffdrive_jacobian.control.path_laws import PATH_CONTROLLERS
from diffdrive_jacobian.control.path_source import figure_eight_path
from diffdrive_jacobian.kinematics import diff_drive, se2
from diffdrive_jacobian.numerics.checks import array
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREEN, GREY, INK, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

R, L = 0.033, 0.16
"""Wheel radius and separation of the robot that is drawn (m)."""

# --- The Lie bracket

A, B = 0.5, 0.8
"""Distance forward and back (m), angle turned and turned back (rad)."""


@picture
def lie_bracket() -> Figure:
    """Draw the parallelogram of the Lie bracket: from above, over the poses, and as it gets smaller."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(9.0, 3.2), layout='constrained')
    above, poses, order = drawing.subplots(1, 3, width_ratios=[1.2, 1.2, 1.0])
    corners = parallelogram(A, B)
    _draw_from_above(above, corners)
    _draw_poses(poses, corners)
    _draw_order(order)
    return drawing


def parallelogram(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Return the corners of forward a, turn b, back, turn back, from the pose 0; shape (5, ..., 3)."""
    forward = np.stack(np.broadcast_arrays(a, 0.0 * np.asarray(b)), axis=-1)
    turn = np.stack(np.broadcast_arrays(0.0 * np.asarray(a), b), axis=-1)
    corners = [np.zeros((*forward.shape[:-1], 3))]
    for twist in (forward, turn, -forward, -turn):
        corners.append(se2.integrate(corners[-1], twist, 1.0))
    return np.array(corners)


def _draw_from_above(axes: Axes, corners: NDArray[np.float64]) -> None:
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
    # Where a metre along x, a metre along y and a radian are in the drawing.
    oblique = np.array([[1.0, 0.0], [0.5, 0.35], [0.0, 0.55]])
    flat = corners @ oblique
    for length, tip, text, offset in zip(
        (0.75, 0.45, 1.125),
        oblique,
        ('$x$', '$y$', r'$\theta$'),
        ((10.0, 0.0), (8.0, 6.0), (0.0, 9.0)),
        strict=True,
    ):
        sketch.arrow(axes, [0.0, 0.0], length * tip, text, offset, color=GREY, lw=1.0)
    edges = ('1 forward', '2 turn', '3 back', '4 turn back')
    offsets = ((0.0, -10.0), (26.0, 0.0), (0.0, 12.0), (-40.0, 0.0))
    for edge, first, last, offset in zip(edges, flat[:-1], flat[1:], offsets, strict=True):
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
    difference = gap - size[:, np.newaxis] ** 2 * diff_drive.lie_bracket(0.0)
    axes.loglog(size, np.linalg.norm(gap, axis=-1), color=RED, lw=3.6, label='gap')
    axes.loglog(size, size**2, color='black', lw=1.0, ls=DASHED, label='$ab$, the bracket')
    axes.loglog(
        size, np.linalg.norm(difference, axis=-1), color=GREY, lw=1.8, ls=':', label='difference'
    )
    axes.set(title='of second order', xlabel='$a = b$ [m, rad]', ylabel='length [m]')
    axes.set(xticks=[0.01, 0.1, 1.0], yticks=10.0 ** np.arange(-6.0, 1.0), ylim=(1e-7, 1e3))
    axes.legend(loc='upper left')


# --- Parallel parking

TURN, RADIUS = 1.2, 0.2
"""Angle (rad) and radius (m) of the two arcs."""
WIDTH = 2.0 * RADIUS * (1.0 - np.cos(TURN))
"""How far the robot gets sideways (m)."""
MOTIONS = (
    ((2.0 * RADIUS * np.sin(TURN) / 4.0, 0.0), 4.0),
    ((-0.1, 0.1 / RADIUS), TURN * RADIUS / 0.1),
    ((-0.1, -0.1 / RADIUS), TURN * RADIUS / 0.1),
)
"""The motions: twist (m/s, rad/s) and duration (s)."""
STANDING = 1e-9
"""Largest change of a pose that is no motion (m, rad)."""
OUTLINES = 8
"""How many outlines of the moving robot are drawn."""


@picture
def parking(poses: ArrayLike | None = None) -> Figure:
    """Draw how a differential drive parks sideways between two others.

    Args:
        poses: Poses of the robot that parks, shape (n, 3) (m, m, rad), for example from the odometry of
            `virtual_robot` without drift. None: those of the exact motion.

    Raises:
        ValueError: Poses are not finite, have another shape, or do not differ.
    """
    driven = _driven(parked() if poses is None else array('poses', poses, 'n', 3))
    drawing, axes = sketch.canvas(7.2, (-0.4, 0.62), (-0.13, 0.4))
    for left, right in ((0.29, 0.55), (-0.37, -0.08)):
        box = [[left, -0.09], [right, -0.09], [right, 0.09], [left, 0.09]]
        sketch.outline(axes, box, fc='#dddddd', hatch='//', ec=GREY)
    for pose in driven[:: max(len(driven) // OUTLINES, 1)]:
        sketch.outline(axes, sketch.placed(L * sketch.BODY, pose), ec='#999999', lw=0.8)
    for pose in (driven[0], driven[-1]):
        sketch.robot(axes, pose, R, L)
    parts = [driven[first : last + 1, :2] for first, last in pairwise(_places(driven))]
    # In place there is nothing to draw.
    parts = [part for part in parts if np.max(np.ptp(part, axis=0)) > STANDING]
    for number, part in enumerate(parts, 1):
        sketch.line(axes, *part[:-1], color=BLUE, lw=2.0)
        sketch.arrow(axes, part[-2], part[-1] - part[-2], color=BLUE, lw=2.0, mutation_scale=16.0)
        middle = len(part) // 2
        along = part[middle] - part[middle - 1]
        left = 12.0 * np.array([-along[1], along[0]]) / np.hypot(*along)
        sketch.label(axes, str(number), part[middle], (left[0], left[1]), color=BLUE, zorder=6)
    start, end = driven[0, :2], driven[-1, :2]
    # Between the wheels: on the axles it would not be seen.
    sketch.arrow(axes, start + 0.36 * (end - start), 0.28 * (end - start), color=RED, lw=2.6)
    text = 'no motion\nin this direction'
    sketch.label(axes, text, (start + end) / 2.0, (-52.0, 0.0), color=RED, fontsize=9.5)
    sketch.dimension(axes, [0.5, 0.33], [0.6, 0.33], 0.0, '0.1 m', fontsize=9.5)
    return drawing


def parked(samples: int = 100) -> NDArray[np.float64]:
    """Return the poses of the exact motion, first beside the gap and at last in it, shape (n, 3)."""
    poses = [np.array([0.0, WIDTH, 0.0])]
    for twist, duration in MOTIONS:
        times = np.linspace(0.0, duration, samples + 1)[1:]
        poses += [*se2.integrate(poses[-1], twist, times)]
    return np.array(poses)


def _driven(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses without those at which the robot stands."""
    moves = np.max(np.abs(np.diff(poses, axis=0)), axis=-1) > STANDING
    if poses.ndim != 2 or not moves.any():
        raise ValueError(f'poses must have shape (n, 3) and differ, got shape {poses.shape}')
    return np.asarray(poses[np.concatenate([[True], moves])])


def _places(poses: NDArray[np.float64]) -> list[int]:
    """Return the indices at which the robot starts, changes its direction or its turn, and ends."""
    steps = se2.log(se2.compose(se2.inverse(poses[:-1]), poses[1:]))
    kinds = np.sign(np.round(steps[:, ::2], 9))
    changes = np.flatnonzero((np.diff(kinds, axis=0) != 0.0).any(axis=-1)) + 1
    return [0, *changes.tolist(), len(poses) - 1]


# --- Laws of paths

STYLES = {
    'pure_pursuit': (RED, '-'),
    'kanayama': (BLUE, '-'),
    'offset_point': (GREEN, '--'),
    'dynamic_feedback': (INK, '-.'),
}
"""Colour and line of each law."""
LEAST = 1e-5
"""Smallest error that is drawn (m)."""


@picture
def path_laws() -> Figure:
    """Draw an ideal robot under each law of paths: from above, and its error across the path."""
    from matplotlib.figure import Figure

    from diffdrive_jacobian.simulation.tracking import follow_path

    drawing = Figure(figsize=(5.0, 4.2), layout='constrained')
    above, errors = drawing.subplots(2, 1, height_ratios=[1.1, 1.0])
    path = Path(se2.compose([0.0, 0.0, -np.pi / 2.0], figure_eight_path(1.0).poses))
    # 20 cm beside the path, and not along it.
    start = (-0.2, 0.0, -0.97)
    x, y, _ = path.poses_at(np.linspace(0.0, path.length, 200)).T
    above.plot(x, y, color='#cccccc', lw=5.0, label='planned')
    settings = PathSettings(speed=0.4)
    for law in PATH_CONTROLLERS:
        driven = follow_path(law, path, start=start, settings=settings)
        color, line = STYLES[law.name]
        style: Any = {'color': color, 'ls': line, 'lw': 1.2}
        above.plot(driven.poses[:, 0], driven.poses[:, 1], label=law.name, **style)
        across = np.maximum(abs(driven.errors[::4, 1]), LEAST)
        errors.semilogy(driven.references[::4, 7], 1e3 * across, **style)
    above.plot(*start[:2], 'k.', ms=6.0)
    above.annotate('start', start[:2], xytext=(-6.0, 6.0), textcoords='offset points')
    above.set(xlabel='x [m]', ylabel='y [m]', aspect='equal')
    drawing.legend(loc='outside lower center', ncols=3, handlelength=2.5)
    errors.set(xlabel='distance along the path [m]', ylabel='error across [mm]')
    return drawing
