"""Properties that must hold in a run of a `Lockstep`, at each time step.

    from diffdrive_jacobian.properties import NeverFasterThan, StatusProtocol
    from diffdrive_jacobian.testing import Lockstep

    with Lockstep() as world:
        world.require(NeverFasterThan(0.5, 2.0), StatusProtocol())
        ...
        world.finish()

A violation is raised as a `testing.PropertyViolation` by the method that advanced time. For properties
of your own, derive from `Property` and `Watch`.
"""

from diffdrive_jacobian.properties.base import Property, Watch
from diffdrive_jacobian.properties.goals import (
    ArrivesOnceFaultsEnd,
    KeepsDriving,
    NoCommandAfterCancel,
    NoStaleGoals,
    ReachesGoal,
    Settles,
    StatusProtocol,
    end_of_faults,
)
from diffdrive_jacobian.properties.motion import (
    AccelerationWithin,
    NeverFasterThan,
    PoseFinite,
    StaysNear,
    StaysOnPath,
    StaysWithin,
)
from diffdrive_jacobian.properties.stopping import (
    StopsAfterLastCommand,
    StopsAfterLostOdometry,
    StopsOnShutdown,
)

__all__ = [
    'AccelerationWithin',
    'ArrivesOnceFaultsEnd',
    'KeepsDriving',
    'NeverFasterThan',
    'NoCommandAfterCancel',
    'NoStaleGoals',
    'PoseFinite',
    'Property',
    'ReachesGoal',
    'Settles',
    'StatusProtocol',
    'StaysNear',
    'StaysOnPath',
    'StaysWithin',
    'StopsAfterLastCommand',
    'StopsAfterLostOdometry',
    'StopsOnShutdown',
    'Watch',
    'end_of_faults',
]
