"""Virtual robots in a test."""

from __future__ import annotations

from typing import Any

from rclpy.parameter import Parameter

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters.declaration import specifications
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters


def place_robot(
    world: Lockstep, x: float, y: float, theta: float, namespace: str, parameters: dict[str, Any]
) -> VirtualRobot:
    """Add a virtual robot at a pose.

    Args:
        world: Where it is added.
        x: Position (m).
        y: Position (m).
        theta: Heading (rad).
        namespace: Namespace of the node.
        parameters: Further parameters by their names, with `__` for each dot.

    Raises:
        TypeError: There is no such parameter.
    """
    pose = {'x': float(x), 'y': float(y), 'theta': float(theta)}
    values = {name.replace('__', '.'): value for name, value in {**pose, **parameters}.items()}
    known = specifications(VirtualRobotParameters)
    if unknown := sorted(set(values) - set(known)):
        raise TypeError(f'virtual_robot has no parameter {unknown[0]!r}; it has {", ".join(known)}')

    def create() -> VirtualRobot:
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        return VirtualRobot(namespace=namespace, parameter_overrides=overrides)

    return world.create(create)
