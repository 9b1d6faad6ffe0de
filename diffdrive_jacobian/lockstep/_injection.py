"""The hooks of a world for faults, which are defined elsewhere (`diffdrive_jacobian.faults`)."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from rclpy.node import Node
from rclpy.subscription import Subscription

from diffdrive_jacobian.lockstep._agenda import Agenda
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._fault_log import FaultLog
from diffdrive_jacobian.lockstep._gated_reader import GatedReader, Stage
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep._executor import QuiescentExecutor

Filter = Callable[[int, bytes], Iterable[tuple[int, bytes]]]
Begin = Callable[[random.Random, type], Filter]


class Injectable(Protocol):
    """A fault."""

    @property
    def start(self) -> float:
        """World time at which it begins (s)."""

    @property
    def duration(self) -> float:
        """How long it lasts (s)."""

    def install(self, injection: Injection) -> None:
        """Let it happen."""


class Injections:
    """All faults of a world."""

    def __init__(self, executor: QuiescentExecutor, log: FaultLog, node: Node) -> None:
        """Start without faults.

        Args:
            executor: Executes the nodes.
            log: Keeps the events.
            node: Node of the test, which resolves names.
        """
        self.executor = executor
        self.agenda: Agenda = executor.agenda
        self.log = log
        self.node = node
        self.observers: set[Node] = {node}
        """Nodes that are affected only by faults that name them."""
        self.all: list[Injection] = []

    def add(self, fault: Injectable, seed: int) -> None:
        """Inject a fault."""
        injection = Injection(self, fault, len(self.all), seed)
        self.all.append(injection)
        fault.install(injection)

    def enable(self) -> None:
        """Serve the subscriptions so that messages can be intercepted."""
        deliveries = self.executor.deliveries

        def create(subscription: Subscription, node: Node) -> GatedReader:
            reader = GatedReader(subscription, node, self.agenda, deliveries)
            for injection in self.all:
                injection.match(reader)
            return reader

        deliveries.new_reader = create
        deliveries.replace(self.executor.nodes)

    def ineffective(self) -> list[str]:
        """Return descriptions of the faults that met nothing that they could affect."""
        return [text for injection in self.all if (text := injection.unmatched())]


class Injection:
    """What one fault does to the world.

    A fault calls these methods in `install`. Actions happen when the fault begins and ends.
    """

    def __init__(self, injections: Injections, fault: Injectable, position: int, seed: int) -> None:
        """Schedule the beginning and the end of the fault."""
        self._injections = injections
        self._fault = fault
        self._seed = f'{seed}/{position}/{fault!r}'
        self._agenda = injections.agenda
        self.active = False
        """Whether the fault has begun and has not ended."""
        self._begun: Counter[str] = Counter()
        self._filter: Callable[[GatedReader], None] | None = None
        self._missing: str | None = None
        self._on_start: list[Callable[[], None]] = []
        self._on_end: list[Callable[[], None]] = []
        self._agenda.at(nanoseconds(fault.start), self._start)
        if math.isfinite(fault.duration):
            self._agenda.at(nanoseconds(fault.start) + nanoseconds(fault.duration), self._end)

    # --- Time

    def at_start(self, action: Callable[[], None]) -> None:
        """Call a function when the fault begins."""
        self._on_start.append(action)

    def at_end(self, action: Callable[[], None]) -> None:
        """Call a function when the fault ends."""
        self._on_end.append(action)

    def note(self, what: str) -> None:
        """Add an event."""
        self._injections.log.add(self._fault, what)

    def _start(self) -> None:
        self.active = True
        self.note('begins')
        for action in self._on_start:
            action()

    def _end(self) -> None:
        self.active = False
        for action in self._on_end:
            action()
        self.note('ends')

    def rng(self, key: str) -> random.Random:
        """Return a generator of random numbers. Each call with the same key returns another one."""
        self._begun[key] += 1
        return random.Random(f'{self._seed}/{key}/{self._begun[key]}')

    def unmatched(self) -> str | None:
        """Return why the fault affects nothing; None: it has met what it could affect."""
        return f'{self._fault!r}: {self._missing}' if self._missing else None

    # --- Topics

    def filter_topic(
        self,
        topic: str,
        node: str,
        begin: Begin,
        *,
        keeps_order: bool = False,
        at_publisher: bool = False,
    ) -> None:
        """Let the messages of a topic pass through a filter.

        Args:
            topic: Name of the topic.
            node: Name of the node whose subscriptions are filtered; empty: all but observers.
            begin: Returns the filter of a subscription.
            keeps_order: Whether a message never overtakes an earlier one.
            at_publisher: Whether messages are filtered when they are published, once for all.
        """
        name = self._injections.node.resolve_topic_name(topic)
        owner = node and full_name(node)
        of = f' of {owner}' if owner else ''
        self._missing = f'no subscription{of} of {name} was seen'

        def match(reader: GatedReader) -> None:
            if reader.topic != name:
                return
            if reader.node.get_fully_qualified_name() != owner and (
                owner or reader.node in self._injections.observers
            ):
                return
            self._missing = None
            reader.stages.append(self._stage(reader, begin, keeps_order))

        self._filter = match

    def match(self, reader: GatedReader) -> None:
        """Filter the messages of a subscription if they are those of the fault."""
        if self._filter is not None:
            self._filter(reader)

    def _stage(self, reader: GatedReader, begin: Begin, keeps_order: bool) -> Stage:
        rng = self.rng(f'{reader.node.get_fully_qualified_name()} {reader.topic}')
        change = begin(rng, reader.message_type)
        observe = getattr(change, 'observe', None)
        agenda, earliest = self._agenda, 0

        def stage(data: bytes) -> Sequence[tuple[int, bytes]]:
            nonlocal earliest
            now = agenda.now
            if self.active:
                out = list(change(now, data))
            else:
                out = [(0, data)]
                if observe is not None:
                    observe(now, data)
            if keeps_order:
                out = [(max(delay, earliest - now), data) for delay, data in out]
                earliest = max([earliest, *(now + delay for delay, _ in out)])
            return out

        return stage


def full_name(node: str) -> str:
    """Return the fully qualified name of a node: 'robot' is '/robot'."""
    return node if node.startswith('/') else f'/{node}'


def described_time(time: int) -> str:
    """Return a time (ns) in seconds."""
    return f'{time / NANOSECONDS:g} s'


def check_faults(faults: Iterable[Any]) -> None:
    """Raise LockstepError if one of the arguments of `inject` is no fault."""
    for fault in faults:
        if not callable(getattr(fault, 'install', None)) or isinstance(fault, type):
            raise LockstepError(f'inject takes faults, got {fault!r}')
