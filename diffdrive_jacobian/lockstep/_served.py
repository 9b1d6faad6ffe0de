"""Wrappers of nodes, subscriptions and services for the EventsExecutor.

The EventsExecutor uses their attributes only, not their types. The wrappers add what that of Jazzy
cannot
do: to leave timers to another executor, to await coroutines, and to pass a message and its info as two
arguments.
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
    """A node for the EventsExecutor, without timers and with the entities that are registered."""

    def __init__(self, node: Node, create_task: Callable[..., Any]) -> None:
        self.node = node
        self.executor: Any = None
        self.timers: tuple[Timer, ...] = ()
        self.subscriptions: list[Any] = []
        self.services: list[Any] = []
        self._latched: list[Any] = []
        self._create_task = create_task
        self._readers: dict[Any, Any] = {}
        self._servers: dict[Any, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.node, name)

    def update(self) -> None:
        """Register new subscriptions and services, except subscriptions of latched topics."""
        known, self._readers = self._readers, {}
        for reader in self.node.subscriptions:
            self._readers[reader] = known.get(reader) or _Subscription(reader, self._create_task)
        readers = list(self._readers.values())
        new = [reader for reader in readers if reader not in self.subscriptions]
        self._latched = [reader for reader in new if is_latched(reader)]
        self.subscriptions = [reader for reader in readers if reader not in self._latched]
        known, self._servers = self._servers, {}
        for server in self.node.services:
            self._servers[server] = known.get(server) or _Service(server, self._create_task)
        self.services = list(self._servers.values())

    def admit_latched(self) -> bool:
        """Register one subscription of a latched topic. Return False if there is none."""
        if not self._latched:
            return False
        self.subscriptions = [*self.subscriptions, self._latched.pop(0)]
        return True


class _Subscription:
    """A subscription for the EventsExecutor.

    That of Jazzy does not await coroutines, and passes a message and its info as one argument.
    """

    CallbackType = Subscription.CallbackType

    def __init__(self, subscription: Subscription, create_task: Callable[..., Any]) -> None:
        self._subscription = subscription
        self._create_task = create_task
        # Attributes that are accessed for each message. The EventsExecutor holds no reference to the
        # callback, so it must be an attribute.
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
    """A service whose callback may be a coroutine. The response is sent when it ends."""

    def __init__(self, service: Service, create_task: Callable[..., Any]) -> None:
        self._service = service
        self._create_task = create_task

    def __getattr__(self, name: str) -> Any:
        return getattr(self._service, name)

    def send_response(self, response: Any, header: Any) -> None:
        """Send the result of the callback."""
        if not inspect.iscoroutine(response):
            self._service.send_response(response, header)
            return

        async def answer() -> None:
            self._service.send_response(await response, header)

        self._create_task(answer)


def is_latched(endpoint: Any) -> bool:
    """Return whether a publisher or subscription is transient local."""
    return bool(endpoint.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)
