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

"""Reception of the messages of a topic, whatever QoS its publishers offer, and which were missed."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import islice
from math import inf
from types import MappingProxyType
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.subscription import Subscription
from rclpy.waitable import NumberOfEntities, Waitable

from diffdrive_jacobian.recording.qos import subscription_profile
from diffdrive_jacobian.ros.rclpy_internals import (
    Polled,
    ReceivedMessage,
    lost_messages,
    waiting_messages,
)
from diffdrive_jacobian.time_units import NANOSECONDS

MAX_RUNS = 100
"""Runs of consecutive numbers that are kept of each publisher, to recognize messages received twice."""
MAX_WAIT = NANOSECONDS // 10
"""Longest time for which a message waits in the buffer of a socket (ns). One that was received later
after it was sent has been sent again."""
BURST = 1000
"""Largest number of messages that are taken from a queue at once."""


class _Publisher:
    """The numbers received from one publisher, which numbers its messages consecutively."""

    def __init__(self, number: int) -> None:
        self.received = 1
        self.ended = False
        # First and last number of each run, ascending.
        self.runs = [[number, number]]

    @property
    def missing(self) -> int:
        """Number of messages between the first and the last received one that were not received."""
        return self.runs[-1][1] - self.runs[0][0] + 1 - self.received

    def add(self, number: int) -> bool:
        """Add a number. Return whether it is new."""
        runs = self.runs
        if number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            place = bisect_right(runs, number, key=lambda run: run[0])
            if place and number <= runs[place - 1][1]:
                return False
            runs.insert(place, [number, number])
            for left in (place, place - 1):
                if 0 <= left < len(runs) - 1 and runs[left][1] + 1 == runs[left + 1][0]:
                    self._join(left)
            if len(runs) > MAX_RUNS:
                # What is missing between the oldest two stays missing.
                self._join(0)
        self.received += 1
        return True

    def _join(self, left: int) -> None:
        self.runs[left][1] = self.runs.pop(left + 1)[1]


class MissedMessages:
    """Counts the missing messages of a topic, and recognizes those that are received twice.

    A message is identified by its publisher and its number. Missing are the numbers between the first
    and the last one received from a publisher. What a publisher sent before the first message that was
    received does not count: it may have sent that before there was a subscription.
    """

    def __init__(self) -> None:
        """Start without messages."""
        self._publishers: dict[bytes, _Publisher] = {}
        self._numbered = True

    @property
    def count(self) -> int:
        """Number of missing messages. 0 with a middleware that does not number them."""
        return sum(one.missing for one in self._publishers.values()) if self._numbered else 0

    def received(self, message: ReceivedMessage) -> bool:
        """Process a message. Return whether it is new."""
        number = self._number(message)
        if message.publisher in self._publishers:
            return self._publishers[message.publisher].add(number)
        self._publishers[message.publisher] = _Publisher(number)
        return True

    def received_late(self, message: ReceivedMessage) -> None:
        """Process a message that was sent after the end of the recording.

        Those between the last one before the end and the first one after it are missing.
        """
        publisher = self._publishers.get(message.publisher)
        if publisher is not None and not publisher.ended:
            publisher.ended = True
            publisher.add(self._number(message))

    def _number(self, message: ReceivedMessage) -> int:
        if message.number is not None:
            return message.number
        # The time, too, tells the messages of a publisher apart.
        self._numbered = False
        return message.sent


class Heard:
    """When a reliable publisher was heard, by its own times as far as these are plausible (ns)."""

    __slots__ = ('last', 'several', 'shortest')

    def __init__(self) -> None:
        """Start without messages."""
        self.last = 0
        """When it had sent, or sent again, what was received last."""
        self.several = False
        self.shortest = 0
        """The shortest time between two of its messages; 0 if there was one only."""

    def hear(self, message: ReceivedMessage) -> None:
        """Process a message."""
        received = message.received or time.time_ns()
        # A clock of another machine may be ahead.
        sent = max(min(message.sent, received), received - MAX_WAIT)
        if self.last:
            between = max(sent - self.last, 0)
            self.shortest = min(self.shortest, between) if self.several else between
            self.several = True
        self.last = sent


class CallbackReception:
    """Receives from one subscription, whose callback an executor calls.

    For nodes in this process: losses are not noticed, and latched messages from before the
    subscription are not received where another publisher is not latched.
    """

    missed = 0
    doubtful = False
    confirmed: frozenset[bytes] = frozenset()
    heard: Mapping[bytes, Heard] = MappingProxyType({})

    def __init__(
        self, node: Node, kind: type, topic: str, depth: int, callback: Callable[[bytes], None]
    ) -> None:
        """Prepare; `match` subscribes."""
        self._node, self._depth, self._callback = node, depth, callback
        self._create = partial(node.create_subscription, kind, topic, callback, raw=True)
        self._subscription: Subscription | None = None

    def match(self, offered: Sequence[QoSProfile]) -> None:
        """Receive from publishers with these profiles, too.

        Raises:
            RuntimeError, NameValidationException: The topic cannot be subscribed to.
        """
        before = self._subscription
        if before is None:
            self._subscription = self._create(subscription_profile(offered, self._depth))
            return
        demanded = before.qos_profile
        if all(qos_check_compatible(one, demanded)[0] != QoSCompatibility.ERROR for one in offered):
            return
        profile = subscription_profile([*offered, demanded], self._depth)
        # Latched messages are already received.
        profile.durability = DurabilityPolicy.VOLATILE
        for message in waiting_messages(before):
            self._callback(message.data)
        self._node.destroy_subscription(before)
        self._subscription = self._create(profile)


class Queue:
    """A subscription from whose queue messages are taken."""

    def __init__(self, subscription: Subscription, receive: Callable[[ReceivedMessage], None]) -> None:
        """Take messages of a subscription of the group `Polled` later, and pass them on."""
        self.subscription = subscription
        self._receive = receive
        self._taken = 0
        self.full = False
        """Whether it may have been full, and a message overwritten."""

    def take(self, most: int) -> None:
        """Take so many messages, or all."""
        count = 0
        for message in islice(waiting_messages(self.subscription), most):
            count += 1
            self._receive(message)
        self._taken += count
        # After an overwritten message at least as many as it has places are taken before it is empty.
        self.full |= self._taken >= self.subscription.qos_profile.depth
        if count < most:
            self._taken = 0


class Intake(Waitable):  # type: ignore[misc]
    """Waits for the messages of all queues of a node."""

    def __init__(self, node: Node) -> None:
        """Start without queues."""
        super().__init__(node.default_callback_group)
        self.queues: list[Queue] = []
        self._ready: list[Queue] = []
        node.add_waitable(self)

    def take_all(self) -> None:
        """Take all messages that wait."""
        for queue in self.queues:
            queue.take(queue.subscription.qos_profile.depth)

    def get_num_entities(self) -> NumberOfEntities:
        """Return the number of subscriptions."""
        return NumberOfEntities(num_subs=len(self.queues))

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Add the subscriptions to a wait set."""
        self._indices = [
            (wait_set.add_subscription(queue.subscription.handle), queue) for queue in self.queues
        ]

    def is_ready(self, wait_set: Any) -> bool:
        """Return whether messages wait."""
        self._ready = [
            queue for index, queue in self._indices if wait_set.is_ready('subscription', index)
        ]
        return bool(self._ready)

    def take_data(self) -> list[Queue]:
        """Return the queues in which messages wait."""
        return self._ready

    async def execute(self, taken_data: list[Queue]) -> None:
        """Take messages of each of these queues."""
        for queue in taken_data:
            queue.take(BURST)


class CountingReception:
    """Receives each message once, and notices those that are missed.

    A single subscription that receives from every publisher would demand the least that one of them
    offers: it would lose messages of reliable publishers, and not receive what latched ones sent before.
    So there is a subscription for each offered combination of reliability and durability. A best-effort
    subscription also receives from reliable publishers, with gaps. What a reliable one receives, too, is
    taken from that one only: nothing is missing there, and it is in order.
    """

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        depth: int,
        intake: Intake,
        on_message: Callable[[ReceivedMessage], None],
        is_late: Callable[[ReceivedMessage], bool],
    ) -> None:
        """Prepare; `match` subscribes. `is_late` returns whether a message was sent after the end."""
        self._create = partial(
            node.create_subscription, kind, topic, _ignore, raw=True, callback_group=Polled()
        )
        self._depth, self._intake = depth, intake
        self._on_message, self._is_late = on_message, is_late
        self._numbers = MissedMessages()
        self._queues: dict[tuple[Any, Any], Queue] = {}
        # The first message of each publisher that a reliable subscription received.
        self._reliable_from: dict[bytes, float] = {}
        self.confirmed: set[bytes] = set()
        """Reliable publishers (GID) that have delivered all that they sent before the end."""
        self.heard: dict[bytes, Heard] = {}
        """What was heard of each reliable publisher (GID)."""

    @property
    def missed(self) -> int:
        """Number of messages that are known to be missed."""
        # The numbers show messages that were overwritten in the queue, but not those lost before the
        # first message of a publisher. The middleware reports only those lost on the way, for each
        # subscription: what a best-effort one lost may have been received by a reliable one.
        lost = {demanded: lost_messages(one.subscription) for demanded, one in self._queues.items()}
        reliable = [count for demanded, count in lost.items() if _is_reliable(demanded)]
        return max(self._numbers.count, sum(reliable or lost.values()))

    @property
    def doubtful(self) -> bool:
        """Whether a queue may have been full: a publisher's only or last message may be missed."""
        return any(queue.full for queue in self._queues.values())

    def match(self, offered: Sequence[QoSProfile]) -> None:
        """As `CallbackReception.match`."""
        for one in offered:
            demanded = one.reliability, one.durability
            if demanded not in self._queues:
                receive = self._receive_reliable if _is_reliable(demanded) else self._receive_best_effort
                self._queues[demanded] = queue = Queue(self._subscribe(*demanded), receive)
                self._intake.queues.append(queue)

    def _subscribe(self, reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> Subscription:
        profile = QoSProfile(depth=self._depth, reliability=reliability, durability=durability)
        # Latched messages that a publisher overwrites before they are sent would be reported as lost.
        latched = durability == DurabilityPolicy.TRANSIENT_LOCAL
        events = partial(SubscriptionEventCallbacks, use_default_callbacks=False)
        try:
            lost = None if latched else _ignore
            return self._create(profile, event_callbacks=events(message_lost=lost))
        except UnsupportedEventTypeError:
            return self._create(profile, event_callbacks=events())

    def _receive_reliable(self, message: ReceivedMessage) -> None:
        if message.number is not None:
            self._reliable_from.setdefault(message.publisher, message.number)
        if (heard := self.heard.get(message.publisher)) is None:
            heard = self.heard[message.publisher] = Heard()
        heard.hear(message)
        if self._is_late(message):
            # A reliable publisher delivers in order.
            self.confirmed.add(message.publisher)
        self._receive(message)

    def _receive_best_effort(self, message: ReceivedMessage) -> None:
        if message.number is None or message.number < self._reliable_from.get(message.publisher, inf):
            self._receive(message)

    def _receive(self, message: ReceivedMessage) -> None:
        if self._is_late(message):
            self._numbers.received_late(message)
        elif self._numbers.received(message):
            self._on_message(message)


def _is_reliable(demanded: tuple[Any, Any]) -> bool:
    return bool(demanded[0] == ReliabilityPolicy.RELIABLE)


def _ignore(event: Any) -> None:
    """Do nothing. Messages and events are taken by those who ask for them."""
