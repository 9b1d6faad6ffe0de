"""Faults of topics: filters in front of subscriptions, or behind publishers."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from rclpy.node import Node

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._fault_log import Hits
from diffdrive_jacobian.lockstep._gated_reader import GatedReader, Stage
from diffdrive_jacobian.lockstep._injection_base import InjectionBase, full_name
from diffdrive_jacobian.messages.topics import CLOCK

"""Topic whose messages lockstep replaces."""
Filter = Callable[[int, bytes], Iterable[tuple[int, bytes]]]
"""Receives a world time (ns) and a message, returns messages with their delays (ns)."""
Begin = Callable[[random.Random, type], Filter]
"""Returns the filter of one subscription."""


class _Filtered(NamedTuple):
    """What a fault filters."""

    topic: str
    owner: str
    begin: Begin
    keeps_order: bool
    at_publisher: bool


class TopicInjection(InjectionBase):
    """Filters of messages."""

    _filtered: _Filtered | None = None

    def filter_topic(
        self,
        topic: str,
        node: str,
        begin: Begin,
        *,
        keeps_order: bool = False,
        at_publisher: bool = False,
    ) -> None:
        """Filter the messages of a topic.

        Args:
            topic: Name of the topic.
            node: Name of the node whose subscriptions are filtered; empty: all but observers.
            begin: Returns the filter of a subscription.
            keeps_order: Whether a message never overtakes an earlier one.
            at_publisher: Whether messages are filtered when they are published, once for all.
        """
        name = self._world.node.resolve_topic_name(topic)
        if name == CLOCK:
            raise LockstepError(
                f'{self.fault!r}: lockstep sets the clocks itself; use TimeJump or ClockPause'
            )
        owner = node and full_name(node, self._world.node)
        self._filtered = _Filtered(name, owner, begin, keeps_order, at_publisher)
        kind, of = 'publisher' if at_publisher else 'subscription', f' of {owner}' if owner else ''

        def look(nodes: Iterable[Node]) -> bool:
            return any(
                endpoint.topic_name == name
                for one in nodes
                for endpoint in (one.publishers if at_publisher else one.subscriptions)
                if self._concerns(one, owner)
            )

        self._expect(f'no {kind}{of} of {name} was seen', look)

    def _concerns(self, node: Node, owner: str) -> bool:
        """Return whether the fault affects a node."""
        return bool(
            node.get_fully_qualified_name() == owner or (not owner and node not in self._world.observers)
        )

    def filter_reader(self, reader: GatedReader) -> None:
        """Filter the messages of a subscription, if they are those of the fault."""
        filtered = self._filtered
        if filtered is None or filtered.at_publisher or reader.topic != filtered.topic:
            return
        if self._concerns(reader.node, filtered.owner):
            reader.stages.append(self._stage(reader.node, reader.message_type))

    def publisher_stage(self, node: Node | None, publisher: Any) -> Stage | None:
        """Return the filter of the messages of a publisher; None: they are not those of the fault."""
        filtered = self._filtered
        if filtered is None or not filtered.at_publisher or node is None:
            return None
        if publisher.topic_name != filtered.topic or not self._concerns(node, filtered.owner):
            return None
        return self._stage(node, publisher.msg_type)

    def _stage(self, node: Node, message_type: type) -> Stage:
        assert self._filtered is not None
        topic, _, begin, keeps_order, at_publisher = self._filtered
        name = node.get_fully_qualified_name()
        change = begin(self.rng(f'{name} {topic}'), message_type)
        observe = getattr(change, 'observe', None)
        hits = Hits(f'{topic} {"from" if at_publisher else "to"} {name}', self.note)
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
            if keeps_order:
                out = [(max(delay, earliest - now), data) for delay, data in out]
                earliest = max([earliest, *(now + delay for delay, _ in out)])
            self._last_arrival = max([self._last_arrival, *(now + delay for delay, _ in out)])
            hits.add(now, data, out, active=self.active)
            return out

        return stage
