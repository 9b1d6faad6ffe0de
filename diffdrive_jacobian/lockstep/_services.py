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

"""The nodes of a world as the EventsExecutor sees them, with their services and clients.

What stands for them here (`NodeView` and so on) leaves timers and messages to the scheduler, awaits
coroutines, which the EventsExecutor of Jazzy cannot, and lets requests and responses wait at the gate of
a node.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

from rclpy.client import Client
from rclpy.event_handler import EventHandler
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Future, Task

from diffdrive_jacobian.lockstep._clock import Agenda
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._gate import Gate, send_unless_destroyed
from diffdrive_jacobian.lockstep._link import queue_depth
from diffdrive_jacobian.lockstep._tasks import Facade, Tasks
from diffdrive_jacobian.ros.rclpy_internals import ClientView, NodeView, ResponseView, ServiceView

__tracebackhide__ = True

Responded: TypeAlias = Callable[[Node, Service, Any], None]
"""Receives a node, its service, and a response, also one that a fault delays."""


class Responses:
    """The responses of all services."""

    def __init__(self, agenda: Agenda) -> None:
        """Start without delays. `agenda` is where responses wait."""
        self._agenda = agenda
        self.observers: list[Responded] = []
        """Called with each response that a node gives."""
        self._delays: list[tuple[str, int | None, Callable[[], None]]] = []

    def delay(self, service: str, late: int | None, note: Callable[[], None]) -> Callable[[], None]:
        """Delay the responses of a service, in addition to other delays. Return what ends that.

        Args:
            service: Full name of the service.
            late: The delay (ns). None: they are never sent.
            note: Called for each response.
        """
        delay = service, late, note
        self._delays.append(delay)
        return lambda: self._delays.remove(delay)

    def send(self, node: Node, service: Service, response: Any, header: Any) -> None:
        """Send a response, now or later."""
        for observe in self.observers:
            observe(node, service, response)
        delays = []
        for name, late, note in self._delays:
            if name == service.service_name:
                note()
                delays.append(late)
        if None in delays:
            return
        if total := sum(late or 0 for late in delays):
            send = partial(send_unless_destroyed, service.send_response, response, header)
            self._agenda.at(self._agenda.now + total, send)
        else:
            service.send_response(response, header)


class Member(NodeView):
    """A node of the world."""

    def __init__(
        self, node: Node, gate: Gate, tasks: Tasks, changed: Callable[[], None], responses: Responses
    ) -> None:
        """Take a node.

        Args:
            node: The node.
            gate: Its gate.
            tasks: Where its coroutines wait.
            changed: Called when the node has created or destroyed an entity.
            responses: Sends its responses.
        """
        super().__init__(node)
        self.gate = gate
        self.responses = responses
        self._tasks = tasks
        # The node itself keeps a weak reference only.
        self.facade = Facade(changed, self.create_task)
        self._wrapped: dict[Any, Any] = {}

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Schedule a function or a coroutine of the node for the current time. Return its future."""
        return self._tasks.create(self.node, self.gate, callback, args, kwargs)

    def update(self) -> None:
        """Register new services and clients."""
        known, self._wrapped = self._wrapped, {}
        for service in self.node.services:
            self._wrapped[service] = known.get(service) or _Service(service, self)
        for client in self.node.clients:
            self._wrapped[client] = known.get(client) or _Client(client, self.gate)
        self.services = [self._wrapped[service] for service in self.node.services]
        self.clients = [self._wrapped[client] for client in self.node.clients]

    def release(self) -> None:
        """Let the node leave its executor."""
        self.facade.released = True
        self.node.executor = None


def check_holdable(node: Node) -> None:
    """Raise LockstepError if a node has callbacks that cannot be held back."""
    if any(not isinstance(waitable, EventHandler) for waitable in node.waitables):
        name = node.get_fully_qualified_name()
        raise LockstepError(f'{name} has an action, which cannot be frozen or slow in lockstep')


class _Request(NamedTuple):
    """A request that waits, instead of a response."""

    request: Any
    response: Any


_IGNORED = object()
"""Instead of a response: the service was destroyed after the request had arrived."""


def _ignore(*_: Any) -> object:
    """Return no response."""
    return _IGNORED


class _Service(ServiceView):
    """A service whose callback may be a coroutine. The response is sent when it ends."""

    def __init__(self, service: Service, member: Member) -> None:
        super().__init__(service)
        self._member = member

    @property
    def callback(self) -> Callable[[Any, Any], Any]:
        """Function that returns the response of a request."""
        if self.service not in self._member.node.services:
            return _ignore
        if not self._member.gate.free:
            return _Request
        callback: Callable[[Any, Any], Any] = self.service.callback
        return callback

    def send_response(self, response: Any, header: Any) -> None:
        """Send the result of the callback."""
        member, service = self._member, self.service
        if response is _IGNORED:
            return
        if isinstance(response, _Request):
            request = response
            member.gate.enter(
                service,
                service.service_name,
                lambda: self.send_response(service.callback(*request), header),
                queue_depth(service.qos_profile),
            )
        elif inspect.iscoroutine(response):

            async def answer() -> None:
                self._send(await response, header)

            member.create_task(answer)
        else:
            self._send(response, header)

    def _send(self, response: Any, header: Any) -> None:
        member = self._member
        send = partial(member.responses.send, member.node, self.service, response, header)
        if member.gate.delays_output:
            member.gate.leave(send)
        else:
            send()


class _Client(ClientView):
    """A client. Its responses wait at the gate of its node."""

    def __init__(self, client: Client, gate: Gate) -> None:
        super().__init__(client)
        self._gate = gate
        self._latest: _Response | None = None

    def get_pending_request(self, sequence_number: int) -> Any:
        """Return the future of a request."""
        future = self.client.get_pending_request(sequence_number)
        if self._gate.free:
            return future
        # Kept, in case that the EventsExecutor holds a borrowed reference only.
        self._latest = _Response(future, self.client, self._gate)
        return self._latest


class _Response(ResponseView):
    """The future of a request. Its result waits at a gate."""

    def __init__(self, future: Future, client: Client, gate: Gate) -> None:
        super().__init__(future)
        self._client = client
        self._gate = gate

    def set_result(self, result: Any) -> None:
        """Set the result of the future."""
        client = self._client
        self._gate.enter(
            client,
            client.service_name,
            partial(self.future.set_result, result),
            queue_depth(client.qos_profile),
        )
