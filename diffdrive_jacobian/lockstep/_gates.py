"""The gates of the nodes: what goes in and out of a node is held there while it is frozen or busy."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from rclpy.exceptions import InvalidHandle
from rclpy.qos import HistoryPolicy, QoSProfile
from rclpy.timer import Timer

from diffdrive_jacobian.lockstep._agenda import Agenda


class Waiting(NamedTuple):
    """A callback that waits at a gate."""

    since: int
    """World time of its arrival (ns)."""
    queue: Any
    """The subscription, service or client in whose queue it is."""
    name: str
    """Name of the queue."""
    work: Callable[[], Any]
    """Executes it."""


@dataclass(eq=False)
class Change:
    """A parameter that a fault has changed."""

    node: Any
    name: str
    before: Any
    """Value before the change."""


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
        self._changed = gates.changed
        self.costs: list[int] = []
        """Durations of a callback, to be added (ns)."""
        self.timer_delays: list[Callable[[], int]] = []
        """Functions that return the delay of a tick (ns)."""
        self.waiting: deque[Waiting] = deque()
        """Callbacks that wait, the oldest first."""
        self.lost: Counter[str] = Counter()
        """Number of messages and requests that were lost from full queues, by name."""
        self.changes: list[Change] = []
        """Parameters that are changed now, the earliest change first."""
        self.deaths = 0
        """Number of faults because of which the node is not there."""
        self._holds = 0
        self._busy = False
        self._outbox: list[Callable[[], None]] = []
        self._life = 0

    @property
    def closed(self) -> bool:
        """Whether no callback of the node is executed."""
        return self._busy or self._holds > 0

    @property
    def free(self) -> bool:
        """Whether a callback can be executed at once, and takes no time."""
        return not (self.waiting or self.costs or self._busy or self._holds)

    def hold(self) -> None:
        """Freeze the node."""
        self._holds += 1
        self._changed(self)

    def release(self) -> None:
        """Continue the node."""
        self._holds -= 1
        self._changed(self)

    def reset(self) -> None:
        """Forget what waits: the node was killed."""
        self._life += 1
        self._busy = False
        self.waiting.clear()
        self._outbox.clear()
        self._changed(self)

    # --- In

    def enter(self, queue: Any, name: str, depth: int | None, work: Callable[[], Any]) -> None:
        """Execute a callback, or let it wait in a queue. A full queue loses its oldest one.

        Args:
            queue: The subscription, service or client.
            name: Its name.
            depth: Largest number of callbacks in its queue; None: there is no limit.
            work: Executes the callback.
        """
        if not (self.closed or self.waiting):
            self.run(work)
            return
        if not self.closed:
            # Others that wait are being served, or an exception has stopped that.
            self._agenda.at(self._agenda.now, partial(self._changed, self))
        same = [waiting for waiting in self.waiting if waiting.queue is queue]
        if depth is not None and len(same) >= depth:
            self.waiting.remove(same[0])
            self.lost[name] += 1
        self.waiting.append(Waiting(self._agenda.now, queue, name, work))

    def run(self, work: Callable[[], Any]) -> Any:
        """Execute a callback, and return its result. What it sends leaves when its time is over."""
        duration = sum(self.costs)
        if not duration:
            return work()
        self._gates.running = self
        try:
            return work()
        finally:
            self._gates.running = None
            self._busy = True
            self._agenda.at(self._agenda.now + duration, partial(self._finish, self._life))
            self._changed(self)

    def serve_next(self) -> None:
        """Execute the oldest callback that waits."""
        self.run(self.waiting.popleft().work)

    def _finish(self, life: int) -> None:
        """End the time that a callback takes."""
        if life != self._life:
            return
        self._busy = False
        self._flush()
        self._changed(self)

    # --- Out

    @property
    def delays_output(self) -> bool:
        """Whether what the node sends now leaves later."""
        return self._busy or self._gates.running is self

    def leave(self, send: Callable[[], None]) -> None:
        """Send something when the time of the callback is over."""
        self._outbox.append(send)

    def _flush(self) -> None:
        outbox, self._outbox = self._outbox, []
        for send in outbox:
            send()


class ResponseDelay(NamedTuple):
    """A delay of the responses of a service."""

    service: str
    delay: int | None
    """Delay (ns). None: they are never sent."""
    note: Callable[[], None]
    """Called for each response."""


class Gates:
    """The gates of all nodes."""

    def __init__(self, agenda: Agenda, changed: Callable[[Gate], None]) -> None:
        """Start without gates. `changed` is called when one has opened or closed."""
        self.agenda = agenda
        self.changed = changed
        self.running: Gate | None = None
        """Gate of the node whose callback is being executed and takes time."""
        self._gates: dict[str, Gate] = {}
        self.response_delays: list[ResponseDelay] = []
        """Delays of services, to be added."""
        self.suspended: set[Timer] = set()
        """Timers whose tick is delayed."""
        self._delayed: set[Timer] = set()

    def of(self, name: str) -> Gate:
        """Return the gate of the node with a fully qualified name."""
        if name not in self._gates:
            self._gates[name] = Gate(name, self)
        return self._gates[name]

    def response_delay(self, service: str) -> int | None:
        """Return the delay of a response of a service (ns); None: it is never sent."""
        delays = []
        for name, delay, note in self.response_delays:
            if name == service:
                note()
                delays.append(delay)
        return None if None in delays else sum(delay or 0 for delay in delays)

    # --- Timers

    def may_tick(self, gate: Gate, timer: Timer) -> bool:
        """Return whether a timer that is due ticks now. Otherwise it does later."""
        if gate.closed:
            return False
        if timer in self._delayed:
            self._delayed.remove(timer)
            return True
        delay = sum(draw() for draw in gate.timer_delays)
        if delay == 0:
            return True
        self.suspended.add(timer)
        self.agenda.at(self.agenda.now + delay, partial(self._resume, gate, timer))
        self.changed(gate)
        return False

    def _resume(self, gate: Gate, timer: Timer) -> None:
        self.suspended.discard(timer)
        self._delayed.add(timer)
        self.changed(gate)


def depth_of(profile: QoSProfile) -> int | None:
    """Return the depth of a queue; None: it has no limit."""
    return None if profile.history == HistoryPolicy.KEEP_ALL else max(1, profile.depth)


def send_unless_destroyed(send: Callable[..., None], *args: Any) -> None:
    """Send something, unless the publisher or service was destroyed."""
    with suppress(InvalidHandle):
        send(*args)
