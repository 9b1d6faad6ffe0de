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

"""The plugin of pytest for tests of a robot. It is loaded by its entry point.

`robot_at(x, y, theta)` adds a virtual robot to the fixture `lockstep`. Until it is used, this module
imports neither rclpy nor NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep.world import Lockstep
    from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot


@pytest.fixture
def robot_at(lockstep: Lockstep) -> Callable[..., VirtualRobot]:
    """Return a function that adds a virtual robot with a pose, a namespace and parameters.

    A parameter is given by its name, with `__` for each dot. TypeError: there is no such parameter.
    """
    from rclpy.parameter import Parameter

    from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
    from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters

    def place(
        x: float = 0.0, y: float = 0.0, theta: float = 0.0, *, namespace: str = '', **parameters: Any
    ) -> VirtualRobot:
        values = {'x': float(x), 'y': float(y), 'theta': float(theta)}
        values |= {name.replace('__', '.'): value for name, value in parameters.items()}
        known = VirtualRobotParameters().declared()
        if unknown := sorted(set(values) - set(known)):
            raise TypeError(f'virtual_robot has no parameter {unknown[0]!r}; it has {", ".join(known)}')
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        return lockstep.create(lambda: VirtualRobot(namespace=namespace, parameter_overrides=overrides))

    return place
