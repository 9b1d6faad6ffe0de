"""Recorded runs as NumPy arrays, and their verification. No ROS is needed."""

from diffdrive_jacobian.bags.bag_reader import BagError, DamagedBagError, ReadingInterruptedError
from diffdrive_jacobian.reading.reader import read_run
from diffdrive_jacobian.reading.run import Run, Series
from diffdrive_jacobian.reading.verification import Verification, verify

__all__ = [
    'BagError',
    'DamagedBagError',
    'ReadingInterruptedError',
    'Run',
    'Series',
    'Verification',
    'calibration_data',
    'read_run',
    'verify',
]
