"""What passes between a process and the world: topics and services, one relay each.

A relay has two ends, in the ROS domain of the process and at the node that stands in the world for the
one of the process. Messages pass as bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

from diffdrive_jacobian.lockstep._link import Stage, is_latched
from diffdrive_jacobian.lockstep.external.graph import reliable
from diffdrive_jacobian.ros.rclpy_internals import (
    message_taker,
    raw_sender,
    send_request,
    send_response,
    take_request,
    take_response,
)

DEPTH = 1000
"""Queue size in the domain of the process: the number of messages of a topic at one simulated time."""


QUEUE = 10
"""Queue size of a client."""


class Arrived(NamedTuple):
    """What a process has sent."""

    what: str
    """As in 'published /cmd_vel'."""
    latched: bool
    """Whether it is a message for later subscriptions, too."""
    forward: Callable[[], object]
    """Sends it to the world."""


Deliver = Callable[[Callable[[], object]], None]
"""Gives the process the time, calls a function that sends something, and forwards what it sends then."""


class FromTopic:
    """A topic that a node of the process publishes."""

    def __init__(self, outside: Node, inside: Node, topic: str, kind: Any, profile: QoSProfile) -> None:
        """Subscribe in the domain of the process.

        Args:
            outside: Node in the domain of the process.
            inside: The node of the world.
            topic: Name of the topic.
            kind: Type of its messages.
            profile: Quality of service that the process offers.
        """
        self.topic = topic
        self._kind = kind
        self._inside = inside
        self._subscription = outside.create_subscription(kind, topic, _nothing, profile, raw=True)
        self._take, self._release = message_taker(self._subscription)
        self._publisher = inside.create_publisher(kind, topic, profile)
        self.sent: Counter[bytes] = Counter()
        """What the world has sent to the process on this topic, which arrives here, too."""

    def take(self) -> Iterator[Arrived]:
        """Yield what has arrived."""
        latched = is_latched(self._subscription)
        while (taken := self._take(self._kind, True)) is not None:
            data = taken[0]
            if _remove(self.sent, data):
                continue
            yield Arrived(f'published {self.topic}', latched, partial(self._publisher.publish, data))

    def is_matched(self) -> bool:
        """Return whether the publisher of the process was discovered."""
        return bool(self._subscription.get_publisher_count() > 0)

    def close(self) -> None:
        """Let the subscription be destroyed."""
        self._release()


class ToTopic:
    """A topic to which a node of the process is subscribed."""

    def __init__(
        self,
        outside: Node,
        inside: Node,
        topic: str,
        kind: Any,
        profile: QoSProfile,
        deliver: Deliver,
    ) -> None:
        """Publish in the domain of the process, and subscribe in the world.

        Args:
            outside: Node in the domain of the process.
            inside: The node of the world.
            topic: Name of the topic.
            kind: Type of its messages.
            profile: Quality of service that the process requests.
            deliver: Delivers a message.
        """
        self.topic = topic
        self._publisher = outside.create_publisher(kind, topic, reliable(profile))
        self._send = raw_sender(self._publisher)
        self.back: FromTopic | None = None
        """The same topic in the other direction."""

        def receive(data: bytes) -> None:
            deliver(partial(self._send_once, data))

        self._subscription = inside.create_subscription(kind, topic, receive, profile, raw=True)

    def _send_once(self, data: bytes) -> None:
        if self.back is not None:
            self.back.sent[data] += 1
        self._send(data)

    def take(self) -> Iterator[Arrived]:
        """Yield nothing."""
        yield from ()

    def is_matched(self) -> bool:
        """Return whether the subscription of the process was discovered."""
        return bool(self._publisher.get_subscription_count() > 0)

    def close(self) -> None:
        """Do nothing."""


class OfferedService:
    """A service of a node of the process."""

    def __init__(self, outside: Node, inside: Node, name: str, kind: Any, deliver: Deliver) -> None:
        """Offer it in the world.

        Args:
            outside: Node in the domain of the process.
            inside: The node of the world.
            name: Name of the service.
            kind: Its type.
            deliver: Delivers a request.
        """
        self.name = name
        self._deliver = deliver
        self.client = outside.create_client(kind, name)
        self._asked: dict[int, Future] = {}
        inside.create_service(kind, name, self._on_request)

    def _on_request(self, request: Any, _: Any) -> Any:
        """Return the response, or a coroutine that does if it does not come at once."""
        numbers: list[int] = []
        future = Future()

        def send() -> None:
            numbers.append(send_request(self.client, request))
            self._asked[numbers[0]] = future

        self._deliver(send)
        return future.result() if future.done() else _wait_for(future)

    def take(self) -> Iterator[Arrived]:
        """Yield the responses that have arrived.

        Those to other clients are in the queue, too. They are taken like none.
        """
        misses = 0
        while self._asked and misses <= QUEUE:
            if (taken := take_response(self.client)) is None:
                misses += 1
                continue
            number, response = taken
            if (future := self._asked.pop(number, None)) is not None:
                yield Arrived(f'answered {self.name}', False, partial(future.set_result, response))

    def is_matched(self) -> bool:
        """Return whether the service was discovered."""
        return bool(self.client.service_is_ready())

    def close(self) -> None:
        """Do nothing."""


class CalledService:
    """A service of the world that a node of the process calls."""

    def __init__(self, outside: Node, inside: Node, name: str, kind: Any, deliver: Deliver) -> None:
        """Offer it in the domain of the process.

        Args:
            outside: Node in the domain of the process.
            inside: The node of the world.
            name: Name of the service.
            kind: Its type.
            deliver: Delivers a response.
        """
        self.name = name
        self._deliver = deliver
        self._inside = inside
        self._service = outside.create_service(kind, name, _nothing)
        self._client = inside.create_client(kind, name)

    def take(self) -> Iterator[Arrived]:
        """Yield the requests that have arrived."""
        while (taken := take_request(self._service)) is not None:
            yield Arrived(f'called {self.name}', False, partial(self._forward, *taken))

    def _forward(self, request: Any, header: Any) -> None:
        def answer(future: Future) -> None:
            # As a task, so that its errors are raised.
            send = partial(send_response, self._service, future.result(), header)
            self._inside.executor.create_task(self._deliver, send)

        self._client.call_async(request).add_done_callback(answer)

    def is_matched(self) -> bool:
        """Return True: a server does not know its clients."""
        return True

    def close(self) -> None:
        """Do nothing."""


Relay = FromTopic | ToTopic | OfferedService | CalledService


def _remove(messages: Counter[bytes], data: bytes) -> bool:
    """Remove a message once. Return whether it was there."""
    if not messages or messages[data] == 0:
        return False
    messages[data] -= 1
    if messages[data] == 0:
        del messages[data]
    return True


async def _wait_for(future: Future) -> Any:
    return await future


def _nothing(*_: Any) -> None:
    """Do nothing: the queues are read directly."""


def without_echo(
    published: Callable[[Callable[[Any, Any], None]], None], own: Callable[[Any], bool]
) -> Stage:
    """Return a stage that drops what the process itself has published.

    It has received that directly, in its domain.

    Args:
        published: Lets a function observe what is published on the topic.
        own: Returns whether a publisher is one of the process.
    """
    echoes: Counter[bytes] = Counter()

    def note(publisher: Any, message: Any) -> None:
        if own(publisher):
            echoes[bytes(message)] += 1

    def stage(data: bytes) -> list[tuple[int, bytes]]:
        return [] if _remove(echoes, data) else [(0, data)]

    published(note)
    return stage
