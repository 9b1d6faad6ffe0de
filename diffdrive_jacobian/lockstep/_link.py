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

"""The two ends of a link: what a sender publishes on a topic, and what one receiver gets of it.

A message is sent by the `Source` of its sender, and waits in the queue of each subscription. The `Link`
to a receiver takes it from there, and lets it pass its stages. Then it waits at the gate of the
receiver, or is received at once. A stage may lose, delay, change or repeat messages. Most links have
none.

Neither end needs to be a node of rclpy: it is a topic, a type, and the functions that send, take and
receive.
"""

from __future__ import annotations

import inspect
import sys
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeAlias

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message

from diffdrive_jacobian.lockstep._clock import Agenda
from diffdrive_jacobian.lockstep._gate import Gate

__tracebackhide__ = True

Stage: TypeAlias = Callable[[bytes], Iterable[tuple[int, bytes]]]
"""Receives a serialized message, returns those that leave the stage instead, with their delays (ns)."""
Taken: TypeAlias = tuple[Any, dict[str, Any]]
"""A message, or its bytes, and its info."""
Published: TypeAlias = Callable[[Any, Any], None]
"""Receives a publisher and the message or bytes that it has published."""
Delivered: TypeAlias = Callable[[Node, Any, Any], None]
"""Receives the node of a subscription, the type of its messages, and a message or its bytes."""


def pass_on(
    stages: list[Stage],
    data: bytes,
    agenda: Agenda,
    arrive: Callable[[bytes], object],
    arrive_late: Callable[[bytes], object],
    first: int = 0,
) -> None:
    """Pass a message through stages, one after the other.

    A stage receives each message at the time at which it has left the one before.

    Args:
        stages: The stages.
        data: The serialized message.
        agenda: What happens later.
        arrive: Called now with each message that has passed all stages.
        arrive_late: Called with each message that has passed all stages after a delay.
        first: Number of the first stage.
    """
    if first == len(stages):
        arrive(data)
        return
    for delay, out in stages[first](data):
        if delay > 0:
            later = partial(pass_on, stages, out, agenda, arrive_late, arrive_late, first + 1)
            agenda.at(agenda.now + delay, later)
        else:
            pass_on(stages, out, agenda, arrive, arrive_late, first + 1)


class Source:
    """What one publisher of a node publishes."""

    __slots__ = (
        'count',
        'last',
        'links',
        'message_type',
        'observers',
        'send',
        'topic',
    )

    def __init__(
        self,
        topic: str,
        message_type: Any,
        links: list[Link],
        observers: list[Published],
        send: Callable[[bytes], None],
    ) -> None:
        """Start without messages.

        Args:
            topic: Full name of the topic.
            message_type: Type of its messages.
            links: The links of the topic. The list stays up to date.
            observers: The functions that are called with each message that was sent.
            send: Sends serialized messages.
        """
        self.topic = topic
        self.send = send
        self.message_type = message_type
        self.links = links
        self.observers = observers
        self.count = 0
        """Number of messages."""
        self.last: tuple[int, int, Any] = 0, 0, None
        """The last message: its number among those of all sources, its time by the clock of the nodes
        (ns), and the message."""

    def received(self) -> Any:
        """Return the last message as a subscription received it.

        The message of the publisher may differ: an int in a field for a float is another number on the
        wire. One that has been modified and cannot be serialized any more is returned itself.
        """
        _, _, message = self.last
        try:
            data = message if isinstance(message, bytes) else serialize_message(message)
            return deserialize_message(data, self.message_type)
        except Exception:
            return message


class Link:
    """The messages of a topic on their way to one receiver."""

    __slots__ = (
        '_agenda',
        '_create_task',
        '_gate',
        '_pending',
        '_ready',
        '_receive',
        '_release',
        '_take_next',
        'depth',
        'endpoint',
        'latched',
        'message_type',
        'observers',
        'owner',
        'raw',
        'stages',
        'take',
        'topic',
    )

    def __init__(
        self,
        endpoint: Any,
        owner: Node,
        *,
        gate: Gate,
        agenda: Agenda,
        pending: deque[Link | None],
        observers: list[Delivered],
        take: Callable[[type, bool], Taken | None],
        receive: Callable[[Taken], Any],
        create_task: Callable[[Any], object],
        release: Callable[[], None],
    ) -> None:
        """Start without stages.

        Args:
            endpoint: What has the topic, type and QoS of the receiver: its subscription.
            owner: The node that receives.
            gate: Its gate.
            agenda: What happens later.
            pending: Where each message that has arrived gets an entry.
            observers: The functions that are called before each message is received.
            take: Takes a message of a type, or its bytes, from the queue of the receiver. Returns None
                if there is none.
            receive: Lets the receiver process a message. Its result may be a coroutine.
            create_task: Continues that coroutine later.
            release: Ends the use of `take`.
        """
        self.endpoint = endpoint
        self.topic: str = endpoint.topic_name
        self.message_type, self.raw = endpoint.msg_type, bool(endpoint.raw)
        self.latched = is_latched(endpoint)
        self.depth = queue_depth(endpoint.qos_profile)
        self.owner = owner
        self.observers = observers
        self.stages: list[Stage] = []
        self.take = self._take_next = take
        """Takes the next message that has passed all stages."""
        self._gate = gate
        self._agenda = agenda
        self._pending = pending
        self._receive = receive
        self._create_task = create_task
        self._release = release
        self._ready: deque[Taken] = deque()
        """Messages that have passed all stages."""

    def add_stage(self, stage: Stage) -> None:
        """Add a stage behind the others."""
        self.stages.append(stage)
        self.take = self._take_passed

    def deliver(self) -> bool:
        """Take a message and let it through the gate of the receiver, at once or later.

        Return False if there is none.
        """
        taken = self.take(self.message_type, self.raw)
        if taken is None:
            return False
        if self._gate.free:
            self._hand_over(taken)
        else:
            self._gate.enter(self, self.topic, partial(self._hand_over, taken), self.depth)
        return True

    def _hand_over(self, taken: Taken) -> None:
        """Let the receiver process a message."""
        if self.observers:
            for observer in self.observers:
                observer(self.owner, self.message_type, taken[0])
        result = self._receive(taken)
        if result is not None and inspect.iscoroutine(result):
            self._create_task(result)

    def _take_passed(self, message_type: type, raw: bool) -> Taken | None:
        ready = self._ready
        while not ready:
            taken = self._take_next(message_type, True)
            if taken is None:
                return None
            data, info = taken
            late = partial(self._pass_late, info)
            pass_on(self.stages, data, self._agenda, partial(self._pass, info), late)
            # The message itself has its entry among those that wait.
            self._pending.extendleft([self] * (len(ready) - 1))
        return ready.popleft()

    def _pass(self, info: dict[str, Any], data: bytes) -> None:
        message = data if self.raw else deserialize_message(data, self.message_type)
        self._ready.append((message, info))

    def _pass_late(self, info: dict[str, Any], data: bytes) -> None:
        self._pass(info, data)
        self._pending.append(self)

    def close(self) -> None:
        """Release the queue of the receiver. No message can be taken afterwards."""
        self.take = _take_nothing
        self._release()


def _take_nothing(*_: Any) -> None:
    """Take nothing."""


def is_latched(endpoint: Any) -> bool:
    """Return whether a publisher or subscription is transient local."""
    return bool(endpoint.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def queue_depth(profile: QoSProfile) -> int:
    """Return the largest number of messages that wait in a queue (sys.maxsize: it has no limit)."""
    return sys.maxsize if profile.history == HistoryPolicy.KEEP_ALL else max(profile.depth, 1)
