"""A subscription whose messages pass through stages that may lose, delay or change them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from diffdrive_jacobian.lockstep._agenda import Agenda
from diffdrive_jacobian.lockstep._deliveries import Deliveries, Reader

Stage = Callable[[bytes], Iterable[tuple[int, bytes]]]
"""Receives a serialized message, returns those that leave the stage instead, with their delays (ns)."""


class GatedReader(Reader):
    """A subscription whose messages pass through stages, one after the other.

    A stage receives each message at the simulated time at which it has left the one before.
    """

    __slots__ = ('_agenda', '_deliveries', '_ready', '_take_next', 'stages')

    def __init__(
        self, subscription: Subscription, node: Node, agenda: Agenda, deliveries: Deliveries
    ) -> None:
        """Keep the subscription of a node alive until `close`."""
        super().__init__(subscription, node, deliveries)
        self.stages: list[Stage] = []
        self._agenda = agenda
        self._deliveries = deliveries
        self._ready: deque[tuple[Any, dict[str, Any]]] = deque()
        self._take_next = self.take
        self.take = self._take

    def _take(self, message_type: type, raw: bool) -> tuple[Any, dict[str, Any]] | None:
        """Return the next message that has passed all stages, and its info. None: there is none now."""
        while not self._ready:
            if not self.stages:
                return self._take_next(message_type, raw)
            taken = self._take_next(message_type, True)
            if taken is None:
                return None
            self._pass(0, *taken)
            # The message itself has its entry among those that wait.
            self._deliveries.pending.extendleft([self] * (len(self._ready) - 1))
        return self._ready.popleft()

    def _pass(self, first: int, data: bytes, info: dict[str, Any]) -> None:
        """Pass a message through the stages from `first` on."""
        if first == len(self.stages):
            message = data if self.raw else deserialize_message(data, self.message_type)
            self._ready.append((message, info))
            return
        for delay, out in self.stages[first](data):
            if delay > 0:
                self._agenda.at(self._agenda.now + delay, partial(self._go_on, first + 1, out, info))
            else:
                self._pass(first + 1, out, info)

    def _go_on(self, first: int, data: bytes, info: dict[str, Any]) -> None:
        """Continue with a message that was delayed."""
        before = len(self._ready)
        self._pass(first, data, info)
        self._deliveries.pending.extend([self] * (len(self._ready) - before))
