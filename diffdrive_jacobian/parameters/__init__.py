"""Parameters of the nodes as checked dataclasses; no ROS is imported."""
