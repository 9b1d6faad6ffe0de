"""The last messages of all topics, for the reports of failed tests."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from collections.abc import Sequence as Values
from itertools import count
from typing import Any, Protocol, TypeAlias

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message, serialize_message

from diffdrive_jacobian.lockstep._deliveries import Deliveries
from diffdrive_jacobian.messages.fields import is_stamp, plain, walk
from diffdrive_jacobian.messages.structure import Array, FieldType, Sequence, Structure, Text, structure
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS
from diffdrive_jacobian.ros.rclpy_internals import wrap_publish
from diffdrive_jacobian.time_units import NANOSECONDS

MAX_SHOWN = 4
"""Number of elements that are shown of an array."""
MAX_CHECKED = 100
"""Length up to which arrays of zeros are omitted. Longer ones are not searched."""


Published: TypeAlias = Callable[[Any, Any], None]
"""Receives a publisher and the message or bytes that it has published.

For messages from other processes an `ExternalSource` takes the place of the publisher.
"""


class ExternalSource(Protocol):
    """What has messages from other processes, with the attributes of a publisher."""

    topic_name: str
    msg_type: Any


class _Record:
    """Messages of one publisher, or those of other processes on a topic."""

    __slots__ = ('at', 'count', 'message', 'message_type', 'observers', 'order', 'readers', 'topic')

    def __init__(
        self, topic: str, message_type: Any, deliveries: Deliveries, observers: list[Published]
    ) -> None:
        self.observers = observers
        self.topic = topic
        self.message_type = message_type
        self.readers = deliveries.readers_of(self.topic)
        self.count = self.at = self.order = 0
        self.message: Any = None

    def received(self) -> Any:
        """Return the last message as a subscription received it.

        The message of the publisher may differ: an int in a field for a float is another number on the
        wire. One that has been modified and cannot be serialized any more is returned itself.
        """
        try:
            data = self.message if isinstance(self.message, bytes) else serialize_message(self.message)
            return deserialize_message(data, self.message_type)
        except Exception:
            return self.message


class Traffic:
    """Counts the messages of every publisher, stores the last one, and queues the deliveries.

    It wraps `Publisher.publish`. A subscription for each topic would cost as much as the run, and change
    the number of subscriptions, which nodes may query. Messages are not copied, so one that its node
    modifies after publishing is reported as modified.
    """

    def __init__(self, now: Callable[[], int]) -> None:
        """Start without messages. `now` returns the simulated time (ns)."""
        self._now = now
        self._records: dict[Publisher, _Record] = {}
        self._external: dict[str, _Record] = {}
        self._numbers = count(1)
        self._deliveries: Deliveries | None = None
        self._observers: dict[str, list[Published]] = {}
        self._restore: Callable[[], None] | None = None
        self.intercept: Callable[[Publisher, Any], bool] | None = None
        """Called with each message. It returns whether it sends the message itself."""

    def start(self, deliveries: Deliveries, note_thread: Callable[..., None]) -> None:
        """Start counting.

        Args:
            deliveries: Where the messages wait.
            note_thread: Called in other threads, as `QuiescentExecutor.note_thread`.
        """
        traffic, records, now, numbers = self, self._records, self._now, self._numbers
        self._deliveries = deliveries
        extend, observers_of = deliveries.pending.extend, self.observers_of
        thread, get_ident = deliveries.thread, threading.get_ident

        def counting(publish: Callable[..., None]) -> Callable[..., None]:
            def counted(self: Publisher, msg: Any) -> None:
                if get_ident() != thread:
                    topic = self.topic_name
                    heard = bool(deliveries.readers_of(topic) or observers_of(topic))
                    note_thread(self, f'publishes {topic}', heard=heard and topic not in NOT_OF_ROBOTS)
                if (intercept := traffic.intercept) is not None and intercept(self, msg):
                    return
                publish(self, msg)
                record = records.get(self)
                if record is None:
                    name = self.topic_name
                    record = _Record(name, self.msg_type, deliveries, observers_of(name))
                    records[self] = record
                record.count += 1
                record.order = next(numbers)
                record.at = now()
                record.message = msg
                extend(record.readers)
                if record.observers:
                    for observer in record.observers:
                        observer(self, msg)

            return counted

        self._restore = wrap_publish(counting)

    def observers_of(self, topic: str) -> list[Published]:
        """Return the functions that are called after each message of a topic is published."""
        return self._observers.setdefault(topic, [])

    def publish_now(self, publisher: Publisher, message: Any) -> None:
        """Publish a message that is not intercepted."""
        intercept, self.intercept = self.intercept, None
        try:
            publisher.publish(message)
        finally:
            self.intercept = intercept

    def last(self, topic: str) -> Any:
        """Return the last message of a topic as it was received; None: there is none."""
        records = [record for record in self._all() if record.topic == topic and record.count]
        return max(records, key=lambda record: record.order).received() if records else None

    def count(self, topic: str) -> int:
        """Return the number of messages that the nodes of the world have published on a topic."""
        return sum(record.count for record in self._records.values() if record.topic == topic)

    def sent_to_others(self) -> int:
        """Return the number of messages of the publishers that have a subscription elsewhere.

        It changes with every message to another process.
        """
        return sum(
            record.count
            for publisher, record in self._records.items()
            if record.topic not in NOT_OF_ROBOTS and _subscriptions(publisher) > len(record.readers)
        )

    def note_external(self, source: ExternalSource, messages: Values[bytes]) -> None:
        """Count messages from other processes on a topic.

        Args:
            source: The topic, which takes the place of a publisher.
            messages: The messages, serialized.
        """
        assert self._deliveries is not None, 'start comes first'
        name = source.topic_name
        record = self._external.get(name)
        if record is None:
            record = _Record(name, source.msg_type, self._deliveries, self.observers_of(name))
            self._external[name] = record
        for message in messages:
            record.count += 1
            record.order = next(self._numbers)
            record.at = self._now()
            record.message = message
            for observer in record.observers:
                observer(source, message)

    def _all(self) -> list[_Record]:
        return [*self._records.values(), *self._external.values()]

    def close(self) -> None:
        """Stop counting."""
        if self._restore is not None:
            self._restore()

    def describe(self, nodes: list[Node], existing: list[Node], world_time: int) -> str:
        """Return the last message of each publisher, and the subscribed topics without messages.

        Args:
            nodes: The nodes of the world.
            existing: These, and those that were created but not added.
            world_time: Time since the start (ns).
        """
        names = {
            publisher: node.get_fully_qualified_name()
            for node in existing
            for publisher in node.publishers
        }
        published = [
            (record.topic, names.get(publisher, 'a destroyed publisher'), record)
            for publisher, record in self._records.items()
            if record.topic not in NOT_OF_ROBOTS
        ] + [
            (topic, 'other processes', record)
            for topic, record in self._external.items()
            if record.count
        ]
        lines = [
            f'  {topic}: {record.count} from {node}, last at {record.at / NANOSECONDS:g} s: '
            f'{brief(record.received())}'
            for topic, node, record in sorted(published, key=lambda item: item[:2])
        ]
        active = {topic for topic, _, _ in published}
        subscribers: dict[str, list[str]] = {}
        for node in nodes:
            for subscription in node.subscriptions:
                topic = subscription.topic_name
                if topic not in active and topic not in NOT_OF_ROBOTS:
                    subscribers.setdefault(topic, []).append(node.get_fully_qualified_name())
        lines += [
            f'  {topic}: no message; subscribed by {", ".join(dict.fromkeys(names))}'
            for topic, names in sorted(subscribers.items())
        ]
        # Their callbacks are not executed.
        if missing := [node.get_fully_qualified_name() for node in existing if node not in nodes]:
            lines.append(f'  created, but not added to lockstep: {", ".join(sorted(missing))}')
        clock, passed = self._now() / NANOSECONDS, world_time / NANOSECONDS
        title = f'last messages, at {clock:g} s of the clock, {passed:g} s after the start:'
        return '\n'.join([title, *(lines or ['  none'])])


def _subscriptions(publisher: Publisher) -> int:
    """Return the number of matched subscriptions of a publisher; 0 if it was destroyed."""
    try:
        return int(publisher.get_subscription_count())
    except InvalidHandle:
        return 0


def brief(message: Any) -> str:
    """Return a message as one line with its nonzero fields."""
    if isinstance(message, bytes):
        return f'{len(message)} serialized bytes'
    kind = structure(type(message))
    fields = (
        (path, _shown(field, value)) for path, field, value in walk(kind, message, whole=_is_shown_whole)
    )
    return f'{kind.short_name}({", ".join(f"{path}={text}" for path, text in fields if text)})'


def _is_shown_whole(kind: FieldType) -> bool:
    return is_stamp(kind) or isinstance(kind, (Array, Sequence))


def _shown(kind: FieldType, value: Any) -> str:
    """Return the value of a field; '': it is zero, false or empty."""
    if value is None:
        # Not valid any more, see `_Record.received`.
        return 'None'
    if is_stamp(kind):
        nonzero = value.sec or value.nanosec
        return f'{value.sec + value.nanosec / NANOSECONDS:.9g} s' if nonzero else ''
    match kind:
        case Array(element=element) | Sequence(element=element):
            zero = len(value) <= MAX_CHECKED and all(_is_zero(one) for one in value)
            return '' if zero else _array(element, value)
        case Text():
            return repr(value) if value else ''
        case _:
            return '' if _is_zero(value) else _scalar(kind, value)


def _is_zero(value: Any) -> bool:
    return isinstance(value, (bool, int, float)) and value == 0


def _scalar(kind: FieldType, value: Any) -> str:
    if isinstance(kind, Structure):
        return brief(value)
    if isinstance(value, float):
        # Six digits, or all of them where that is shorter: 5e-324.
        return min(f'{value:.6g}', repr(value), key=len) if math.isfinite(value) else str(value)
    return repr(value)


def _array(element: FieldType, values: Any) -> str:
    shown = ', '.join(_scalar(element, one) for one in plain(values[:MAX_SHOWN]))
    return f'[{shown}]' if len(values) <= MAX_SHOWN else f'[{shown}, ... {len(values)} in all]'
