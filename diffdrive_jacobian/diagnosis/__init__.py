"""What is wrong with a graph of nodes, with its clocks and with the machine: pure functions, no ROS.

Internal: may change without notice.
"""
