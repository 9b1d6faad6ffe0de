"""Simulation of robots, of closed loops in batches, and of manipulators along lines. No ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy
from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.simulation.slip import Drift

if TYPE_CHECKING:
    from diffdrive_jacobian.simulation.closed_loop import closed_loops, trajectories
    from diffdrive_jacobian.simulation.tracking import track_line

__all__ = ['Drift', 'Robot', 'RobotModel', 'closed_loops', 'track_line', 'trajectories']
if not TYPE_CHECKING:
    # Nodes, which need none of them, start faster without.
    __getattr__, __dir__ = lazy.attach(
        __name__,
        {
            'closed_loops': 'simulation.closed_loop',
            'track_line': 'simulation.tracking',
            'trajectories': 'simulation.closed_loop',
        },
    )
