"""Parallel parking of a differential drive: sideways, which it cannot drive, by three motions it can."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.numerics.checks import array
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, GREY, RED

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

R, L = 0.033, 0.16
"""Wheel radius and separation of the robot that is drawn (m)."""
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
PARKED = ((0.29, 0.55), (-0.37, -0.08))
"""From where to where along x two other robots are parked (m)."""


@picture
def parking(poses: ArrayLike | None = None) -> Figure:
    """Draw how a differential drive parks sideways between two others.

    Args:
        poses: Poses of the robot that parks, shape (n, 3) (m, m, rad), for example from the odometry of
            `virtual_robot` without drift. None: those of the exact motion.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
        ValueError: Poses are not finite, have another shape, or do not differ.
    """
    driven = _driven(parked() if poses is None else array('poses', poses, 'n', 3))
    drawing, axes = sketch.canvas(7.2, (-0.4, 0.62), (-0.13, 0.4))
    for left, right in PARKED:
        box = [[left, -0.09], [right, -0.09], [right, 0.09], [left, 0.09]]
        sketch.outline(axes, box, fc='#dddddd', hatch='//', ec=GREY)
    places = _places(driven)
    for pose in driven[:: max(len(driven) // OUTLINES, 1)]:
        sketch.outline(axes, sketch.placed(L * sketch.BODY, pose), ec='#999999', lw=0.8)
    for pose in (driven[0], driven[-1]):
        sketch.robot(axes, pose, R, L)
    parts = [driven[first : last + 1, :2] for first, last in pairwise(places)]
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
    sketch.label(
        axes, 'no motion\nin this direction', (start + end) / 2.0, (-52.0, 0.0), color=RED, fontsize=9.5
    )
    sketch.dimension(axes, [0.5, 0.33], [0.6, 0.33], 0.0, '0.1 m', fontsize=9.5)
    return drawing


def parked(samples: int = 100) -> NDArray[np.float64]:
    """Return the poses of the exact motion, beside the gap at first and at last in it, shape (n, 3)."""
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
