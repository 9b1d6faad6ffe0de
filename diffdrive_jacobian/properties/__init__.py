# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Properties that must hold in a run of a `Lockstep`, at each time step.

    from diffdrive_jacobian.properties import NeverFasterThan, StatusProtocol
    from diffdrive_jacobian.testing import Lockstep

    with Lockstep() as world:
        world.require(NeverFasterThan(0.5, 2.0), StatusProtocol())
        ...
        world.finish()

A violation is raised as a `testing.PropertyViolation` by the method that advanced time. For properties
of your own, derive from `Property`. Those of a robot are imported on first use.
"""

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy
from diffdrive_jacobian.properties.base import Property, end_of_faults
from diffdrive_jacobian.properties.field_within import FieldWithin

if TYPE_CHECKING:
    from diffdrive_jacobian.robot_testing.goals import (
        ArrivesOnceFaultsEnd,
        KeepsDriving,
        NoCommandAfterCancel,
        NoStaleGoals,
        ReachesGoal,
        Settles,
        StatusProtocol,
    )
    from diffdrive_jacobian.robot_testing.motion import (
        AccelerationWithin,
        NeverFasterThan,
        PoseFinite,
        StaysNear,
        StaysOnPath,
        StaysWithin,
    )
    from diffdrive_jacobian.robot_testing.stopping import (
        StopsAfterLastCommand,
        StopsAfterLostOdometry,
        StopsOnShutdown,
    )

__all__ = [
    'AccelerationWithin',
    'ArrivesOnceFaultsEnd',
    'FieldWithin',
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
    'end_of_faults',
]

_MODULES = {
    'robot_testing.goals': (
        *('ArrivesOnceFaultsEnd', 'KeepsDriving', 'NoCommandAfterCancel', 'NoStaleGoals'),
        *('ReachesGoal', 'Settles', 'StatusProtocol'),
    ),
    'robot_testing.motion': (
        *('AccelerationWithin', 'NeverFasterThan', 'PoseFinite'),
        *('StaysNear', 'StaysOnPath', 'StaysWithin'),
    ),
    'robot_testing.stopping': (*('StopsAfterLastCommand', 'StopsAfterLostOdometry', 'StopsOnShutdown'),),
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy.attach(
        __name__, {name: module for module, names in _MODULES.items() for name in names}
    )
