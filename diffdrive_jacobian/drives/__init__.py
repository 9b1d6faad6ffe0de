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

"""Drives of the virtual robot to goals: robot, controller and wheel bridge in one process.

    from diffdrive_jacobian.drives import drive

    outcome = drive([[1.0, 1.0]], lockstep=True)
    print(outcome.arrived, outcome.pose, outcome.seconds)
    outcome.plot()

The robot is driven by its wheels, so that the whole Jacobian chain is in use:
goal -> control law -> body twist -> J_w^-1 -> wheel speeds -> J_w -> body twist -> S(theta) -> pose.

Where rclpy is installed the nodes run. Elsewhere the same robot, bridge and laws are used without them,
and drive as in lockstep, to the last bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.drives.driving import drive
    from diffdrive_jacobian.drives.nodes import in_lockstep, in_real_time
    from diffdrive_jacobian.drives.outcome import DriveError, DriveProgress, Outcome, waypoints_through

__all__ = [
    'DriveError',
    'DriveProgress',
    'Outcome',
    'drive',
    'in_lockstep',
    'in_real_time',
    'waypoints_through',
]
if not TYPE_CHECKING:
    # Without rclpy drives need no nodes.
    _MODULES = {'drive': 'driving', 'in_lockstep': 'nodes', 'in_real_time': 'nodes'}
    __getattr__, __dir__ = lazy.attach(
        __name__, {name: f'drives.{_MODULES.get(name, "outcome")}' for name in __all__}
    )
