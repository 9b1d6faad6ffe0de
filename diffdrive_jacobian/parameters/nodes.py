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

"""The parameters of the three nodes. Each module beside this one has those of one node.

A parameter may change while the node runs, unless its description says read-only.
"""

from diffdrive_jacobian.parameters.declaration import NodeParameters
from diffdrive_jacobian.parameters.go_to_goal import CONTROLLERS as CONTROLLERS
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.parameters.wheel_bridge import WheelBridgeParameters

NODE_PARAMETERS: tuple[NodeParameters, ...] = (
    VirtualRobotParameters(),
    GoToGoalParameters(),
    WheelBridgeParameters(),
)
"""The parameters of all nodes of this package, with their defaults."""
