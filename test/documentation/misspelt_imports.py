"""Names that do not exist, or are public elsewhere. The type checker must refuse each.

Comments that it does not need are errors.
"""

from diffdrive_jacobian import (
    exploration,
    kinematics,
    lockstep,
    properties,
    simulation,
    testing,
)

NAMES = [
    kinematics.se3,  # type: ignore[attr-defined]
    simulation.close_loops,  # type: ignore[attr-defined]
    testing.explor,  # type: ignore[attr-defined]
    # Public in testing, and in the package itself.
    exploration.explore,  # type: ignore[attr-defined]
    lockstep.Lockstep,  # type: ignore[attr-defined]
    properties.PropertyViolation,  # type: ignore[attr-defined]
    kinematics.PlanarChain,  # type: ignore[attr-defined]
    testing.faults,  # type: ignore[attr-defined]
]
