"""Tests of ROS nodes without waiting: simulated time that passes only when every node has answered."""

from diffdrive_jacobian.testing._errors import LockstepError
from diffdrive_jacobian.testing.lockstep import Lockstep

__all__ = ['Lockstep', 'LockstepError']
