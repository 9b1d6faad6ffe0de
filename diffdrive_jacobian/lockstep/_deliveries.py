"""Messages on their way from publishers to the subscriptions of the nodes in lockstep.

Within a process Fast DDS puts a message into the queues of its subscriptions before `publish` returns.
So whoever observes `Publisher.publish` knows which subscriptions may have received something, and in
which order. The messages are taken from there directly: an event of the EventsExecutor takes several
times as long.
"""

from __future__ import annotations

import inspect
import sys
import threading
from collections import deque
from collections.abc import Callable, Container, Iterable
from typing import Any, NamedTuple, TypeAlias

from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy
from rclpy.subscription import Subscription

from diffdrive_jacobian.ros.rclpy_internals import message_taker, receives_info, wait_for_message

Delivered: TypeAlias = Callable[[Node, Any, Any], None]
"""Receives the node of a subscription, the type of its messages, and a message or its bytes."""


class SentElsewhere(NamedTuple):
    """What a publisher, client or service has sent from another thread than that of the nodes."""

    node: Node
    """The node that has it."""
    added: bool
    """Whether the node was added before."""
    what: str
    """What it did: 'node /face publishes /cmd_vel'."""
    thread: str
    """Name of the thread."""


class Deliveries:
    """Subscriptions that may have messages, in the order in which these were published."""

    def __init__(self, create_task: Callable[[Node], Callable[..., Any]]) -> None:
        """Start without subscriptions.

        Args:
            create_task: Returns the function for the coroutines that callbacks of a node return.
        """
        self.pending: deque[Reader | None] = deque()
        """One entry for each message and subscription. None: a request or a response of a service."""
        self.new_reader: Callable[[Subscription, Node], Reader] = lambda subscription, node: Reader(
            subscription, create_task(node)
        )
        """Creates the reader of a subscription of a node."""
        self.held: set[str] = set()
        """Topics whose messages are not polled: they come from other processes, see `_external`."""
        self.thread = threading.get_ident()
        """The thread of the nodes."""
        self.elsewhere: dict[Any, SentElsewhere] = {}
        """What another thread has sent last, by publisher, client or service."""
        self._readers: dict[Subscription, Reader] = {}
        self._by_topic: dict[str, list[Reader]] = {}
        self._observers: dict[str, list[Delivered]] = {}
        self._polled: list[Reader] = []

    def readers_of(self, topic: str) -> list[Reader]:
        """Return the subscriptions of a topic. The list stays up to date."""
        return self._by_topic.setdefault(topic, [])

    def observers_of(self, topic: str) -> list[Delivered]:
        """Return the functions that are called before each message of a topic is received."""
        return self._observers.setdefault(topic, [])

    def update(self, nodes: Iterable[Node], without: Container[Subscription] = ()) -> list[Reader]:
        """Serve the present subscriptions of the nodes.

        Args:
            nodes: The nodes.
            without: Subscriptions that are not served.

        Returns:
            Those that wait for `admit`.
        """
        known, self._readers = self._readers, {}
        for node in nodes:
            for subscription in node.subscriptions:
                if subscription in without:
                    continue
                reader = known.pop(subscription, None)
                self._readers[subscription] = reader or self._create(subscription, node)
        for reader in known.values():
            reader.close()
        present = set(self._readers.values())
        self._polled = [reader for reader in self._polled if reader in present]
        for readers in self._by_topic.values():
            readers.clear()
        for reader in self._readers.values():
            self.readers_of(reader.topic).append(reader)
        admitted = set(self._polled)
        return [reader for reader in self._readers.values() if reader not in admitted]

    def _create(self, subscription: Subscription, node: Node) -> Reader:
        reader = self.new_reader(subscription, node)
        reader.owner, reader.observers = node, self.observers_of(reader.topic)
        return reader

    def replace(self, nodes: Iterable[Node]) -> None:
        """Create the readers of all present subscriptions again, by `new_reader`."""
        owners = {subscription: node for node in nodes for subscription in node.subscriptions}
        replaced = {}
        for subscription, reader in self._readers.items():
            replaced[reader] = self._readers[subscription] = self._create(
                subscription, owners[subscription]
            )
            reader.close()
        self._polled = [replaced[reader] for reader in self._polled if reader in replaced]
        for readers in self._by_topic.values():
            readers[:] = [replaced[reader] for reader in readers]

    def readers(self) -> list[Reader]:
        """Return all readers."""
        return list(self._readers.values())

    def drop_destroyed(self, nodes: Iterable[Node]) -> None:
        """Deliver nothing more to subscriptions that the nodes do not have any more."""
        present = {subscription for node in nodes for subscription in node.subscriptions}
        for subscription in self._readers.keys() - present:
            self._readers.pop(subscription).close()

    def admit(self, reader: Reader) -> None:
        """Deliver the messages that a new subscription has received before, and let it be polled."""
        while reader.deliver():
            pass
        self._polled.append(reader)

    def poll(self) -> bool:
        """Deliver one message of each subscription that has any. Return whether there was one.

        rcl itself publishes some messages, for example the status of actions, which nobody can observe.
        """
        found = False
        for reader in self._polled:
            if self.held and reader.topic in self.held:
                continue
            # As `deliver`, without a call for each.
            taken = reader.take(reader.message_type, reader.raw)
            if taken is not None:
                reader.call(taken)
                found = True
        return found

    def close(self) -> None:
        """Forget all subscriptions, so that they can be destroyed."""
        self.update(())


class Reader:
    """A subscription from which messages are taken."""

    __slots__ = (
        '_close',
        '_create_task',
        'depth',
        'latched',
        'message_type',
        'observers',
        'owner',
        'raw',
        'subscription',
        'take',
        'topic',
    )

    def __init__(self, subscription: Subscription, create_task: Callable[..., Any]) -> None:
        """Keep the subscription alive until `close`."""
        self.topic: str = subscription.topic_name
        self.owner: Node | None = None
        self.observers: list[Delivered] = []
        self.latched = is_latched(subscription)
        self.depth = queue_depth(subscription)
        self.subscription = subscription
        self._create_task = create_task
        self.message_type, self.raw = subscription.msg_type, subscription.raw
        self.take, self._close = message_taker(subscription)

    def waits(self, context: Context, timeout: float) -> bool:
        """Wait until a message from another process can be taken.

        Args:
            context: The context of the nodes.
            timeout: Longest wall time (s).

        Returns:
            Whether there is one.
        """
        return wait_for_message(context, self.subscription, timeout)

    def accept(self) -> None:
        """Take exactly one message, and call the callback."""
        self.deliver()

    def deliver(self) -> bool:
        """Take a message and call the callback. Return False if there is none."""
        taken = self.take(self.message_type, self.raw)
        if taken is None:
            return False
        self.call(taken)
        return True

    def call(self, taken: tuple[Any, dict[str, Any]]) -> None:
        """Call the callback with a message that was taken, and its info."""
        if self.observers:
            for observer in self.observers:
                observer(self.owner, self.message_type, taken[0])
        # The callback is looked up for each message, because it may be replaced.
        subscription = self.subscription
        callback = subscription.callback
        result = callback(*taken) if receives_info(subscription) else callback(taken[0])
        if result is not None and inspect.iscoroutine(result):
            self._create_task(result)

    def close(self) -> None:
        """Release the subscription. No message can be taken afterwards."""
        self.take = _nothing
        self._close()


def _nothing(*_: Any) -> None:
    """Take nothing."""


def queue_depth(subscription: Subscription) -> int:
    """Return the largest number of messages that wait in a subscription."""
    profile = subscription.qos_profile
    return sys.maxsize if profile.history == HistoryPolicy.KEEP_ALL else max(profile.depth, 1)


def is_latched(endpoint: Any) -> bool:
    """Return whether a publisher or subscription is transient local."""
    return bool(endpoint.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)
