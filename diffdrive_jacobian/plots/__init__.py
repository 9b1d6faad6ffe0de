"""What all pictures share: their style, and the files they are written to. No ROS."""
