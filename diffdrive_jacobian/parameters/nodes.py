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
