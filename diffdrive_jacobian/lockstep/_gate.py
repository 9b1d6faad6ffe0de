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

"""The gates of the nodes: what goes in and out of a node is held there while it is frozen or busy."""

from __future__ import annotations

import sys
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from rclpy.exceptions import InvalidHandle
from rclpy.timer import Timer

from diffdrive_jacobian.lockstep._clock import Agenda

__tracebackhide__ = True

FREE = object()
"""Result of a callback that has done nothing, and therefore takes no time."""


class Held(NamedTuple):
    """A callback that waits at a gate."""

    since: int
    """World time of its arrival (ns)."""
    queue: Any
    """The link, service or client in whose queue it is."""
    name: str
    """Name of the queue."""
    work: Callable[[], Any]
    """Executes it."""


class Gate:
    """The gate of a node. It stays when the node is killed and made again."""

    def __init__(self, name: str, gates: Gates) -> None:
        """Start open.

        Args:
            name: Name of the node.
            gates: The gates of all nodes.
        """
        self.name = name
        self._gates = gates
        self._agenda = gates.agenda
        self.closed = False
        """Whether no callback of the node is executed."""
        self.free = True
        """Whether a callback can be executed at once, and takes no time."""
        self.costs: list[int] = []
        """Durations of a callback, to be added (ns). See `slow`."""
        self.timer_delays: list[Callable[[], int]] = []
        """Functions that return the delay of a tick (ns)."""
        self.suspended: set[Timer] = set()
        """Timers whose tick is delayed."""
        self.waiting: deque[Held] = deque()
        """Callbacks that wait, the oldest first."""
        self._lost: Counter[str] = Counter()
        self.delayed: set[Timer] = set()
        """Timers whose delay is over."""
        self._holds = 0
        self._busy = False
        self._outbox: list[Callable[[], None]] = []
        self._life = 0

    def hold(self) -> None:
        """Freeze the node."""
        self._holds += 1
        self._change()

    def release(self) -> None:
        """Continue the node."""
        self._holds -= 1
        self._change()

    def slow(self, cost: int) -> None:
        """Add a duration to each callback (ns)."""
        self.costs.append(cost)
        self._update()

    def quicken(self, cost: int) -> None:
        """Remove a duration that `slow` has added (ns)."""
        self.costs.remove(cost)
        self._update()

    def reset(self) -> None:
        """Forget what waits: the node was killed."""
        self._life += 1
        self._busy = False
        self.waiting.clear()
        self._outbox.clear()
        self._change()

    def lost(self) -> str:
        """Return what was lost from full queues since the last call; empty: nothing."""
        texts = [f'{count} of {name}' for name, count in sorted(self._lost.items())]
        self._lost.clear()
        return f'lost from full queues: {", ".join(texts)}' if texts else ''

    def _update(self) -> None:
        self.closed = self._busy or self._holds > 0
        self.free = not (self.closed or self.waiting or self.costs)

    def _change(self) -> None:
        """Note that the gate has opened or closed."""
        self._update()
        self._gates.changed(self)

    # --- In

    def enter(self, queue: Any, name: str, work: Callable[[], Any], depth: int = sys.maxsize) -> None:
        """Execute a callback, or let it wait in a queue. A full queue loses its oldest one.

        Args:
            queue: The link, service or client.
            name: Its name.
            work: Executes the callback.
            depth: Largest number of callbacks in its queue.
        """
        if not (self.closed or self.waiting):
            self.run(work)
            return
        if not self.closed:
            # Others that wait are being served, or an exception has stopped that.
            self._agenda.at(self._agenda.now, self._change)
        same = [waiting for waiting in self.waiting if waiting.queue is queue]
        if len(same) >= depth:
            self.waiting.remove(same[0])
            self._lost[name] += 1
        self.waiting.append(Held(self._agenda.now, queue, name, work))
        self._update()

    def run(self, work: Callable[[], Any]) -> Any:
        """Execute a callback, and return its result. What it sends leaves when its time is over."""
        duration = sum(self.costs)
        if not duration:
            return work()
        self._gates.running = self
        result = None
        try:
            result = work()
            return result
        finally:
            self._gates.running = None
            if result is not FREE:
                self._busy = True
                self._agenda.at(self._agenda.now + duration, partial(self._finish, self._life))
                self._change()

    def serve_next(self) -> None:
        """Execute the oldest callback that waits."""
        work = self.waiting.popleft().work
        self._update()
        self.run(work)

    def _finish(self, life: int) -> None:
        """End the time that a callback takes."""
        if life != self._life:
            return
        self._busy = False
        self._update()
        outbox, self._outbox = self._outbox, []
        for send in outbox:
            send()
        self._change()

    # --- Timers

    def may_tick(self, timer: Timer) -> bool:
        """Return whether a timer that is due ticks now. Otherwise it does later."""
        if self.closed:
            return False
        if timer in self.delayed:
            self.delayed.remove(timer)
            return True
        delay = sum(draw() for draw in self.timer_delays)
        if delay == 0:
            return True
        self.suspended.add(timer)
        self._agenda.at(self._agenda.now + delay, partial(self._resume, timer))
        self._change()
        return False

    def _resume(self, timer: Timer) -> None:
        self.suspended.discard(timer)
        self.delayed.add(timer)
        self._change()

    # --- Out

    @property
    def delays_output(self) -> bool:
        """Whether what the node sends now leaves later."""
        return self._busy or self._gates.running is self

    def leave(self, send: Callable[[], None]) -> None:
        """Send something when the time of the callback is over."""
        self._outbox.append(send)


class Gates:
    """The gates of all nodes."""

    def __init__(self, agenda: Agenda) -> None:
        """Start without gates."""
        self.agenda = agenda
        self.changed: Callable[[Gate], None] = lambda _: None
        """Called when a gate has opened or closed."""
        self.running: Gate | None = None
        """Gate of the node whose callback is being executed and takes time."""
        self._gates: dict[str, Gate] = {}

    def of(self, name: str) -> Gate:
        """Return the gate of the node with a fully qualified name."""
        if name not in self._gates:
            self._gates[name] = Gate(name, self)
        return self._gates[name]


def send_unless_destroyed(send: Callable[..., None], *args: Any) -> None:
    """Send something, unless the publisher or service was destroyed."""
    with suppress(InvalidHandle):
        send(*args)
