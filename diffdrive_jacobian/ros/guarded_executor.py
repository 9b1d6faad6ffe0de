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

"""An executor as cheap as the EventsExecutor of rclpy and as fair as its SingleThreadedExecutor.

The EventsExecutor takes less than half the CPU time. Its queue is first in, first out, and unbounded. If
messages arrive faster than they are handled, timers and services wait behind all of them, and the memory
grows. The SingleThreadedExecutor handles at most one message of each subscription before it looks at
timers and services again. Nodes run on the EventsExecutor until that hurts, and then on the
SingleThreadedExecutor until the program ends.

What hurts is measured by a task that is put into the queue from time to time. It runs after all events
that were queued before it. The nodes are moved if it waits for more than LATEST seconds, without the
longest single callback, and for more events than the nodes have timers, subscriptions, services and
clients. A slow callback alone, or one burst of many nodes, delays both executors alike.

The move loses nothing. Messages, requests and responses wait in the middleware until they are taken.
Timers keep the time of their next expiry. Futures belong to their clients. Tasks of the EventsExecutor
are executed until they are done.
"""

from __future__ import annotations

import time

from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Task

from diffdrive_jacobian.ros.rclpy_internals import requires_wait_set

LATEST = 0.02
"""Longest time that an event may wait behind others in the queue of the EventsExecutor (s)."""
SAMPLE_EVENTS = 64
"""Number of events after which the wait is measured again: a task takes as long as an event."""
SAMPLE_PERIOD = 0.1
"""Time after which it is measured again, if there are fewer events (s)."""
FEWEST = 8
"""The wait never counts if it was behind no more events than this."""
TASK_PERIOD = 0.01
"""Period at which tasks of the EventsExecutor are executed while the nodes are on the other one (s)."""


class GuardedExecutor:
    """Executes callbacks on the EventsExecutor, and after a flood on the SingleThreadedExecutor."""

    def __init__(self, context: Context, events: Executor) -> None:
        """Start without nodes.

        Args:
            context: The context of the nodes.
            events: An EventsExecutor of that context, see `rclpy_internals.events_executor`.
        """
        self._context = context
        self._events = self._executor = events
        self._nodes: list[Node] = []
        self._sample: Task | None = None
        self._sampled = self._last = time.monotonic()
        self._handled = 0
        self._longest = 0.0
        self._next_tasks = 0.0

    @property
    def fair(self) -> bool:
        """Whether the nodes are on the SingleThreadedExecutor."""
        return self._executor is not self._events

    def add_node(self, node: Node) -> None:
        """Execute the callbacks of a node from now on.

        If one of them cannot run on the EventsExecutor (a coroutine, or a subscription with message
        info), all nodes are moved to the SingleThreadedExecutor.
        """
        self._nodes.append(node)
        if requires_wait_set(node) and not self.fair:
            self.use_single_threaded()
        else:
            self._executor.add_node(node)

    def remove_node(self, node: Node) -> None:
        """Execute no more callbacks of a node."""
        self._nodes.remove(node)
        self._executor.remove_node(node)

    def shutdown(self) -> None:
        """Release the nodes."""
        self._events.shutdown()
        if self.fair:
            self._executor.shutdown()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Execute one callback; wait for it for at most a time (s).

        Raises:
            ExternalShutdownException: The context was shut down.
        """
        if self.fair:
            if time.monotonic() >= self._next_tasks:
                self._run_tasks()
            self._executor.spin_once(timeout_sec=timeout_sec)
            return
        self._events.spin_once(timeout_sec=timeout_sec)
        self._handled += 1
        now = time.monotonic()
        if self._sample is not None:
            self._check_sample(now)
        elif self._handled >= SAMPLE_EVENTS or now - self._sampled > SAMPLE_PERIOD:
            self._sample = self._events.create_task(_nothing)
            self._sampled = self._last = now
            self._handled, self._longest = 0, 0.0

    def _check_sample(self, now: float) -> None:
        """Move the nodes if the task has waited too long behind other events."""
        assert self._sample is not None
        self._longest = max(self._longest, now - self._last)
        self._last = now
        waited = now - self._sampled
        # As many events may be before the task, one of each entity.
        if waited - self._longest > LATEST and self._handled > max(
            FEWEST, sum(map(entity_count, self._nodes))
        ):
            self._nodes[0].get_logger().warning(
                f'messages or requests arrive faster than they are handled, events waited '
                f'{waited * 1e3:.0f} ms: until this program is restarted, timers and services take '
                'turns with them, which takes two to six times the CPU time'
            )
            self.use_single_threaded()
        elif self._sample.done():
            self._sample = None
            self._handled = 0

    def use_single_threaded(self) -> None:
        """Move the nodes to the SingleThreadedExecutor, where they stay."""
        # Unlike `remove_node` this takes effect at once. The executor can be used again.
        self._events.shutdown()
        self._executor = SingleThreadedExecutor(context=self._context)
        for node in self._nodes:
            self._executor.add_node(node)
        # The queue is emptied: events of entities that were released are dropped there.
        self._run_tasks()

    def _run_tasks(self) -> None:
        """Execute the tasks, such as coroutines, that are in the queue of the EventsExecutor."""
        self._next_tasks = time.monotonic() + TASK_PERIOD
        last = self._events.create_task(_nothing)
        while not last.done():
            self._events.spin_once(timeout_sec=0.0)


def _nothing() -> None:
    """Do nothing."""


def entity_count(node: Node) -> int:
    """Return the number of timers, subscriptions, services, clients and waitables of a node."""
    lists = (node.timers, node.subscriptions, node.services, node.clients, node.waitables)
    return sum(len(list(entities)) for entities in lists)
