"""Detection of nodes in other processes that were killed or hang, within seconds.

DDS regards a participant that was killed as alive until its lease ends, 20 s with Fast DDS. A node whose
callbacks are executed answers requests. Every node of rclpy and rclcpp has a service for its parameters,
unless it was created without.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from diffdrive_jacobian.ros.rclpy_internals import on_response

PERIOD = 0.5
"""Time between two requests (s)."""
LONGEST_STEP = 0.2
"""At most so much time counts between two calls of `silence` (s)."""
PENDING = 20
"""Requests without an answer that are kept. A late answer counts as well."""


class Liveness:
    """Requests parameters of nodes periodically, and measures the time since any of them answered.

    `silence` must be called several times a second while the requesting node is spun.
    """

    def __init__(
        self,
        node: Node,
        names: Iterable[str],
        parameters: Sequence[str] = (),
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create the clients.

        Args:
            node: The node that sends the requests.
            names: Fully qualified names of the nodes that are to answer.
            parameters: Names of the parameters that are requested.
            monotonic: Returns a time that never goes back (s), in lockstep world time.
        """
        self._clients = {
            name: node.create_client(GetParameters, f'{name}/get_parameters') for name in names
        }
        self._node = node
        self._monotonic = monotonic
        self._answers: dict[str, Counter[int]] = {name: Counter() for name in self._clients}
        self._partial_silence = dict.fromkeys(self._clients, 0.0)
        self._servers = dict.fromkeys(self._clients, 0)
        self._together: set[str] = set()
        for name, client in self._clients.items():
            on_response(client, partial(self._on_response, name))
        self._parameters = tuple(parameters)
        self._pending: deque[tuple[Any, Any]] = deque()
        self._silence = 0.0
        self._answered = False
        self._updated = monotonic()
        self._requested = -math.inf
        self.values: dict[str, dict[str, Any]] = {}
        """Last values of the parameters, by node and name. Nodes that lack one of them are missing."""

    @property
    def answered(self) -> bool:
        """Whether any of the nodes has answered."""
        return self._answered

    def silence(self) -> float:
        """Return the time since any of the nodes answered (s), and send requests if they are due.

        It is 0 until the first answer: a node without the service does not count as silent. Time during
        which this process itself was held up does not count either.
        """
        now = self._monotonic()
        if self._answered:
            step = min(now - self._updated, LONGEST_STEP)
            self._silence += step
            for name in self._partial_silence:
                self._partial_silence[name] += step
        self._updated = now
        if now - self._requested >= PERIOD:
            self._requested = now
            self._request()
        return self._silence

    def partial_silence(self) -> dict[str, float]:
        """Return for how long fewer nodes of each name have answered than the graph lists (s).

        DDS lists a node that was killed beside its successor of the same name, but only one of them
        answers. It is 0 once several nodes of the name have answered the same request: they are
        different nodes, and which of them falls silent later is unknown.
        """
        return {
            name: 0.0 if name in self._together else silence
            for name, silence in self._partial_silence.items()
        }

    def _on_response(self, name: str, request: int) -> None:
        answers = self._answers[name]
        answers[request] += 1
        if answers[request] > 1:
            self._together.add(name)
        if answers[request] >= self._servers[name]:
            self._partial_silence[name] = 0.0
        while len(answers) > PENDING:
            del answers[min(answers)]

    def _request(self) -> None:
        for name, client in self._clients.items():
            servers = self._node.count_services(client.srv_name)
            if servers > self._servers[name]:
                # A new one has as long to answer as the others.
                self._partial_silence[name] = 0.0
            self._servers[name] = servers
            if client.service_is_ready():
                future = client.call_async(GetParameters.Request(names=self._parameters))
                future.add_done_callback(partial(self._on_answer, name))
                self._pending.append((client, future))
        while len(self._pending) > PENDING:
            client, future = self._pending.popleft()
            client.remove_pending_request(future)

    def _on_answer(self, name: str, future: Any) -> None:
        self._answered = True
        self._silence = 0.0
        if future.cancelled() or future.exception() is not None:
            return
        values = future.result().values
        # A node that lacks one of the parameters sends no values at all.
        if len(values) != len(self._parameters):
            return
        try:
            converted = [parameter_value_to_python(value) for value in values]
        except (RuntimeError, TypeError, ValueError):
            # A type that rclpy does not know.
            return
        self.values[name] = dict(zip(self._parameters, converted, strict=True))
