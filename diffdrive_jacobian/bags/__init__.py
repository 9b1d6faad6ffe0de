"""File formats: rosbag2 bags, read within limits and written whole, and journals."""
