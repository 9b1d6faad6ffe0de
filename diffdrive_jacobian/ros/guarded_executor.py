"""An executor as cheap as the EventsExecutor of rclpy and as fair as its SingleThreadedExecutor.

The EventsExecutor takes half the CPU time. Its queue is first in, first out, and unbounded. If messages
arrive faster than they are handled, timers and services wait behind all of them, and the memory grows.
The SingleThreadedExecutor handles at most one message of each subscription before it looks at timers
and services again. Nodes run on the EventsExecutor until that hurts, and on the SingleThreadedExecutor
until it is quiet again.

What hurts is measured by a task that is put into the queue from time to time. It runs after all events
that were queued before it. The nodes are moved if it waits for more than LATEST seconds, without the
longest single callback, and for more events than the nodes have timers, subscriptions, services and
clients. A slow callback alone, or one burst of many nodes, delays both executors alike.

A move loses nothing. Messages, requests and responses wait in the middleware until they are taken.
Timers keep the time of their next expiry. Futures belong to their clients. Tasks of either executor
are executed until they are done.
"""

from __future__ import annotations

import time

from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Task

from diffdrive_jacobian.ros.rate_limit import TokenBucket
from diffdrive_jacobian.ros.rclpy_internals import (
    entity_count,
    execute_ready,
    has_tasks,
    longest_queue,
    requires_wait_set,
)

LATEST = 0.02
"""Longest time that an event may wait behind others in the queue of the EventsExecutor (s)."""
SAMPLE_EVENTS = 64
"""The wait is measured once for this many events, since a task takes as long as an event,"""
SAMPLE_PERIOD = 0.1
"""or for the events of this time, whichever comes first (s)."""
FEWEST = 8
"""The wait never counts if it was behind no more events than this."""
FIRST_HOLD = 5.0
"""Time on the SingleThreadedExecutor until nodes move back (s). It doubles if that is too early."""
LONGEST_HOLD = 60.0
"""Upper limit of that time (s). Then the nodes move back even if it is not quiet: more messages than the
SingleThreadedExecutor can handle may be fewer than the EventsExecutor can."""
QUIET = 5.0
"""An episode is over if the nodes ran on the EventsExecutor for this long (s)."""
WINDOW = 0.5
"""It is quiet if the SingleThreadedExecutor waited for half of the last time of this length (s)."""
TASK_PERIOD = 0.01
"""Period at which tasks of the EventsExecutor are executed while the nodes are on the other one (s)."""
LOG_BURST, LOG_PERIOD = 3, 60.0
"""Episodes that are logged: the first ones, then one per period (s)."""


class GuardedExecutor:
    """Executes callbacks on the EventsExecutor, and under a flood on the SingleThreadedExecutor."""

    def __init__(self, context: Context, events: Executor) -> None:
        """Start without nodes.

        Args:
            context: The context of the nodes.
            events: An EventsExecutor of that context, see `rclpy_internals.events_executor`.
        """
        self._context = context
        self._events = events
        self._single: Executor | None = None
        self._nodes: list[Node] = []
        self.fair = False
        """Whether the nodes are on the SingleThreadedExecutor."""
        self._fair_only = False
        # Whether a callback was executed in the present round of the SingleThreadedExecutor.
        self._executed = True
        self._observed = self._idle = 0.0
        # On the EventsExecutor.
        self._sample: Task | None = None
        self._sampled = self._last = time.monotonic()
        self._handled = 0
        self._longest = 0.0
        self._most: int | None = None
        # Moves.
        self.hold = FIRST_HOLD
        """Time on the SingleThreadedExecutor until the nodes move back (s)."""
        self._moved = self._next_tasks = 0.0
        self._episode = self._logged = False
        self._limit = TokenBucket(LOG_BURST, LOG_PERIOD)

    def add_node(self, node: Node) -> None:
        """Execute the callbacks of a node from now on.

        If one of them cannot run on the EventsExecutor (a coroutine, or a subscription with message
        info), all nodes stay on the SingleThreadedExecutor.
        """
        self._nodes.append(node)
        self._fair_only |= requires_wait_set(node)
        if self.fair:
            self._single_threaded().add_node(node)
        elif self._fair_only:
            self.use_single_threaded()
        if not self.fair:
            self._events.add_node(node)

    def remove_node(self, node: Node) -> None:
        """Execute no more callbacks of a node."""
        self._nodes.remove(node)
        executor = self._single_threaded() if self.fair else self._events
        executor.remove_node(node)

    def shutdown(self) -> None:
        """Release the nodes."""
        self._events.shutdown()
        if self._single is not None:
            self._single.shutdown()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Execute one callback; wait for it for at most a time (s).

        Raises:
            ExternalShutdownException: The context was shut down.
        """
        if self.fair:
            self._spin_fair(timeout_sec)
            return
        self._events.spin_once(timeout_sec=timeout_sec)
        self._handled += 1
        if self._sample is not None:
            self._check_sample(time.monotonic())
        elif self._handled >= SAMPLE_EVENTS or time.monotonic() - self._sampled > SAMPLE_PERIOD:
            self._start_sample(time.monotonic())

    # --- On the EventsExecutor

    def _start_sample(self, now: float) -> None:
        """Put a task into the queue."""
        self._sample = self._events.create_task(_nothing)
        self._sampled = self._last = now
        self._handled, self._longest, self._most = 0, 0.0, None
        if self._episode and now - self._moved > QUIET:
            self._end_episode()

    def _check_sample(self, now: float) -> None:
        """Move the nodes if the task has waited too long behind other events."""
        assert self._sample is not None
        self._longest = max(self._longest, now - self._last)
        self._last = now
        waited = now - self._sampled
        if waited - self._longest > LATEST and self._handled > self._most_events():
            self._begin_episode(waited)
            self.use_single_threaded()
        elif self._sample.done():
            self._sample = None
            self._handled = 0

    def _most_events(self) -> int:
        """Return how many events may be before the task, one of each entity."""
        if self._most is None:
            self._most = max(FEWEST, sum(map(entity_count, self._nodes)))
        return self._most

    # --- On the SingleThreadedExecutor

    def _spin_fair(self, timeout_sec: float | None) -> None:
        """Execute one callback on the SingleThreadedExecutor, or move back if it is quiet."""
        single = self._single_threaded()
        now = time.monotonic()
        if now >= self._next_tasks:
            self._next_tasks = now + TASK_PERIOD
            self._run_tasks()
        self._handled += 1
        if self._fair_only or has_tasks(single):
            # Tasks, such as coroutines that wait, are continued on this executor only.
            single.spin_once(timeout_sec=timeout_sec)
        elif execute_ready(single):
            self._executed = True
        elif self._executed:
            self._executed = False
            if now - self._moved > LONGEST_HOLD and self._renewed():
                self._use_events()
        elif now - self._moved > self.hold and self._was_quiet(now):
            self._use_events()
        else:
            single.spin_once(timeout_sec=timeout_sec)
            self._idle += time.monotonic() - now

    def _was_quiet(self, now: float) -> bool:
        """Return whether the executor waited for callbacks most of the time lately."""
        elapsed = now - self._observed
        if elapsed < WINDOW:
            return False
        quiet = self._idle > 0.5 * elapsed
        self._observed, self._idle = now, 0.0
        return quiet

    def _renewed(self) -> bool:
        """Return whether no message is left that was received before the nodes came here.

        It is true after as many rounds as the deepest queue has messages. In a round at most one
        callback of each entity is executed.
        """
        # Without entities, when all nodes were destroyed, there is no message either.
        round_size = max(1, sum(map(entity_count, self._nodes)))
        return self._handled > round_size * max(map(longest_queue, self._nodes))

    def _run_tasks(self) -> None:
        """Execute the tasks that are in the queue of the EventsExecutor."""
        last = self._events.create_task(_nothing)
        while not last.done():
            self._events.spin_once(timeout_sec=0.0)

    # --- Moves

    def _single_threaded(self) -> Executor:
        if self._single is None:
            self._single = SingleThreadedExecutor(context=self._context)
        return self._single

    def use_single_threaded(self) -> None:
        """Move the nodes to the SingleThreadedExecutor."""
        # Unlike `remove_node` this takes effect at once. The executor can be used again.
        self._events.shutdown()
        for node in self._nodes:
            self._single_threaded().add_node(node)
        self.fair, self._executed = True, True
        self._observed, self._idle = time.monotonic(), 0.0
        self._sample = self._most = None
        self._handled = 0
        self._moved = time.monotonic()
        # The queue is emptied: events of entities that were released are dropped there.
        self._run_tasks()

    def _use_events(self) -> None:
        """Move the nodes to the EventsExecutor.

        The middleware announces each message once. Those that it announced while the nodes were there
        before must have been taken, or they would stay in its queue until others arrive.
        """
        for node in self._nodes:
            # This removes it from the other executor.
            self._events.add_node(node)
        self.fair = False
        self._moved = self._sampled = time.monotonic()
        self._handled = SAMPLE_EVENTS

    # --- Episodes

    def _begin_episode(self, waited: float) -> None:
        if self._episode:
            self.hold = min(2.0 * self.hold, LONGEST_HOLD)
            return
        self._episode = True
        self._logged = self._limit.permits(time.monotonic())
        if self._logged:
            self._nodes[0].get_logger().warning(
                f'messages or requests arrive faster than they are handled, events waited '
                f'{waited * 1e3:.0f} ms: timers and services now take turns with them, which takes more '
                'CPU time'
            )

    def _end_episode(self) -> None:
        self._episode = False
        self.hold = FIRST_HOLD
        if self._logged:
            self._nodes[0].get_logger().info('all messages and requests are handled in time again')


def _nothing() -> None:
    """Do nothing."""
