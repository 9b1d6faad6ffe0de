"""A body on two legs, seen from its right side: its coordinates and the sense of its angles (C)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREEN, GREY, RED

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

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
    """Draw a body on two legs from the side: `q = [x, z, pitch, hip, knee, hip, knee]`.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    drawing, axes = sketch.canvas(6.9, (-1.0, 1.08), (-0.8, 0.32))
    sketch.line(axes, [-0.95, GROUND], [0.9, GROUND], lw=1.6)
    sketch.frame(axes, [-0.88, GROUND, 0.0], 0.2, '', '$z$')
    sketch.label(axes, '$x$', [-0.68, GROUND], (0.0, -10.0))
    theta = BASE[2]
    body = [[-0.3, -0.06], [0.36, -0.06], [0.42, 0.0], [0.36, 0.06], [-0.3, 0.06]]
    sketch.outline(axes, sketch.placed(body, BASE), fc=sketch.FILL, ec=GREY)
    for end in (sketch.placed([0.8, 0.0], BASE), [BASE[0] + 0.8, BASE[1]]):
        sketch.line(axes, BASE[:2], end, color=GREY, lw=0.9, ls=DASHED)
    sketch.angle(axes, BASE[:2], 0.72, 0.0, theta, '', color=RED)
    sketch.label(axes, 'pitch > 0', [0.72, 0.0], (36.0, 14.0), color=RED)
    sketch.point(axes, BASE[:2], '$(x, z)$', (-4.0, 22.0))
    for number, (hip, foot) in enumerate(zip(HIPS, FEET, strict=True), 1):
        at = sketch.placed(hip, BASE)
        q_hip, q_knee = _bent(foot - at)
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


def _bent(foot: NDArray[np.float64]) -> tuple[float, float]:
    """Return the angle of the thigh against the horizontal, and of the shank against the thigh (rad)."""
    thigh, _ = LEG.lengths
    knee = 2.0 * np.arccos(np.hypot(*foot) / (2.0 * thigh))
    return float(np.arctan2(foot[1], foot[0]) - knee / 2.0), float(knee)
