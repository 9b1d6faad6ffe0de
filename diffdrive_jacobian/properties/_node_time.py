"""The time that a node had to react, which faults of the node and of its clock shorten."""

from __future__ import annotations

import math
from typing import Any

from rclpy.node import Node

from diffdrive_jacobian.faults import (
    ActuatorLag,
    Delay,
    Duplicate,
    Hang,
    LateService,
    Push,
    Reorder,
    Slow,
    TimeJump,
    TimerJitter,
)
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.time_units import NANOSECONDS

ROUNDING = 1e-9
"""Tolerance on times (s)."""
DECAY = 7.0
"""Time constants after which a robot whose motors lag stands still: exp(-7) is 0.001."""
_AT_ONCE = (Push, TimeJump)
"""Faults that happen once, when they begin, also if they have no end."""


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
    jumps = (fault for fault in faults if isinstance(fault, TimeJump))
    times = (time for fault in jumps for time in (fault.start, fault.start + fault.duration))
    return any(before < time * NANOSECONDS <= now for time in times)


def delays(world: Lockstep, node: Node, since: float) -> float:
    """Return by how much faults of a node may have delayed its reaction since a world time (s)."""
    name, now = node.get_fully_qualified_name(), world.world_time / NANOSECONDS
    total = 0.0
    for fault in world.faults:
        affected = getattr(fault, 'node', '') or getattr(fault, 'robot', '')
        if affected.lstrip('/') != name.lstrip('/'):
            continue
        overlap = min(now, fault.start + fault.duration) - max(since, fault.start)
        if isinstance(fault, Hang):
            total += max(overlap, 0.0)
        elif isinstance(fault, Slow):
            # A callback that has begun, others that wait, and that of the timer, which may expire early.
            longest = (3.0 + len(list(node.timers))) * fault.seconds
            total += longest if overlap > -longest else 0.0
        elif isinstance(fault, ActuatorLag):
            total += DECAY * fault.seconds if overlap > -DECAY * fault.seconds else 0.0
        elif isinstance(fault, TimerJitter) and overlap > -fault.seconds:
            total += fault.seconds
    return total


def end_of_faults(world: Lockstep) -> float:
    """Return the world time at which all faults have ended, and what they delayed has arrived (s).

    Infinite: one of them has no end. Faults of one topic may delay a message one after the other.
    """
    return max(map(_end, world.faults), default=0.0) + sum(map(_longest_delay, world.faults))


def _end(fault: Any) -> float:
    if math.isinf(fault.duration) and isinstance(fault, _AT_ONCE):
        return float(fault.start)
    return float(fault.start + fault.duration)


def _longest_delay(fault: Any) -> float:
    """Return how long something is under way at most that a fault has delayed (s)."""
    if isinstance(fault, Delay):
        # Without growth also a delay without an end has one.
        growth = fault.growth * fault.duration if fault.growth else 0.0
        return float(fault.seconds + fault.spread + growth)
    if isinstance(fault, Duplicate):
        return float(fault.copies * fault.seconds)
    if isinstance(fault, (LateService, Reorder, Slow, TimerJitter)) and math.isfinite(fault.seconds):
        return float(fault.seconds)
    return 0.0
