"""The parameters of one node: read once, followed by its parameter events, set by its service."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

from diffdrive_jacobian.recording.parameter_query import ParameterQuery
from diffdrive_jacobian.text import printable

PATIENCE = 3.0
"""Longest wait for the answer of a node (s)."""
Answer = Callable[[bool, str], None]
"""Receives whether a value was accepted, and the reason if not."""


class ParameterLink:
    """Reads and sets parameters of one node."""

    def __init__(self, node: Node, target: str) -> None:
        """Query the values.

        Args:
            node: The node that asks.
            target: Fully qualified name of the node that has the parameters.
        """
        self.target = target
        self.values: dict[str, Any] = {}
        """Values by name, as far as they are known."""
        self._node = node
        self._query = ParameterQuery(node, target, self.values.update, lambda trouble: None)
        self._client: Any = None
        self._waiting: list[tuple[float, Any, Answer]] = []

    def advance(self) -> None:
        """Ask, and check for answers that are late; to be called often."""
        self._query.advance()
        now = time.monotonic()
        late = [one for one in self._waiting if now - one[0] > PATIENCE]
        for one in late:
            self._waiting.remove(one)
            self._client.remove_pending_request(one[1])
            one[2](False, f'{printable(self.target)} did not answer within {PATIENCE:g} s')

    def destroy(self) -> None:
        """Destroy the clients. Who waits for an answer gets a refusal."""
        self._query.destroy()
        for _, _, answer in self._waiting:
            answer(False, f'{printable(self.target)} is gone')
        if self._client is not None:
            self._node.destroy_client(self._client)

    def changed(self, values: Mapping[str, Any]) -> None:
        """Take new values from a parameter event."""
        self.values.update(values)

    def set(self, name: str, value: float | str | bool, answer: Answer) -> None:
        """Set a parameter.

        Args:
            name: Name of the parameter.
            value: The value.
            answer: Called once.
        """
        if self._client is None:
            self._client = self._node.create_client(SetParameters, f'{self.target}/set_parameters')
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        future = self._client.call_async(request)
        waiting = (time.monotonic(), future, answer)
        self._waiting.append(waiting)

        def on_done(done: Any) -> None:
            if waiting not in self._waiting:
                return
            self._waiting.remove(waiting)
            if done.cancelled() or done.exception() is not None or not done.result().results:
                answer(False, 'the answer cannot be read')
                return
            result = done.result().results[0]
            if result.successful:
                self.values[name] = value
            answer(bool(result.successful), printable(result.reason, 300))

        future.add_done_callback(on_done)
