"""ROS messages as numbers, checked; no ROS is imported."""
