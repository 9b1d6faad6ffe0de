"""Common code of the nodes: base class, parameters, runner, watchdog, adapter to rclpy.

Internal: may change without notice.
"""
