"""Tests of ROS nodes in simulated time: `fixtures` for pytest, and `Lockstep` for other frameworks.

`Lockstep`, `LockstepError` and `faults` are also names of this package. `Lockstep` has its own package
`lockstep`, and faults theirs, `faults`.
"""

from diffdrive_jacobian import faults
from diffdrive_jacobian.lockstep import Lockstep, LockstepError

__all__ = ['Lockstep', 'LockstepError', 'faults']
