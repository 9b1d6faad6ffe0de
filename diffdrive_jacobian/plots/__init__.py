"""Figures and tables of runs and sweeps, their style and their files. No ROS is needed."""
