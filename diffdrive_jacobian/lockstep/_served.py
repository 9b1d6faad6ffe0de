"""Wrappers of nodes and services for the EventsExecutor.

The EventsExecutor uses their attributes only, not their types. The wrappers leave timers and messages to
`QuiescentExecutor`, and await coroutines, which the EventsExecutor of Jazzy cannot.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.service import Service


class Served:
    """A node for the EventsExecutor, without timers and subscriptions."""

    timers = subscriptions = ()

    def __init__(self, node: Node, create_task: Callable[..., Any]) -> None:
        self.node = node
        self.executor: Any = None
        self.services: list[Any] = []
        self._create_task = create_task
        self._servers: dict[Any, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.node, name)

    def update(self) -> None:
        """Register new services."""
        known, self._servers = self._servers, {}
        for server in self.node.services:
            self._servers[server] = known.get(server) or _Service(server, self._create_task)
        self.services = list(self._servers.values())


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
