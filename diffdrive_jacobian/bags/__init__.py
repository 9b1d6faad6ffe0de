"""File formats: rosbag2 bags, which are read within limits and written completely, and journals.

Internal: may change without notice.
"""
