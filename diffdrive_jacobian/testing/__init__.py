"""Tests of ROS nodes in simulated time: `fixtures` for pytest, and `Lockstep` for other frameworks.

`Lockstep` and `LockstepError` are also names of this package. Their own package is `lockstep`.
"""

from diffdrive_jacobian.lockstep import Lockstep, LockstepError

__all__ = ['Lockstep', 'LockstepError']
