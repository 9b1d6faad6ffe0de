"""Common code of the nodes: base class, parameters, runner, watchdog, adapter to rclpy."""
