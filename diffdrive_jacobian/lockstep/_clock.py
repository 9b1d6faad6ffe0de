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

"""Time in a world: the agenda, the clocks of the nodes, and their timers."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable
from itertools import count
from operator import itemgetter
from weakref import WeakSet

from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.lockstep._wall_time import check_timer
from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.ros.rclpy_internals import (
    RCLError,
    SimulatedClocks,
    TimerHandle,
    clock_subscription,
    subscription_counter,
    timer_handle,
)
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
        self.next: float = math.inf
        """World time of the next action (ns); infinity: there is none."""
        self._entries: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = count()

    def at(self, time: int, action: Callable[[], None]) -> None:
        """Add an action at a time (ns). One in the past is due now."""
        heapq.heappush(self._entries, (max(time, self.now), next(self._numbers), action))
        self.next = self._entries[0][0]

    def pop(self) -> Callable[[], None]:
        """Return the next action, and forget it."""
        _, _, action = heapq.heappop(self._entries)
        self.next = self._entries[0][0] if self._entries else math.inf
        return action


class Clocks:
    """Sets the clocks of the nodes directly. A message for each would double the time of a step.

    Other subscriptions to /clock receive messages.
    """

    def __init__(self, now: int) -> None:
        """Start without clocks, at a time (ns)."""
        self.now = now
        """Simulated time (ns), which the clocks show after `set`."""
        self._publisher: Publisher | None = None
        self._count_subscriptions: Callable[[], int] = lambda: 0
        self.pauses = 0
        """Number of faults because of which the clocks stand."""
        self._clocks = SimulatedClocks()
        self._replaced: set[Subscription] = set()
        self._message = Clock()

    def publish_with(self, publisher: Publisher) -> None:
        """Publish the time with a publisher of /clock."""
        self._publisher, self._count_subscriptions = publisher, subscription_counter(publisher)

    def find(self, nodes: Iterable[Node]) -> set[Subscription]:
        """Find the clocks of nodes. Return the subscriptions to /clock that are replaced.

        A clock whose topic was renamed follows that topic.
        """
        topic = self._publisher and self._publisher.topic_name
        found = {node: clock_subscription(node) for node in nodes}
        set_directly = {
            node: subscription
            for node, subscription in found.items()
            if subscription is not None and subscription.topic_name == topic
        }
        self._clocks.take(set_directly)
        self._replaced = {*set_directly.values()}
        return self._replaced

    def set(self) -> None:
        """Set the clocks to the present time, and publish it if somebody else receives it."""
        now = self.now
        self._clocks.set(now)
        if self._publisher is not None and self._count_subscriptions() > len(self._replaced):
            set_time(self._message.clock, now)
            self._publisher.publish(self._message)

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
        # Each with the method of its handle, which takes a third of the time of that of the timer.
        self._sim_timers: list[tuple[Callable[[], int | None], Entry]] = []
        self._wall_timers: list[tuple[Callable[[], int | None], Entry]] = []
        self._seen: WeakSet[Timer] = WeakSet()
        self.simulated: set[Timer] = set()
        """Those that expire by simulated time, as of the last `update`."""

    def update(self, timers: Iterable[tuple[Timer, Node]]) -> None:
        """Take the timers that may tick, each with its node."""
        self._sim_timers, self._wall_timers = [], []
        for timer, node in timers:
            handle = timer_handle(timer)
            simulated = follows_sim_time(timer)
            if timer not in self._seen:
                self._seen.add(timer)
                check_timer(timer, node, simulated=simulated)
            of_kind = self._sim_timers if simulated else self._wall_timers
            of_kind.append((handle.time_until_next_call, (handle, timer, node)))
        self.simulated = {timer for _, (_, timer, _) in self._sim_timers}

    def due(self, *, wall: bool = True) -> tuple[list[tuple[int, Entry]], float]:
        """Return the due timers, the most overdue first, each with the time until it is due (ns).

        And the time until the next one in simulated time (ns); infinity: there is none. With `wall`
        those on wall time count, too.
        """
        due: list[tuple[int, Entry]] = []
        until_next = math.inf
        for time_until, entry in self._sim_timers:
            left = time_until()
            if left is None:
                continue
            if left <= 0:
                due.append((left, entry))
            elif left < until_next:
                until_next = left
        if wall:
            for time_until, entry in self._wall_timers:
                left = time_until()
                if left is not None and left <= 0:
                    due.append((left, entry))
        if len(due) > 1:
            # Stable: timers that are due at the same time stay in the order of their creation.
            due.sort(key=itemgetter(0))
        return due, until_next

    def most_overdue(self, node: Node) -> tuple[int, TimerHandle, Timer] | None:
        """Return the most overdue timer of a node, and for how long it has been due (ns).

        None: no timer is due.
        """
        due, _ = self.due()
        for left, (handle, timer, owner) in due:
            if owner is node and timer in self.simulated:
                return -left, handle, timer
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
