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

"""What passes between a process and the world: topics and services, one relay each.

A relay has two ends, in the ROS domain of the process (`outside`) and at the node that stands in the
world for the one of the process (`inside`). Messages pass as bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from rclpy.client import Client
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._link import is_latched
from diffdrive_jacobian.ros.rclpy_internals import (
    lost_messages,
    message_taker,
    raw_sender,
    send_request,
    send_response,
    take_request,
    take_response,
)

DEPTH = 1000
"""Queue size in the domain of the process: the number of messages of a topic at one simulated time."""
CALLS = QoSProfile(depth=DEPTH)
"""Quality of service of services and clients."""
MISSES = 100
"""Largest number of responses to others that are passed over at once."""
ONE_DATAGRAM = 60_000
"""Size up to which a message is sent in one datagram (bytes)."""
TOPIC, INPUT, SERVICE, CALL = range(4)
"""What a relay passes, of the process: what it publishes, receives, offers, and calls."""


class Arrived(NamedTuple):
    """What a process has sent."""

    what: str
    """As in 'published /cmd_vel'."""
    lasting: bool
    """Whether it counts if it was sent before the process took part: a latched message, a request."""
    forward: Callable[[], object]
    """Sends it to the world."""


Deliver = Callable[[Callable[[], object]], None]
"""Gives the process the time, calls a function that sends something, and forwards what it sends then."""


@dataclass(frozen=True)
class Relay:
    """A topic or a service in one direction.

    Attributes:
        is_matched: Returns whether the world has discovered the other end.
        take: Yields what has arrived from the process.
        close: Called at the end.
        client: Client of a service of the process.
    """

    is_matched: Callable[[], object]
    take: Callable[[], Iterator[Arrived]] = lambda: iter(())
    close: Callable[[], None] = lambda: None
    client: Client | None = None


def from_topic(
    outside: Node,
    inside: Node,
    name: str,
    kind: Any,
    topic: str,
    profile: QoSProfile,
    sent: list[bytes],
) -> Relay:
    """Return the relay of a topic that a node of the process publishes with this profile.

    Args:
        outside: Node in the domain of the process.
        inside: The node of the world.
        name: Name of the topic in that domain.
        kind: Type of its messages.
        topic: Name of the topic in the world.
        profile: Quality of service that the process offers.
        sent: What the world sends to the process now. That arrives here, too, and is not forwarded.
    """
    events = SubscriptionEventCallbacks(message_lost=_nothing, use_default_callbacks=False)
    subscription = outside.create_subscription(
        kind, name, _nothing, profile, raw=True, event_callbacks=events
    )
    may_lose = profile.reliability == ReliabilityPolicy.BEST_EFFORT
    take_next, release = message_taker(subscription)
    publisher = inside.create_publisher(kind, topic, profile)

    def take() -> Iterator[Arrived]:
        lasting = is_latched(subscription)
        number = 0
        while (taken := take_next(kind, True)) is not None:
            number += 1
            if number == DEPTH:
                raise LockstepError(
                    f'more than {DEPTH - 1} messages were published on {topic} at once: lockstep does '
                    'not receive more without loss'
                )
            data = taken[0]
            if data in sent:
                sent.remove(data)
            else:
                yield Arrived(f'published {topic}', lasting, partial(publisher.publish, data))
        if number and may_lose and lost_messages(subscription):
            raise LockstepError(
                f'messages on {topic} were lost: several were published at once, with best effort'
            )

    return Relay(subscription.get_publisher_count, take, release)


def to_topic(
    outside: Node,
    inside: Node,
    name: str,
    kind: Any,
    topic: str,
    profile: QoSProfile,
    deliver: Deliver,
    sent: list[bytes],
    patience: float,
) -> Relay:
    """Return the relay of a topic to which a node of the process is subscribed.

    Args:
        outside: Node in the domain of the process.
        inside: The node of the world.
        name: Name of the topic in that domain.
        kind: Type of its messages.
        topic: Name of the topic in the world.
        profile: Quality of service that the process requests.
        deliver: Delivers a message.
        sent: Receives what is sent.
        patience: Longest time until a message has arrived (s).
    """
    offered = copy(profile)
    # So it loses nothing.
    offered.reliability = ReliabilityPolicy.RELIABLE
    publisher = outside.create_publisher(kind, name, offered)
    send_raw = raw_sender(publisher)

    def send(data: bytes) -> None:
        sent.append(data)
        send_raw(data)
        # Parts of a large message may be lost, and are sent again.
        if len(data) > ONE_DATAGRAM and not publisher.wait_for_all_acked(Duration(seconds=patience)):
            raise LockstepError(f'a message of {len(data)} bytes on {topic} was not received')

    def receive(data: bytes) -> None:
        deliver(partial(send, data))

    inside.create_subscription(kind, topic, receive, profile, raw=True)
    return Relay(publisher.get_subscription_count)


def offered_service(outside: Node, inside: Node, name: str, kind: Any, deliver: Deliver) -> Relay:
    """Return the relay of a service of the process. `deliver` delivers a request."""
    client = outside.create_client(kind, name, qos_profile=CALLS)
    waiting: dict[int, Future] = {}

    def on_request(request: Any, _: Any) -> Any:
        """Return the response, or a coroutine that does if it does not come at once."""
        future = Future()

        def send() -> None:
            waiting[send_request(client, request)] = future

        deliver(send)
        return future.result() if future.done() else _wait_for(future)

    def take() -> Iterator[Arrived]:
        # Responses to other clients are in the queue, too. They are taken like none.
        misses = 0
        while waiting and misses <= MISSES:
            if (taken := take_response(client)) is None:
                misses += 1
            elif (future := waiting.pop(taken[0], None)) is not None:
                yield Arrived(f'answered {name}', False, partial(future.set_result, taken[1]))

    inside.create_service(kind, name, on_request, qos_profile=CALLS)
    return Relay(client.service_is_ready, take, client=client)


def called_service(
    outside: Node, inside: Node, name: str, kind: Any, respond: Deliver, unanswered: set[Future]
) -> Relay:
    """Return the relay of a service of the world that the process calls.

    Args:
        outside: Node in the domain of the process.
        inside: The node of the world.
        name: Name of the service.
        kind: Its type.
        respond: Sends a response.
        unanswered: Calls that were not answered yet.
    """
    service = outside.create_service(kind, name, _nothing, qos_profile=CALLS)
    client = inside.create_client(kind, name, qos_profile=CALLS)

    def forward(request: Any, header: Any) -> None:
        def answer(future: Future) -> None:
            def send() -> None:
                unanswered.discard(future)
                send_response(service, future.result(), header)

            # As a task, so that its errors are raised.
            inside.executor.create_task(respond, send)

        called = client.call_async(request)
        unanswered.add(called)
        called.add_done_callback(answer)

    def take() -> Iterator[Arrived]:
        while (taken := take_request(service)) is not None:
            yield Arrived(f'called {name}', True, partial(forward, *taken))

    def close() -> None:
        outside.destroy_service(service)
        inside.destroy_client(client)

    # A server does not know its clients.
    return Relay(lambda: True, take, close)


def without_echo(
    published: Callable[[Callable[[Any, Any], None]], None], own: Callable[[Any], bool]
) -> Callable[[bytes], list[tuple[int, bytes]]]:
    """Return the stage that drops what the process has published: it has received that in its domain.

    Args:
        published: Lets a function observe what is published on the topic.
        own: Returns whether a publisher is one of the process.
    """
    echoes: list[bytes] = []

    def note(publisher: Any, message: Any) -> None:
        if own(publisher):
            echoes.append(bytes(message))

    def stage(data: bytes) -> list[tuple[int, bytes]]:
        if data in echoes:
            echoes.remove(data)
            return []
        return [(0, data)]

    published(note)
    return stage


async def _wait_for(future: Future) -> Any:
    return await future


def _nothing(*_: Any) -> None:
    """Do nothing: the queues are read directly."""
