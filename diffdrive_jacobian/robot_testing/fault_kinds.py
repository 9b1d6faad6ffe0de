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

"""The faults of a robot that `fault_schedules(robots=...)` draws from."""

from __future__ import annotations

from collections.abc import Callable

from diffdrive_jacobian.exploration.schedules import SHORT, Fields, numbers, st
from diffdrive_jacobian.robot_testing import faults

WHEELS = ('left', 'right')

KINDS: dict[type[faults.RobotFault], Callable[[], Fields]] = {
    faults.Push: lambda: {
        'noticed': st.booleans(),
        'dtheta': numbers(-3.0, 3.0),
        'dy': numbers(-1.0, 1.0),
        'dx': numbers(-1.0, 1.0),
    },
    faults.DeadWheel: lambda: {'wheel': st.sampled_from(WHEELS)},
    faults.SaturatedWheel: lambda: {
        'wheel': st.sampled_from(WHEELS),
        'max_velocity': numbers(0.1, 10.0),
    },
    faults.ActuatorLag: lambda: {'seconds': st.sampled_from(SHORT)},
    faults.EncoderSteps: lambda: {'per_revolution': st.sampled_from((16, 64, 256, 1024))},
    faults.Slip: dict,
    faults.WrongGeometry: lambda: dict.fromkeys(
        (
            'left_wheel_radius_multiplier',
            'right_wheel_radius_multiplier',
            'wheel_separation_multiplier',
        ),
        st.sampled_from((1.0, 1.1, 0.9, 1.5, 0.5)),
    ),
}
"""Strategies of their fields besides the name of the robot, start and duration."""
