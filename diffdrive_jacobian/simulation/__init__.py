"""The robot as a value that advances in time: kinematics and control, no ROS."""

from diffdrive_jacobian.simulation.robot import Robot, RobotModel

__all__ = ['Robot', 'RobotModel']
