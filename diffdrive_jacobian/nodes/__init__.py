"""The three nodes: convert a message, call the library, publish."""

__all__ = ['go_to_goal', 'virtual_robot', 'wheel_bridge']
