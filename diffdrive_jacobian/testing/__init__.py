"""Tests of ROS nodes in simulated time: `fixtures` for pytest, and `Lockstep` for other frameworks.

`Lockstep`, `LockstepError`, what nodes in other processes send (`Answers`, `Every`, `Idle`) and `faults`
are also names of this package. `Lockstep` has its own package `lockstep`, and faults theirs, `faults`.
"""

from diffdrive_jacobian import faults
from diffdrive_jacobian.lockstep import Answers, Every, Idle, Lockstep, LockstepError

__all__ = ['Answers', 'Every', 'Idle', 'Lockstep', 'LockstepError', 'faults']
