"""Properties that must hold in a run of a `Lockstep`, at each time step.

    from diffdrive_jacobian.properties import NeverFasterThan, StatusProtocol

    with Lockstep() as world:
        world.require(NeverFasterThan(0.5, 2.0), StatusProtocol())
        ...
        world.finish()

A violation is raised as a PropertyViolation by the method that advanced time. For properties of your
own, derive from `Property` and `Watch`.
"""

from diffdrive_jacobian.lockstep import PropertyViolation
from diffdrive_jacobian.properties.base import Property, Watch
from diffdrive_jacobian.properties.protocol import StatusProtocol
from diffdrive_jacobian.properties.speed import AccelerationWithin, NeverFasterThan

__all__ = [
    'AccelerationWithin',
    'NeverFasterThan',
    'Property',
    'PropertyViolation',
    'StatusProtocol',
    'Watch',
]
