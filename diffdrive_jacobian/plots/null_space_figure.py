"""What the null space of a redundant arm is for: to move with the tip at rest, or around obstacles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.control import StraightLine
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.rendering import picture
from diffdrive_jacobian.plots.sketch import BLUE, DASHED, GREY, INK, RED
from diffdrive_jacobian.simulation import track_line
from diffdrive_jacobian.simulation.tracking import Tracking

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

ARM = PlanarArm([0.5, 0.4, 0.3])
START = (0.9, -1.5, 1.0)
"""Joint angles at which both motions start (rad)."""
END = (0.25, 0.45)
"""Where the tip is led, along a straight line (m)."""
OBSTACLE = (0.1, 0.5)
SPEED = 0.1
"""Speed along the line (m/s)."""
PUSH = 4.0
"""Gain k of the secondary task `k * clearance_gradient` (rad^2/(m s))."""
STEP = 0.01


@picture
def null_space() -> Figure:
    """Draw the null-space motion of three links: with the tip at rest, and around an obstacle.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(8.6, 3.3), layout='constrained')
    at_rest, around, clearance = drawing.subplots(1, 3, width_ratios=[1.0, 1.15, 0.9])
    _draw_at_rest(at_rest)
    without, avoiding = tracked(avoid=False), tracked(avoid=True)
    _draw_around(around, without, avoiding)
    _draw_clearance(clearance, without, avoiding)
    return drawing


def tracked(*, avoid: bool) -> Tracking:
    """Lead the tip along the line by the least joint velocities, or also away from the obstacle."""
    line = StraightLine(ARM.forward_kinematics(START)[:2], END, SPEED)

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
    track = self_motion()
    shown = track[::200]
    for shade, q in zip(np.linspace(0.75, 0.0, len(shown)), shown, strict=True):
        _draw_arm(axes, q, color=str(shade))
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
    _draw_arm(axes, START, color='0.75', lw=4.0, label='start')
    _draw_arm(axes, without.q[nearest], color=GREY, ls=':', label='without, nearest')
    _draw_arm(axes, without.q[-1], color=GREY, ls=DASHED, label='without, end')
    _draw_arm(axes, avoiding.q[-1], color=BLUE, label='away from it, end')
    axes.plot(*OBSTACLE, 'X', color=INK, ms=8.0, zorder=5, label='obstacle', ls='none')
    axes.set(title='past an obstacle', xlabel='x [m]', ylabel='y [m]', aspect='equal')
    axes.set(xlim=(-0.35, 1.0), ylim=(-0.08, 1.5), xticks=[0.0, 0.5, 1.0], yticks=[0.0, 0.5])
    axes.legend(loc='upper center', fontsize=8.0, labelspacing=0.3)


def _draw_clearance(axes: Axes, without: Tracking, avoiding: Tracking) -> None:
    axes.plot(
        without.times, ARM.clearance(without.q, OBSTACLE), color=GREY, ls=DASHED, label=r'$J^+ \dot x$'
    )
    axes.plot(
        avoiding.times,
        ARM.clearance(avoiding.q, OBSTACLE),
        color=BLUE,
        label=r'$J^+ \dot x + N k \nabla c$',
    )
    axes.set(title='clearance $c$', xlabel='time [s]', ylabel='$c$ [m]')
    axes.set(xticks=[0.0, 2.0, 4.0, 6.0], ylim=(0.0, 0.55))
    axes.legend(loc='upper center')


def _draw_arm(axes: Axes, q: NDArray[np.float64] | tuple[float, ...], **style: object) -> None:
    sketch.line(
        axes,
        *ARM.joint_positions(q),
        **{'lw': 2.2, 'marker': 'o', 'ms': 4.0, 'solid_capstyle': 'round', **style},
    )
