"""Nodes, subscriptions and services as the EventsExecutor gets to see them.

It asks them for attributes only, so that stand-ins can do for it what the one of Jazzy cannot: leave the
timers to others, await coroutines, and hand a message with its info over as two arguments.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer


class Served:
    """A node as the EventsExecutor sees it: without timers, and with what was registered so far."""

    def __init__(self, node: Node, create_task: Callable[..., Any]) -> None:
        self.node = node
        self.executor: Any = None
        self.timers: tuple[Timer, ...] = ()
        self.subscriptions: list[Any] = []
        self.services: list[Any] = []
        self._latecomers: list[Any] = []
        self._create_task = create_task
        self._readers: dict[Any, Any] = {}
        self._servers: dict[Any, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.node, name)

    def update(self) -> None:
        """Take over the node's subscriptions and services; those of latched topics wait."""
        known, self._readers = self._readers, {}
        for reader in self.node.subscriptions:
            self._readers[reader] = known.get(reader) or _Subscription(reader, self._create_task)
        readers = list(self._readers.values())
        new = [reader for reader in readers if reader not in self.subscriptions]
        self._latecomers = [reader for reader in new if is_latched(reader)]
        self.subscriptions = [reader for reader in readers if reader not in self._latecomers]
        known, self._servers = self._servers, {}
        for server in self.node.services:
            self._servers[server] = known.get(server) or _Service(server, self._create_task)
        self.services = list(self._servers.values())

    def admit_latched(self) -> bool:
        """Add one reader of a latched topic; False if none waits."""
        if not self._latecomers:
            return False
        self.subscriptions = [*self.subscriptions, self._latecomers.pop(0)]
        return True


class _Subscription:
    """A subscription that the EventsExecutor of Jazzy cannot serve as it is.

    It never awaits coroutines, and hands a message with its info over as one argument.
    """

    CallbackType = Subscription.CallbackType

    def __init__(self, subscription: Subscription, create_task: Callable[..., Any]) -> None:
        self._subscription = subscription
        self._create_task = create_task
        # What is asked for with every message, without a detour. The EventsExecutor only borrows the
        # callback: it must be an attribute that lasts.
        self.handle = subscription.handle
        self.msg_type, self.raw = subscription.msg_type, subscription.raw
        self.callback = self._on_message

    def __getattr__(self, name: str) -> Any:
        return getattr(self._subscription, name)

    def _on_message(self, *received: Any) -> None:
        if isinstance(received[0], tuple):
            received = received[0]
        result = self._subscription.callback(*received)
        if inspect.iscoroutine(result):
            self._create_task(result)


class _Service:
    """A service whose callback may be a coroutine: its answer is sent when that has ended."""

    def __init__(self, service: Service, create_task: Callable[..., Any]) -> None:
        self._service = service
        self._create_task = create_task

    def __getattr__(self, name: str) -> Any:
        return getattr(self._service, name)

    def send_response(self, response: Any, header: Any) -> None:
        """Send what the callback answers in the end."""
        if not inspect.iscoroutine(response):
            self._service.send_response(response, header)
            return

        async def answer() -> None:
            self._service.send_response(await response, header)

        self._create_task(answer)


def is_latched(endpoint: Any) -> bool:
    return bool(endpoint.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)
