"""ROS nodes in simulated time that advances only when every node has answered."""

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep.world import Lockstep

__all__ = ['Lockstep', 'LockstepError']
