"""A service of type std_srvs/Trigger that a page calls."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from diffdrive_jacobian.text import printable

PATIENCE = 3.0
"""Longest wait for an answer (s)."""


class TriggerLink:
    """Calls a service, and reports failures."""

    def __init__(self, node: Node, name: str) -> None:
        """Create the client.

        Args:
            node: The node that calls.
            name: Fully qualified name of the service.
        """
        self._node, self._name = node, name
        self._client = node.create_client(Trigger, name)
        self._waiting: list[tuple[float, Any, Callable[[str], None]]] = []

    def call(self, on_failure: Callable[[str], None]) -> None:
        """Call the service. `on_failure` receives the reason if it fails."""
        if not self._client.service_is_ready():
            on_failure(f'there is no service {self._name}')
            return
        future = self._client.call_async(Trigger.Request())
        waiting = (time.monotonic(), future, on_failure)
        self._waiting.append(waiting)

        def on_done(done: Any) -> None:
            if waiting not in self._waiting:
                return
            self._waiting.remove(waiting)
            if done.cancelled() or done.exception() is not None:
                on_failure('its answer cannot be read')
            elif not done.result().success:
                on_failure(printable(done.result().message, 300))

        future.add_done_callback(on_done)

    def advance(self) -> None:
        """Report answers that are late; to be called often."""
        now = time.monotonic()
        for waiting in [one for one in self._waiting if now - one[0] > PATIENCE]:
            self._waiting.remove(waiting)
            self._client.remove_pending_request(waiting[1])
            waiting[2](f'{self._name} did not answer within {PATIENCE:g} s')

    def destroy(self) -> None:
        """Destroy the client."""
        self._node.destroy_client(self._client)
