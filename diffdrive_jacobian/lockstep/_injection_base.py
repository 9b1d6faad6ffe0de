"""What every fault needs of a world: its time, its random numbers and its events."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from rclpy.node import Node

from diffdrive_jacobian.lockstep._executor import QuiescentExecutor
from diffdrive_jacobian.lockstep._fault_log import FaultLog, Hits, in_seconds, totals
from diffdrive_jacobian.lockstep._gates import Gate
from diffdrive_jacobian.lockstep._keeper import Keeper
from diffdrive_jacobian.time_units import nanoseconds


class Timed(Protocol):
    """A fault, as far as its time is concerned."""

    @property
    def start(self) -> float:
        """World time at which it begins (s)."""

    @property
    def duration(self) -> float:
        """How long it lasts (s)."""


@dataclass(frozen=True)
class World:
    """What faults do with a world.

    Attributes:
        executor: Executes the nodes.
        keeper: Keeps the gates of the nodes.
        node: Node of the test, which resolves names.
        log: Keeps the events.
        observers: Nodes that are affected only by faults that name them.
        shift_clock: Lets the clock of the nodes jump by a time (ns). Returns by how much it did.
        restartable: Returns whether the node of a name can be made again.
        restart: Makes the node of a name again.
    """

    executor: QuiescentExecutor
    keeper: Keeper
    node: Node
    log: FaultLog
    observers: set[Node]
    shift_clock: Callable[[int], int]
    restartable: Callable[[str], bool]
    restart: Callable[[str], None]

    def find(self, name: str) -> Node | None:
        """Return the node that has a fully qualified name now; None: there is none."""
        nodes = self.executor.nodes
        return next((node for node in nodes if node.get_fully_qualified_name() == name), None)

    def gate(self, name: str) -> Gate:
        """Return the gate of the node with a fully qualified name."""
        return self.keeper.gates.of(name)


class InjectionBase:
    """Time, random numbers and events of one fault."""

    def __init__(self, world: World, fault: Timed, position: int, same: int, seed: int) -> None:
        """Start without effect.

        Args:
            world: The world.
            fault: The fault.
            position: Number of faults that were injected before.
            same: Number of equal ones among them. Random numbers depend on this, not on `position`, so
                that they stay the same when another fault is added or left out.
            seed: Seed of the random numbers.
        """
        self._world = world
        self.fault = fault
        self._position = position
        self._seed = f'{seed}/{same}/{fault!r}'
        self._agenda = world.executor.agenda
        self.active = False
        """Whether the fault has begun and has not ended."""
        self.ended = False
        """Whether it has ended."""
        self._generators: Counter[str] = Counter()
        self._missing: str | None = None
        self._is_there: Callable[[Iterable[Node]], bool] = any
        self._on_start: list[Callable[[], None]] = []
        self._on_end: list[Callable[[], None]] = []
        self._hits: list[Hits] = []
        self._last_arrival = 0
        """World time at which the last message arrives that the fault has delayed (ns)."""

    # --- Time

    def schedule(self) -> None:
        """Schedule the start and the end of the fault."""
        start, duration = self.fault.start, self.fault.duration
        self._agenda.at(nanoseconds(start), self._start)
        if math.isfinite(duration):
            self._agenda.at(nanoseconds(start) + nanoseconds(duration), self.end)

    def at_start(self, action: Callable[[], None]) -> None:
        """Call a function when the fault begins."""
        self._on_start.append(action)

    def at_end(self, action: Callable[[], None]) -> None:
        """Call a function when the fault ends."""
        self._on_end.append(action)

    def _start(self) -> None:
        self.active = True
        self.note('begins')
        for action in self._on_start:
            action()

    def end(self) -> None:
        """End the fault now. Messages that it has delayed still arrive late."""
        if self.ended:
            return
        self.active, self.ended = False, True
        for action in self._on_end:
            action()
        if self._last_arrival > self._agenda.now:
            self._flush()
            self.note(f'is over, its last message arrives at {in_seconds(self._last_arrival)}')
            self._agenda.at(self._last_arrival, self._note_end)
        else:
            self._note_end()

    def _flush(self) -> None:
        for hits in self._hits:
            hits.flush()

    def _note_end(self) -> None:
        self._flush()
        affected = self.totals()
        what = f'ends: {affected}' if affected else 'ends'
        self._world.log.add(self._position, self.fault, what, last=True)

    # --- Random numbers

    def rng(self, key: str) -> random.Random:
        """Return a generator of random numbers. Each call with the same key returns another one."""
        self._generators[key] += 1
        return random.Random(f'{self._seed}/{key}/{self._generators[key]}')

    # --- Events

    def note(self, what: str) -> None:
        """Add an event."""
        self._world.log.add(self._position, self.fault, what)

    def totals(self) -> str:
        """Return how many messages were affected so far; empty: the fault affects no messages."""
        return totals(self._hits)

    def state(self) -> str:
        """Return whether the fault is active, and what it did so far."""
        if self.active:
            state = 'active'
        elif not self.ended:
            state = f'has not begun, starts at {self.fault.start:g} s'
        elif self._last_arrival > self._agenda.now:
            state = f'over, its last message arrives at {in_seconds(self._last_arrival)}'
        else:
            state = 'ended'
        details = self._missing if self._missing else self.totals()
        return f'{state}, {details}' if details else state

    def unfinished(self) -> list[str]:
        """Return what the fault did to the latest messages, as far as there is no event of it yet."""
        return [text for hits in self._hits if (text := hits.open())]

    # --- What the fault affects

    def _expect(self, missing: str, look: Callable[[Iterable[Node]], bool]) -> None:
        """Expect something that the fault affects.

        Args:
            missing: What to report if it never appears.
            look: Returns whether it is there, among nodes.
        """
        self._missing = missing
        self._is_there = look
        self.look()

    def look(self) -> None:
        """Check whether there is anything that the fault affects."""
        if self._missing is not None and self._is_there(self._world.executor.nodes):
            self._missing = None

    @property
    def missing(self) -> str | None:
        """What the fault needs and has not met, as a sentence; None: nothing."""
        return self._missing

    def ineffective(self) -> str | None:
        """Return why the fault affects nothing; None: it has met what it could affect."""
        return f'{self.fault!r}: {self._missing}' if self._missing else None


def full_name(node: str, base: Node) -> str:
    """Return the fully qualified name of a node, in the namespace of another one by default."""
    return node if node.startswith('/') else f'{base.get_namespace().rstrip("/")}/{node}'
