"""Recording of topics as rosbag2 bags, through a journal that survives a crash.

Internal: may change without notice.
"""
