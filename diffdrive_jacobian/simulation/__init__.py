"""Simulation of robots, of closed loops in batches, and of manipulators along lines. No ROS."""

from diffdrive_jacobian.simulation.closed_loop import closed_loops, trajectories
from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.simulation.tracking import track_line

__all__ = ['Robot', 'RobotModel', 'closed_loops', 'track_line', 'trajectories']
