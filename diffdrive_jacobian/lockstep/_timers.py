"""The timers of the nodes."""

from __future__ import annotations

from collections.abc import Container, Iterable

from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.timer import Timer

from diffdrive_jacobian.ros.rclpy_internals import RCLError, TimerHandle, timer_handle

Entry = tuple[TimerHandle, Timer, Node]
"""A timer of a node, with its handle."""


class Timers:
    """The timers of the nodes, in the order of their creation."""

    def __init__(self) -> None:
        """Start without timers."""
        # With their handles, whose methods take a third of the time of those of the timers.
        self._sim_timers: list[Entry] = []
        self._wall_timers: list[Entry] = []
        self._simulated: set[Timer] = set()

    def update(self, nodes: Iterable[Node], without: Container[Timer] = ()) -> None:
        """Find the timers of the nodes.

        Args:
            nodes: The nodes.
            without: Timers that do not tick.
        """
        timers = [
            (timer_handle(timer), timer, node)
            for node in nodes
            for timer in node.timers
            if timer not in without
        ]
        self._sim_timers = [pair for pair in timers if follows_sim_time(pair[1])]
        self._simulated = {timer for _, timer, _ in self._sim_timers}
        self._wall_timers = [pair for pair in timers if pair[1] not in self._simulated]

    def is_simulated(self, timer: Timer) -> bool:
        """Return whether a timer of the nodes expires by simulated time, as of the last `update`."""
        return timer in self._simulated

    def due(self) -> tuple[list[Entry], int | None]:
        """Return the due timers, the most overdue first, and the time until the next one (ns)."""
        due, until_next = [], None
        for pair in self._sim_timers:
            left = pair[0].time_until_next_call()
            if left is None:
                continue
            if left <= 0:
                due.append((left, pair))
            elif until_next is None or left < until_next:
                until_next = left
        for pair in self._wall_timers:
            left = pair[0].time_until_next_call()
            if left is not None and left <= 0:
                due.append((left, pair))
        # Sorting is stable: timers that are due at the same time stay in the order of their creation.
        due.sort(key=lambda item: item[0])
        return [pair for _, pair in due], until_next

    def most_overdue(self, node: Node) -> tuple[int, TimerHandle, Timer] | None:
        """Return the most overdue timer of a node, and for how long it has been due (ns).

        None: no timer is due.
        """
        due, _ = self.due()
        for handle, timer, owner in due:
            if owner is node and timer in self._simulated:
                return -(handle.time_until_next_call() or 0), handle, timer
        return None


def is_due(handle: TimerHandle) -> bool:
    """Return whether a timer is due."""
    try:
        left = handle.time_until_next_call()
    except RCLError:
        # A callback has destroyed the timer.
        return False
    return left is not None and left <= 0


def follows_sim_time(timer: Timer) -> bool:
    """Return whether a timer expires by simulated time, not by wall time."""
    clock = timer.clock
    return clock.clock_type == ClockType.ROS_TIME and bool(clock.ros_time_is_active)
