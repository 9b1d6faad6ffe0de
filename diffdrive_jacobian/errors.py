"""Errors of the layer above rclpy that tools without ROS raise, too."""


class UserError(Exception):
    """A mistake of the user who started the process; the message names it."""
