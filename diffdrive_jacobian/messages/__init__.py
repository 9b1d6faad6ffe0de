"""Checked conversion between ROS messages and numbers. Imports no ROS."""
