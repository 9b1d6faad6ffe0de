"""Parameters of the nodes as validated dataclasses. Imports no ROS.

Internal: may change without notice.
"""
