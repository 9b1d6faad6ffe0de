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

"""Faults that a `Lockstep` injects: of topics, nodes, the world around them, and the robot.

With `from diffdrive_jacobian import faults`, a test calls
`lockstep.inject(faults.Loss('odom', probability=0.5, start=2.0, duration=1.0))`.

Those of the robot are imported on first use: they need its nodes.
"""

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy
from diffdrive_jacobian.faults.corrupt import Corrupt
from diffdrive_jacobian.faults.fault import Fault, Filter, TopicFault
from diffdrive_jacobian.faults.topics import Delay, Duplicate, Loss, RateLimit, Reorder, Stale
from diffdrive_jacobian.faults.world import (
    ClockPause,
    Hang,
    Kill,
    LateService,
    NodeFault,
    ParameterChange,
    Slow,
    TimeJump,
    TimerJitter,
)
from diffdrive_jacobian.lockstep._fault_log import FaultEvent
from diffdrive_jacobian.lockstep._injection import Injection

if TYPE_CHECKING:
    from diffdrive_jacobian.robot_testing.faults import (
        ActuatorLag,
        DeadWheel,
        EncoderSteps,
        Push,
        RobotFault,
        SaturatedWheel,
        Slip,
        WrongGeometry,
    )

__all__ = [
    'ActuatorLag',
    'ClockPause',
    'Corrupt',
    'DeadWheel',
    'Delay',
    'Duplicate',
    'EncoderSteps',
    'Fault',
    'FaultEvent',
    'Filter',
    'Hang',
    'Injection',
    'Kill',
    'LateService',
    'Loss',
    'NodeFault',
    'ParameterChange',
    'Push',
    'RateLimit',
    'Reorder',
    'RobotFault',
    'SaturatedWheel',
    'Slip',
    'Slow',
    'Stale',
    'TimeJump',
    'TimerJitter',
    'TopicFault',
    'WrongGeometry',
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy.attach(
        __name__,
        dict.fromkeys(
            (
                *('ActuatorLag', 'DeadWheel', 'EncoderSteps', 'Push'),
                *('RobotFault', 'SaturatedWheel', 'Slip', 'WrongGeometry'),
            ),
            'robot_testing.faults',
        ),
    )
