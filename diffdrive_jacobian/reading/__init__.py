"""Recorded runs as NumPy arrays, and their verification."""

from diffdrive_jacobian.reading.reader import BagError, DamagedBagError, read_run
from diffdrive_jacobian.reading.run import Run, Series

__all__ = ['BagError', 'DamagedBagError', 'Run', 'Series', 'read_run']
