"""The runner of nodes in simulated time; `ros.runner` has the one for real time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rclpy.node import Node

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.ros.runner import NodeRunner

LONGEST_STEP = 1.0
"""Largest advance of the time in which nothing happens, as in a world without timers (s)."""


@contextmanager
def running_in_lockstep(args: Sequence[str]) -> Iterator[LockstepRunner]:
    """Create a lockstep world with ROS arguments, and close it at the end.

    Raises:
        LockstepError: The arguments are invalid.
    """
    with Lockstep(args) as world:
        yield LockstepRunner(world)


class LockstepRunner(NodeRunner):
    """Nodes in simulated time, which advances when every node has answered."""

    def __init__(self, world: Lockstep) -> None:
        """Start without nodes."""
        super().__init__(world.node.context)
        self._world = world

    def seconds(self) -> float:
        """Return the world time (s), which advances even when the clock of the nodes jumps."""
        return self._world.world_seconds

    def settle(self) -> None:
        """Execute the callbacks that are due. No time passes."""
        self._world.settle()

    def _add(self, node: Node) -> None:
        """Add a node.

        Raises:
            LockstepError: The node runs on wall time.
        """
        self._world.add(node)

    def _remove(self, node: Node) -> None:
        self._world.remove(node)

    def _spin_once(self) -> None:
        self._world.step(at_most=LONGEST_STEP)
