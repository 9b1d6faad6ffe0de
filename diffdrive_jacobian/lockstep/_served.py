"""Wrappers of nodes, services and clients for the EventsExecutor.

The EventsExecutor uses their attributes only, not their types. The wrappers leave timers and messages to
`QuiescentExecutor`, await coroutines, which the EventsExecutor of Jazzy cannot, and let requests and
responses wait at the gate of a node.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

from rclpy.client import Client
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Future

from diffdrive_jacobian.lockstep._facade import Facade
from diffdrive_jacobian.lockstep._gates import Gate, Gates, depth_of, send_unless_destroyed

Responded: TypeAlias = Callable[[Node, Service, Any], None]
"""Receives a node, its service, and a response, also one that a fault delays."""


class Served:
    """A node for the EventsExecutor, without timers, subscriptions and guard conditions."""

    timers = subscriptions = guards = ()

    def __init__(
        self,
        node: Node,
        create_task: Callable[..., Any],
        facade: Facade,
        response_observers: list[Responded],
    ) -> None:
        self.node = node
        self.response_observers = response_observers
        self.facade = facade
        self.executor: Any = None
        self.services: list[Any] = []
        self.clients: list[Any] = []
        self.gate: Gate | None = None
        """Gate of the node. None: it is always open."""
        self.gates: Gates | None = None
        self.create_task = create_task
        self._wrapped: dict[Any, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.node, name)

    def update(self) -> None:
        """Register new services and clients."""
        known, self._wrapped = self._wrapped, {}
        for service in self.node.services:
            self._wrapped[service] = known.get(service) or _Service(service, self)
        for client in self.node.clients:
            self._wrapped[client] = known.get(client) or _Client(client, self)
        self.services = [self._wrapped[service] for service in self.node.services]
        self.clients = [self._wrapped[client] for client in self.node.clients]


class _Request(NamedTuple):
    """A request that waits, instead of a response."""

    request: Any
    response: Any


_IGNORED = object()
"""Instead of a response: the service was destroyed after the request had arrived."""


def _ignore(*_: Any) -> object:
    """Return no response."""
    return _IGNORED


class _Service:
    """A service whose callback may be a coroutine. The response is sent when it ends."""

    def __init__(self, service: Service, served: Served) -> None:
        self._service = service
        self._served = served

    def __getattr__(self, name: str) -> Any:
        return getattr(self._service, name)

    @property
    def callback(self) -> Callable[[Any, Any], Any]:
        """Function that returns the response of a request.

        The EventsExecutor holds a borrowed reference only: an object that is created here would be freed
        before it is called.
        """
        if self._service not in self._served.node.services:
            return _ignore
        if self._served.gate is not None:
            return _Request
        callback: Callable[[Any, Any], Any] = self._service.callback
        return callback

    def send_response(self, response: Any, header: Any) -> None:
        """Send the result of the callback."""
        gate, service = self._served.gate, self._service
        if response is _IGNORED:
            return
        if isinstance(response, _Request) and gate is not None:
            request = response
            gate.enter(
                service,
                service.service_name,
                depth_of(service.qos_profile),
                lambda: self.send_response(service.callback(*request), header),
            )
        elif inspect.iscoroutine(response):

            async def answer() -> None:
                self._send(await response, header)

            self._served.create_task(answer)
        else:
            self._send(response, header)

    def _send(self, response: Any, header: Any) -> None:
        gate = self._served.gate
        send = partial(self._send_now, response, header)
        if gate is not None and gate.delays_output:
            gate.leave(send)
        else:
            send()

    def _send_now(self, response: Any, header: Any) -> None:
        for observe in self._served.response_observers:
            observe(self._served.node, self._service, response)
        send, gates = self._service.send_response, self._served.gates
        delay = gates.response_delay(self._service.service_name) if gates is not None else 0
        if gates is not None and delay:
            agenda = gates.agenda
            agenda.at(agenda.now + delay, partial(send_unless_destroyed, send, response, header))
        elif delay is not None:
            send(response, header)


class _Client:
    """A client. Its responses wait at the gate of its node."""

    def __init__(self, client: Client, served: Served) -> None:
        self._client = client
        self._served = served
        self._latest: _Response | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)

    def get_pending_request(self, sequence_number: int) -> Any:
        """Return the future of a request."""
        future = self._client.get_pending_request(sequence_number)
        gate = self._served.gate
        if gate is None:
            return future
        # Kept, in case that the EventsExecutor holds a borrowed reference only.
        self._latest = _Response(future, self._client, gate)
        return self._latest


class _Response:
    """The future of a request, for the EventsExecutor. Its result waits at a gate."""

    def __init__(self, future: Future, client: Client, gate: Gate) -> None:
        self._future = future
        self._client = client
        self._gate = gate

    def __getattr__(self, name: str) -> Any:
        return getattr(self._future, name)

    def set_result(self, result: Any) -> None:
        """Set the result of the future."""
        client = self._client
        set_result = partial(self._future.set_result, result)
        self._gate.enter(client, client.service_name, depth_of(client.qos_profile), set_result)
