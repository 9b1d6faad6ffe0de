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
