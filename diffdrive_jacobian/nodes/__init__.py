"""The three nodes, what they compute without ROS, and the client that sends goals."""

__all__ = ['go_to_goal', 'virtual_robot', 'wheel_bridge']
