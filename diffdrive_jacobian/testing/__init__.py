"""Tests of ROS nodes in simulated time: `fixtures` for pytest, and `Lockstep` for other frameworks.

`Lockstep`, `LockstepError` and the package `faults` are also names of this package. So are all names of
the package `exploration`, which are imported when they are used first: `explore`, `fault_schedules`,
`poses`, ... They need Hypothesis.
"""

from typing import Any

from diffdrive_jacobian import exploration, faults
from diffdrive_jacobian.lockstep import Lockstep, LockstepError

__all__ = ['Lockstep', 'LockstepError', 'faults']


def __getattr__(name: str) -> Any:
    """Import a name of `exploration`."""
    if name in exploration.__all__:
        return getattr(exploration, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
