"""ROS nodes in simulated time, which advances only when every node has processed its inputs.

Internal: programs import `Lockstep` and its errors from `testing`.
"""
