"""Time in a world: the agenda, the clocks of the nodes, and their timers."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable
from itertools import count

from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.time import Time
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.ros.rclpy_internals import RCLError, SimulatedClock, TimerHandle, timer_handle
from diffdrive_jacobian.time_units import NANOSECONDS

MAX_SECONDS = 2**31 - 1
"""Largest time that fits into a stamp (s)."""
Entry = tuple[TimerHandle, Timer, Node]
"""A timer of a node, with its handle."""


class Agenda:
    """Actions at future times, ordered by their time, and by the order in which they were added.

    Messages that arrive late, faults that begin and end. Their time is world time: it starts at 0, and
    always advances, whatever the clocks of the nodes show.
    """

    def __init__(self) -> None:
        """Start without actions."""
        self.now = 0
        """World time (ns)."""
        self._entries: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = count()

    def at(self, time: int, action: Callable[[], None]) -> None:
        """Add an action at a time (ns). One in the past is due now."""
        heapq.heappush(self._entries, (max(time, self.now), next(self._numbers), action))

    def until_next(self) -> int | None:
        """Return the time until the next action (ns); None: there is none."""
        return self._entries[0][0] - self.now if self._entries else None

    def pop_due(self) -> Callable[[], None] | None:
        """Return the next action that is due, and forget it; None: there is none."""
        if self._entries and self._entries[0][0] <= self.now:
            return heapq.heappop(self._entries)[2]
        return None


class Clocks:
    """Sets the clocks of the nodes directly. A message for each would double the time of a step.

    Other subscriptions to /clock receive messages.
    """

    def __init__(self, now: int) -> None:
        """Start without clocks, at a time (ns)."""
        self.now = now
        """Simulated time (ns), which the clocks show after `set`."""
        self.publisher: Publisher | None = None
        """Publisher of /clock."""
        self.pauses = 0
        """Number of faults because of which the clocks stand."""
        self._clocks: list[SimulatedClock] = []
        self._message = Clock()

    def find(self, nodes: Iterable[Node]) -> set[Subscription]:
        """Find the clocks of nodes. Return the subscriptions to /clock that are replaced.

        A clock whose topic was renamed follows that topic.
        """
        topic = self.publisher and self.publisher.topic_name
        replaced = set()
        self._clocks = []
        for node in nodes:
            clock = SimulatedClock(node)
            if clock.subscription is not None and clock.subscription.topic_name == topic:
                self._clocks.append(clock)
                replaced.add(clock.subscription)
        return replaced

    def set(self) -> None:
        """Set the clocks to the present time, and publish it if somebody else receives it."""
        now = self.now
        time = Time(nanoseconds=now, clock_type=ClockType.ROS_TIME)
        for clock in self._clocks:
            clock.set(time)
        if self.publisher is not None and self.publisher.get_subscription_count() > len(self._clocks):
            set_time(self._message.clock, now)
            self.publisher.publish(self._message)

    def shift(self, duration: int) -> int:
        """Shift the clocks (ns). Return the difference that was applied (ns).

        The new time is one that a stamp can represent.
        """
        before = self.now
        self.now = min(max(1, before + duration), MAX_SECONDS * NANOSECONDS)
        self.set()
        return self.now - before


class Timers:
    """The timers of the nodes, in the order of their creation."""

    def __init__(self) -> None:
        """Start without timers."""
        # With their handles, whose methods take a third of the time of those of the timers.
        self._sim_timers: list[Entry] = []
        self._wall_timers: list[Entry] = []
        self._simulated: set[Timer] = set()

    def update(self, timers: Iterable[tuple[Timer, Node]]) -> None:
        """Take the timers that may tick, each with its node."""
        entries = [(timer_handle(timer), timer, node) for timer, node in timers]
        self._sim_timers = [entry for entry in entries if follows_sim_time(entry[1])]
        self._simulated = {timer for _, timer, _ in self._sim_timers}
        self._wall_timers = [entry for entry in entries if entry[1] not in self._simulated]

    def is_simulated(self, timer: Timer) -> bool:
        """Return whether a timer of the nodes expires by simulated time, as of the last `update`."""
        return timer in self._simulated

    def due(self) -> tuple[list[Entry], int | None]:
        """Return the due timers, the most overdue first, and the time until the next one (ns)."""
        due, until_next = [], None
        for entry in self._sim_timers:
            left = entry[0].time_until_next_call()
            if left is None:
                continue
            if left <= 0:
                due.append((left, entry))
            elif until_next is None or left < until_next:
                until_next = left
        for entry in self._wall_timers:
            left = entry[0].time_until_next_call()
            if left is not None and left <= 0:
                due.append((left, entry))
        # Sorting is stable: timers that are due at the same time stay in the order of their creation.
        due.sort(key=lambda item: item[0])
        return [entry for _, entry in due], until_next

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
