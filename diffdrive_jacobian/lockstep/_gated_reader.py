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
from diffdrive_jacobian.lockstep._deliveries import Reader
from diffdrive_jacobian.lockstep._gates import Gate, depth_of

Stage = Callable[[bytes], Iterable[tuple[int, bytes]]]
"""Receives a serialized message, returns those that leave the stage instead, with their delays (ns)."""


class GatedReader(Reader):
    """A subscription whose messages pass through stages, one after the other.

    A stage receives each message at the simulated time at which it has left the one before.
    """

    __slots__ = ('_agenda', '_depth', '_gate', '_pending', '_ready', '_take_next', 'node', 'stages')

    def __init__(
        self,
        subscription: Subscription,
        node: Node,
        gate: Gate,
        create_task: Callable[..., Any],
        agenda: Agenda,
        pending: deque[Reader | None],
    ) -> None:
        """Keep the subscription alive until `close`.

        Args:
            subscription: The subscription.
            node: Its node.
            gate: The gate of the node.
            create_task: Called with each coroutine that the callback returns.
            agenda: What happens later.
            pending: The entries of messages that wait.
        """
        super().__init__(subscription, create_task)
        self.node = node
        self.stages: list[Stage] = []
        self._gate = gate
        self._depth = depth_of(subscription.qos_profile)
        self._agenda = agenda
        self._pending = pending
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
            self._pending.extendleft([self] * (len(self._ready) - 1))
        return self._ready.popleft()

    def accept(self) -> None:
        """Take exactly one message, and let it pass the stages."""
        if not self.stages:
            self.deliver()
        elif (taken := self._take_next(self.message_type, True)) is not None:
            before = len(self._ready)
            self._pass(0, *taken)
            self._pending.extend([self] * (len(self._ready) - before))

    def call(self, taken: tuple[Any, dict[str, Any]]) -> None:
        """Call the callback with a message, or let it wait at the gate of the node."""
        if self._gate.free:
            super().call(taken)
        else:
            self._gate.enter(self, self.topic, self._depth, partial(super().call, taken))

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
        self._pending.extend([self] * (len(self._ready) - before))
