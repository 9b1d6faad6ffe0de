"""The runner of the entry points (`ros.runner`) for those that live in lockstep."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from rclpy.context import Context
from rclpy.node import Node

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.ros.node import ParameterizedNode
from diffdrive_jacobian.ros.parameters import report_unknown
from diffdrive_jacobian.ros.runner import made

N = TypeVar('N', bound=Node)


@contextmanager
def running_in_lockstep(args: Sequence[str]) -> Iterator[LockstepRunner]:
    """Hold a world, with ROS arguments, for a tool.

    Raises:
        LockstepError: The arguments cannot be.
    """
    with Lockstep(args) as world:
        yield LockstepRunner(world)


class LockstepRunner:
    """Nodes that live by simulated time."""

    def __init__(self, world: Lockstep) -> None:
        """Begin without nodes."""
        self.context: Context = world.node.context
        self._world = world
        self._nodes: list[Node] = []
        self._begun = False

    def seconds(self) -> float:
        """Give the simulated time that has passed (s)."""
        return self._world.elapsed

    def add(self, make: Callable[[], N]) -> N:
        """Make a node and add it.

        Raises:
            UserError: The name, the parameters or the QoS that its user gave cannot be.
            LockstepError: Its user had it run on wall time.
        """
        node = made(make)
        self._nodes.append(node)
        return self._world.add(node)

    def spin(self, until: Callable[[], bool]) -> bool:
        """Let time pass until a condition holds; it is looked at at each instant."""
        if not self._begun:
            self._begun = True
            report_unknown([node for node in self._nodes if isinstance(node, ParameterizedNode)])
        self._world.settle()
        while not until():
            self._world.step()
        return True
