"""Runs as rosbag2 bags: recorded so that a crash costs a moment, recovered, read, replayed, verified."""

from diffdrive_jacobian.bags.reading import BagError, Run, Series, read_run

__all__ = ['BagError', 'Run', 'Series', 'read_run']
