"""Checked conversion between ROS messages and numbers. Imports no ROS.

Internal: may change without notice.
"""
