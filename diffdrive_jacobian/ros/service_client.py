"""Calls of services that end after a time, with or without a response."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.task import Future

from diffdrive_jacobian.ros.rclpy_internals import reason
from diffdrive_jacobian.text import printable

OnFailure = Callable[[str], object]
"""Receives why there is no response."""


def ignore(_: str) -> None:
    """Ignore that there is no response."""


class ServiceClient:
    """A client of a service. Each call ends with a response, or with a reason why there is none."""

    def __init__(
        self,
        node: Node,
        service_type: Any,
        name: str,
        *,
        patience: float,
        server: str = 'it',
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create the client.

        Args:
            node: The node that calls.
            service_type: Type of the service.
            name: Name of the service.
            patience: Longest wait for a response (s).
            server: What does not respond, for the reasons.
            monotonic: Returns a time that never goes back (s), in lockstep world time.

        Raises:
            RuntimeError: No service can have the name.
            NameValidationException: Neither.
        """
        self._node, self._patience, self._server = node, patience, server
        self._monotonic = monotonic
        self._client = node.create_client(service_type, name)
        self._calls: dict[Future, tuple[float, OnFailure]] = {}

    @property
    def ready(self) -> bool:
        """Whether there is a server."""
        return bool(self._client.service_is_ready())

    def call(self, request: Any, on_response: Callable[[Any], object], on_failure: OnFailure) -> None:
        """Send a request.

        Args:
            request: The request.
            on_response: Called with the response.
            on_failure: Called instead if there is none in time, or none that can be read.
        """
        future = self._client.call_async(request)
        self._calls[future] = self._monotonic() + self._patience, on_failure
        future.add_done_callback(partial(self._on_done, on_response))

    def _on_done(self, on_response: Callable[[Any], object], future: Future) -> None:
        if future not in self._calls:
            # The response is too late.
            return
        _, on_failure = self._calls.pop(future)
        if future.cancelled() or future.exception() is not None:
            # The text may be that of another process.
            why = printable(reason(future.exception() or RuntimeError('canceled')))
            on_failure(f'its answer cannot be read: {why}')
        else:
            on_response(future.result())

    def advance(self) -> None:
        """End the calls that have waited too long; to be called often."""
        now = self._monotonic()
        for future in [one for one, (deadline, _) in self._calls.items() if now > deadline]:
            self._end(future, f'{self._server} did not answer within {self._patience:g} s')

    def destroy(self) -> None:
        """Destroy the client, and end its calls."""
        for future in list(self._calls):
            self._end(future, f'{self._server} is gone')
        self._node.destroy_client(self._client)

    def _end(self, future: Future, why: str) -> None:
        _, on_failure = self._calls.pop(future)
        self._client.remove_pending_request(future)
        on_failure(why)
