"""Requests to the parameter services of a node, which show that it has processed what came before."""

from __future__ import annotations

import time

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.task import Future

from diffdrive_jacobian.lockstep._external_answers import Idle

ROUNDS = 3
"""Number of requests.

When the first response is there, all that was sent before the first request has arrived. When the
second is there, the callbacks of its messages have been executed, and when the third is there, those of
the timers that the time among them has made due.
"""


class Probe:
    """Asks a node for none of its parameters."""

    def __init__(self, node: Node, declared: Idle) -> None:
        """Create a client.

        Args:
            node: Node of the client.
            declared: The node that is asked.
        """
        self.service: str = node.resolve_service_name(f'{declared.node}/get_parameters')
        self.name = self.service.removesuffix('/get_parameters')
        """Full name of the node that is asked."""
        self.within = declared.within
        self._node = node
        self._client = node.create_client(GetParameters, self.service)

    def ready(self) -> bool:
        """Return whether a request can be sent."""
        return bool(self._client.service_is_ready())

    def unready(self) -> str:
        """Return the message of the error that no request can be sent."""
        return f'the service {self.service} cannot be reached'

    def no_response(self) -> str:
        """Return the message of the error that a request is not answered."""
        return f'{self.name} has not responded to {self.service} within {self.within:g} s of wall time'

    def ask(self) -> Future:
        """Send a request. Return the future of its response."""
        return self._client.call_async(GetParameters.Request())

    def close(self) -> None:
        """Destroy the client."""
        self._node.destroy_client(self._client)


class Repeated:
    """A request that is repeated until one is answered."""

    def __init__(self, probe: Probe, period: float) -> None:
        """Send the first one.

        Args:
            probe: Sends the requests.
            period: Period of the repetition (s).
        """
        self._probe = probe
        self._period = period
        self._responses = [probe.ask()]
        self._sent = time.monotonic()

    def answered(self) -> bool:
        """Return whether any request was answered. Repeat it if it is time."""
        now = time.monotonic()
        if now - self._sent > self._period:
            self._sent = now
            self._responses.append(self._probe.ask())
        return any(response.done() for response in self._responses)
