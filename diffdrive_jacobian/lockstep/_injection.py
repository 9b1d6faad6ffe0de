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

"""One fault in a world: its time, its random numbers, its events, and what it affects.

The faults themselves are defined in `diffdrive_jacobian.faults`. A fault has a method `install`, which
says with the methods of an `Injection` what happens when it begins and when it ends.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, NamedTuple, Protocol

from rclpy.node import Node

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._fault_log import Hits, totals
from diffdrive_jacobian.lockstep._gate import Gate
from diffdrive_jacobian.lockstep._link import Link, Stage
from diffdrive_jacobian.messages.names import full_name, without_namespace
from diffdrive_jacobian.messages.topics import CLOCK
from diffdrive_jacobian.time_units import in_seconds, nanoseconds

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep._faults import Faults

Filter = Callable[[int, bytes], Iterable[tuple[int, bytes]]]
"""What a topic fault does with a message.

Receives the world time (ns since the start of the `Lockstep`) and the serialized message, while the
fault lasts. Returns the messages that arrive instead, each with its delay (ns): `[]` loses it,
`[(0, data)]` leaves it as it is. If it has these attributes:

- `observe(now, data)` is called with each message before the fault begins and after it has ended.
- `missing` is what the fault needs and has not met in any message, as a sentence; None: nothing.
"""
Begin = Callable[[random.Random, type], Filter]
"""Returns the filter of one subscription."""
Undo = Callable[[], None]
"""Ends what a fault does."""


class Fault(Protocol):
    """What lockstep needs of a fault."""

    @property
    def start(self) -> float:
        """World time at which it begins (s)."""

    @property
    def duration(self) -> float:
        """How long it lasts (s)."""

    def install(self, injection: Injection) -> None:
        """Schedule what the fault does when it begins and ends."""


class _Filtered(NamedTuple):
    """What a fault filters."""

    topic: str
    owner: str
    begin: Begin
    keeps_order: bool


class Injection:
    """What one fault does to a world. A fault calls its methods in `install`."""

    def __init__(self, world: Faults, fault: Fault, position: int, same: int, seed: int) -> None:
        """Start without effect.

        Args:
            world: What faults can do to the world.
            fault: The fault.
            position: Number of faults that were injected before.
            same: Number of equal ones among them. Random numbers depend on this, not on `position`, so
                that they stay the same when another fault is added or left out.
            seed: Seed of the random numbers.
        """
        self.world = world
        """What the fault can do."""
        self.fault = fault
        self._position = position
        self._seed = f'{seed}/{same}/{fault!r}'
        self._agenda = world.scheduler.agenda
        self.active = False
        """Whether the fault has begun and has not ended."""
        self.ended = False
        """Whether it has ended."""
        self._generators: Counter[str] = Counter()
        self._missing: str | None = None
        self._is_there: Callable[[Iterable[Node]], bool] = any
        self._begins: list[Callable[[], Undo | None]] = []
        self._ends: list[Undo] = []
        self._meetings: list[Callable[[], None]] = []
        self._filtered: _Filtered | None = None
        self._filters: list[Filter] = []
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

    def during(self, begin: Callable[[], Undo | None]) -> None:
        """Call a function when the fault begins. It returns what is called when the fault ends."""
        self._begins.append(begin)

    def _start(self) -> None:
        self.active = True
        self.note('begins')
        for begin in self._begins:
            undo = begin()
            if undo is not None:
                self._ends.append(undo)

    def end(self) -> None:
        """End the fault now. Messages that it has delayed still arrive late."""
        if self.ended:
            return
        self.active, self.ended = False, True
        for undo in self._ends:
            undo()
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
        affected = totals(self._hits)
        what = f'ends: {affected}' if affected else 'ends'
        self.world.log.add(self._position, self.fault, what, last=True)

    # --- Random numbers

    def rng(self, key: str) -> random.Random:
        """Return a generator of random numbers. Each call with the same key returns another one."""
        self._generators[key] += 1
        return random.Random(f'{self._seed}/{key}/{self._generators[key]}')

    # --- Events

    def note(self, what: str) -> None:
        """Add an event."""
        self.world.log.add(self._position, self.fault, what)

    @property
    def missing(self) -> str | None:
        """What the fault needs and has not met, as a sentence; None: nothing."""
        if self._missing is not None or not self._filters:
            return self._missing
        missing: list[str | None] = [getattr(one, 'missing', None) for one in self._filters]
        return missing[0] if all(missing) else None

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
        details = self.missing or totals(self._hits)
        return f'{state}, {details}' if details else state

    def unfinished(self) -> list[str]:
        """Return what the fault did to the latest messages, as far as there is no event of it yet."""
        return [text for hits in self._hits if (text := hits.open())]

    # --- What the fault affects

    def expect(self, missing: str, is_there: Callable[[Iterable[Node]], bool]) -> None:
        """Expect something that the fault affects.

        Args:
            missing: What to report if it never appears.
            is_there: Returns whether it is there, among nodes.
        """
        self._missing = missing
        self._is_there = is_there
        self.look()

    def when_nodes_change(self, action: Callable[[], None]) -> None:
        """Call a function whenever a node is added, or has created or destroyed an entity."""
        self._meetings.append(action)

    def look(self) -> None:
        """Check whether there is anything that the fault affects, after nodes have changed."""
        if self._missing is not None and self._is_there(self.world.scheduler.nodes):
            self._missing = None
        for action in self._meetings:
            action()

    def full_name(self, node: str) -> str:
        """Return the fully qualified name of a node, in the namespace of the test by default."""
        return absolute_name(node, self.world.node)

    def gate(self, node: str) -> Gate:
        """Return the gate of a node, which is expected to be there some time.

        Raises:
            LockstepError: It is the node of the test itself.
        """
        name = self.full_name(node)
        if name == self.world.node.get_fully_qualified_name():
            raise LockstepError(f'{self.fault!r} names the node of the test itself')
        self.expect(
            f'no node {name} was seen',
            lambda nodes: any(one.get_fully_qualified_name() == name for one in nodes),
        )
        return self.world.scheduler.gates.of(name)

    def filter_topic(
        self,
        topic: str,
        node: str,
        begin: Begin,
        *,
        keeps_order: bool = False,
    ) -> None:
        """Filter the messages of a topic.

        Args:
            topic: Name of the topic.
            node: Name of the node whose subscriptions are filtered; empty: all but observers.
            begin: Returns the filter of a subscription.
            keeps_order: Whether a message never overtakes an earlier one.

        Raises:
            LockstepError: The topic is /clock.
        """
        name = self.world.node.resolve_topic_name(topic)
        if name == CLOCK:
            raise LockstepError(
                f'{self.fault!r}: lockstep sets the clocks itself; use TimeJump or ClockPause'
            )
        owner = node and self.full_name(node)
        self._filtered = _Filtered(name, owner, begin, keeps_order)
        of = f' of {owner}' if owner else ''

        def is_there(nodes: Iterable[Node]) -> bool:
            return any(
                subscription.topic_name == name
                for one in nodes
                for subscription in one.subscriptions
                if self._concerns(one, owner)
            )

        self.expect(f'no subscription{of} of {name} was seen', is_there)

    def _concerns(self, node: Node, owner: str) -> bool:
        """Return whether the fault affects a node."""
        return bool(
            node.get_fully_qualified_name() == owner or (not owner and node not in self.world.observers)
        )

    def stage_of(self, link: Link) -> Stage | None:
        """Return the stage of the fault in a link; None: it does not affect it."""
        filtered = self._filtered
        if filtered is None or link.topic != filtered.topic:
            return None
        if not self._concerns(link.owner, filtered.owner):
            return None
        return self._stage(filtered, link.owner, link.message_type)

    def _stage(self, filtered: _Filtered, node: Node, message_type: type) -> Stage:
        topic, name = filtered.topic, node.get_fully_qualified_name()
        # The same in each namespace.
        root = self.world.node.get_namespace()
        key = f'{without_namespace(name, root)} {without_namespace(topic, root)}'
        change = filtered.begin(self.rng(key), message_type)
        self._filters.append(change)
        observe = getattr(change, 'observe', None)
        hits = Hits(f'{topic} to {name}', self.note)
        self._hits.append(hits)
        agenda, earliest = self._agenda, 0

        def stage(data: bytes) -> list[tuple[int, bytes]]:
            nonlocal earliest
            now = agenda.now
            if self.active:
                out = list(change(now, data))
            else:
                out = [(0, data)]
                if observe is not None:
                    observe(now, data)
            if filtered.keeps_order:
                out = [(max(delay, earliest - now), data) for delay, data in out]
                earliest = max([earliest, *(now + delay for delay, _ in out)])
            self._last_arrival = max([self._last_arrival, *(now + delay for delay, _ in out)])
            hits.add(now, data, out, active=self.active)
            return out

        return stage


def absolute_name(node: str, base: Node) -> str:
    """Return the fully qualified name of a node, in the namespace of another one by default."""
    return node if node.startswith('/') else full_name(base.get_namespace(), node)
