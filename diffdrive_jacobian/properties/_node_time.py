"""The time that a node had to react, which faults of the node and of its clock shorten."""

from __future__ import annotations

import math
from typing import Any

from rclpy.node import Node

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.time_units import NANOSECONDS

ROUNDING = 1e-9
"""Tolerance on times (s) and distances (m)."""


class ReactionTime:
    """Measures the time that a node had to react to something.

    It is world time, except that it does not pass while the clock of the nodes stands still. Where the
    clock jumps, a timer that measures a time may start again, so the measurement does too.
    """

    def __init__(self, world: Lockstep) -> None:
        """Start to measure."""
        self._world = world
        self._world_time, self._clock = world.world_time, world.now
        self._passed = 0
        self._jumped = -math.inf

    def now(self) -> float:
        """Return the time that has passed (s)."""
        world_time, clock = self._world.world_time, self._world.now
        by_world, by_clock = world_time - self._world_time, clock - self._clock
        jumped = _jumped(self._world.faults, self._world_time, world_time)
        self._world_time, self._clock = world_time, clock
        if 0 <= by_clock <= by_world and not jumped:
            self._passed += by_clock
        else:
            self._passed += by_world
            self._jumped = self._passed / NANOSECONDS
        return self._passed / NANOSECONDS

    def since(self, time: float) -> float:
        """Return how long ago a time was for a timer of a node (s)."""
        return self.now() - max(time, self._jumped)


def _jumped(faults: list[Any], before: int, now: int) -> bool:
    """Return whether the clock jumped between two world times (ns).

    After a pause a jump forward may look as if time had passed evenly.
    """
    if before == now:
        return False
    times = (time for fault in faults for time in fault.clock_jumps)
    return any(before < time * NANOSECONDS <= now for time in times)


def delays(world: Lockstep, node: Node, since: float) -> float:
    """Return by how much faults of a node may have delayed its reaction since a world time (s)."""
    name, now = node.get_fully_qualified_name().lstrip('/'), world.world_time / NANOSECONDS
    total = 0.0
    for fault in world.faults:
        if fault.affected_node.lstrip('/') == name:
            total += fault.reaction_delay(node, since, now)
    return total


def end_of_faults(world: Lockstep) -> float:
    """Return the world time at which all faults have ended, and what they delayed has arrived (s).

    Infinite: one of them has no end. Faults of one topic may delay a message one after the other.
    """
    end, delay = 0.0, 0.0
    for fault in world.faults:
        end = max(end, fault.end)
        delay += fault.longest_delay
    return end + delay
