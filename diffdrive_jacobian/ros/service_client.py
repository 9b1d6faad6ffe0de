# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Calls of services of other processes, which may hang, and detection of those that do."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future
from rclpy.validate_full_topic_name import validate_full_topic_name

from diffdrive_jacobian.ros.rclpy_internals import on_response, reason
from diffdrive_jacobian.text import printable

OnFailure = Callable[[str], object]
"""Receives why there is no response."""

PERIOD = 0.5
"""Time between two requests of `Liveness` (s)."""
LONGEST_STEP = 0.2
"""At most so much time counts between two calls of `Liveness.silence` (s)."""
MAX_NAME = 240
"""Longest name of a service of another node for which a client is created (characters)."""
PENDING = 20
"""Requests without an answer that are kept. A late answer counts as well."""


def ignore(_: str) -> None:
    """Ignore that there is no response."""


def is_possible(name: str) -> bool:
    """Return whether a service can have this fully qualified name: that of a node may be too long."""
    try:
        validate_full_topic_name(name, is_service=True)
    except NameValidationException:
        return False
    return len(name) <= MAX_NAME


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

    def call(self, request: Any, on_answer: Callable[[Any], object], on_failure: OnFailure) -> None:
        """Send a request. `on_failure` is called if no response comes in time, or none can be read."""
        future = self._client.call_async(request)
        self._calls[future] = self._monotonic() + self._patience, on_failure
        future.add_done_callback(partial(self._on_done, on_answer))

    def _on_done(self, on_answer: Callable[[Any], object], future: Future) -> None:
        if future not in self._calls:
            # The response is too late.
            return
        _, on_failure = self._calls.pop(future)
        if future.cancelled() or future.exception() is not None:
            # The text may be that of another process.
            why = printable(reason(future.exception() or RuntimeError('canceled')))
            on_failure(f'its answer cannot be read: {why}')
        else:
            on_answer(future.result())

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


class Liveness:
    """Requests parameters of nodes periodically, and measures the time since any of them answered.

    DDS regards a participant that was killed as alive until its lease ends, 20 s with Fast DDS. A node
    whose callbacks are executed answers requests. Every node of rclpy and rclcpp has a service for its
    parameters, unless it was created without.

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
            monotonic: As for `ServiceClient`.
        """
        services = {name: f'{name}/get_parameters' for name in names}
        self._clients = {
            name: node.create_client(GetParameters, service)
            for name, service in services.items()
            if is_possible(service)
        }
        self._monotonic = monotonic
        self._responses: dict[str, Counter[int]] = {name: Counter() for name in self._clients}
        for name, client in self._clients.items():
            on_response(client, partial(self._on_response, name))
        self._parameters = tuple(parameters)
        self._pending: deque[tuple[Any, Any]] = deque()
        self._silence = 0.0
        self.answering: Counter[str] = Counter()
        """How many nodes of each name have answered the same request."""
        self._updated = monotonic()
        self._requested = -math.inf
        self.values: dict[str, dict[str, Any]] = {}
        """Last values of the parameters, by node and name. Nodes that lack one of them are missing."""

    def silence(self) -> float:
        """Return the time since any of the nodes answered (s), and send requests if they are due.

        It is 0 until the first answer: a node without the service does not count as silent. Time during
        which this process itself was held up does not count either.
        """
        now = self._monotonic()
        if self.answering:
            self._silence += min(now - self._updated, LONGEST_STEP)
        self._updated = now
        if now - self._requested >= PERIOD:
            self._requested = now
            self._request()
        return self._silence

    def _on_response(self, name: str, request: int) -> None:
        self._silence = 0.0
        responses = self._responses[name]
        responses[request] += 1
        if responses[request] > 1:
            self.answering[name] = max(self.answering[name], responses[request])
        while len(responses) > PENDING:
            del responses[min(responses)]

    def _request(self) -> None:
        for name, client in self._clients.items():
            if client.service_is_ready():
                future = client.call_async(GetParameters.Request(names=self._parameters))
                future.add_done_callback(partial(self._on_answer, name))
                self._pending.append((client, future))
        while len(self._pending) > PENDING:
            client, future = self._pending.popleft()
            client.remove_pending_request(future)

    def _on_answer(self, name: str, future: Any) -> None:
        self.answering[name] = max(self.answering[name], 1)
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
