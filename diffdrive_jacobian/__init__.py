"""A virtual differential-drive robot for ROS 2, driven through the mobile-robot Jacobian."""

__version__ = '0.1.0'
