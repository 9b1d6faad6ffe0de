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

"""The node that records topics as raw CDR, and a recording by it alone."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from math import inf
from typing import Any, NamedTuple, Protocol

from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rosbags.interfaces import Qos

from diffdrive_jacobian.bags.bag_writer import Summary
from diffdrive_jacobian.bags.journal import PARAMETERS, Channel, Message, Record, Text
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, definition, message_class
from diffdrive_jacobian.messages.names import full_name
from diffdrive_jacobian.messages.topics import OF_EVERY_NODE
from diffdrive_jacobian.messages.topics import Selection as Selection
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.recording.overflow import Overflow
from diffdrive_jacobian.recording.parameter_query import ParameterQuery
from diffdrive_jacobian.recording.qos import to_rosbags
from diffdrive_jacobian.recording.reception import (
    CallbackReception,
    CountingReception,
    Intake,
)
from diffdrive_jacobian.recording.recording import Recording, saved_on_error
from diffdrive_jacobian.ros.fastdds_profiles import receives_through_udp
from diffdrive_jacobian.ros.rate_limit import TokenBucket
from diffdrive_jacobian.ros.rclpy_internals import ReceivedMessage, reason
from diffdrive_jacobian.ros.runner import NodeRunner, ros_context, running
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS

NAME = 'record_run'
"""Name of the node."""
DEPTH = 4000
"""Depth of the queue of each subscription."""
DRAIN_PATIENCE = 12.0
"""Longest time at the end in which messages that were sent before are received (s)."""
IN_TRANSIT = 0.1
"""After this time without such a message no more is expected, unless a buffer overflowed (s)."""
HEARTBEAT = 3.5
"""Time after an overflow in which reliable publishers send what was lost in it (s).

Fast DDS: by default a publisher that sends nothing else says every 3 s which messages it has sent.
"""
ACTIVE = 1.0
"""A publisher may have sent something within this time after its last message that was received (s)."""
HELD = 0.5
"""Time between two calls of `drained` after which the process was held, and nothing was received (s)."""
MAX_REPORT = 500
"""Largest length of the report on a topic (characters)."""
DISCOVERY_PERIOD = 0.2
"""Time between two searches for new topics (s)."""
WAIT_SHOWN = 0.5
"""A wait for late messages that is longer than this is shown (s)."""


class Sink(Protocol):
    """Receives what a recorder records, as a `Recording` does."""

    def add(self, record: Record) -> None:
        """Take a record."""

    def set_missed(self, topic: str, messages: int) -> None:
        """Take how many messages of a topic are known to be missed so far."""

    def set_left_out(self, topic: str, why: str) -> None:
        """Take that a topic is not recorded, and why."""


class Recorder(Node):  # type: ignore[misc]
    """Records the selected topics, each from the time at which its first publisher is discovered."""

    def __init__(
        self,
        selection: Selection,
        sink: Sink,
        *,
        with_info: bool = False,
        now: Callable[[], int] | None = None,
        **kwargs: Any,
    ) -> None:
        """Create the node without subscriptions; `discover` creates them.

        Args:
            selection: Which topics.
            sink: The recording.
            with_info: Whether messages are taken with their info, which the EventsExecutor of Jazzy does
                not support. Missed messages are then counted, and a message is recorded with the time
                at which the middleware received it. Otherwise, and always with simulated time, it is
                recorded with the time of the node's clock when its callback runs.
            now: Returns the time with which messages are recorded (ns), for a clock that may go back
                (default: that of the node's clock).
            kwargs: As for `rclpy.node.Node`.

        Raises:
            ParameterError: The name of a topic is invalid.
        """
        super().__init__(NAME, start_parameter_services=False, **kwargs)
        self._overflow = Overflow(counted=with_info and receives_through_udp())
        self._sink = sink
        self._everything = selection.everything
        self._names = {self._resolved(topic) for topic in selection.topics}
        self._pattern = re.compile(selection.pattern) if selection.pattern else None
        self._channels: dict[str, Channel] = {}
        self._receptions: dict[str, CallbackReception | CountingReception] = {}
        self._intake = Intake(self) if with_info else None
        self._refused: set[str] = set()
        self._queries: dict[str, ParameterQuery] = {}
        self._clock_now = now or (lambda: int(self.get_clock().now().nanoseconds))
        self._stamped = with_info and not self.get_parameter('use_sim_time').value
        self._end: int | None = None
        self._drain_deadline = self._last_added = self._called = 0.0
        self.awaited: list[str] = []
        """After `end`: topics of which reliable publishers may send again what was lost."""
        self.messages = 0
        """Number of messages received."""

    @property
    def topics(self) -> list[str]:
        """The topics that are recorded."""
        return list(self._channels)

    @property
    def missing(self) -> list[str]:
        """The topics that were selected by name and had no publisher so far, fully qualified."""
        return sorted(self._names - self._channels.keys() - self._refused)

    def discover(self) -> None:
        """Subscribe to new topics, and query parameters of new nodes; to be called often."""
        self._overflow.look()
        for topic, _ in self.get_topic_names_and_types():
            if not self._wants(topic) or topic in self._refused:
                continue
            try:
                publishers = self.get_publishers_info_by_topic(topic)
            except (ValueError, NameValidationException) as error:
                # A DDS application without ROS can use any name.
                self._leave_out(topic, reason(error))
                continue
            if not publishers:
                continue
            if topic not in self._channels:
                self._subscribe(topic, publishers)
            else:
                self._note_changes(self._channels[topic], publishers)
            if topic in self._channels:
                self._match(self._channels[topic], publishers)
            for publisher in publishers:
                self._ask_for_parameters(publisher.node_namespace, publisher.node_name)
        for query in self._queries.values():
            query.advance()
        self._report_missed()

    def end(self) -> None:
        """Record from now on only messages that were sent or received before. Spin until `drained`.

        Requires `with_info`.
        """
        self._end = time.time_ns()
        self._last_added = self._called = time.monotonic()
        self._drain_deadline = self._last_added + DRAIN_PATIENCE
        self.awaited = self._awaited()

    def drained(self) -> bool:
        """Return whether all messages sent before `end` were received, or the time for them is over.

        A reliable publisher has delivered all if a message arrives that it sent after the end. Otherwise
        its last messages may be missing if a buffer overflowed then. It sends them again within
        `HEARTBEAT`, unless it has ended: then the end of the topic is reported.
        """
        assert self._intake is not None, 'requires with_info'
        self._overflow.look()
        self._intake.take_all()
        self._report_missed()
        now = time.monotonic()
        if now - self._called > HELD:
            self._last_added = now
            self._drain_deadline = now + DRAIN_PATIENCE
        self._called = now
        if now - self._last_added > IN_TRANSIT:
            self.awaited = self._awaited()
            if not self.awaited:
                for topic, why in self._in_doubt().items():
                    self._leave_out_end(topic, why)
                return True
        if now > self._drain_deadline:
            self.give_up(f'messages were still arriving {DRAIN_PATIENCE:.0f} s after the end')
            return True
        return False

    def give_up(self, why: str) -> None:
        """Report that messages sent before `end` may be missing, because it was not waited for them."""
        for topic in self._in_doubt() or self.topics:
            self._leave_out_end(topic, why)

    def _leave_out_end(self, topic: str, why: str) -> None:
        self._sink.set_left_out(f'possibly the end of {topic}', why)

    def _in_doubt(self) -> dict[str, str]:
        """Return the topics of which a reliable publisher's last messages may be missing, and why."""
        found = {}
        for topic, reception in self._receptions.items():
            for publisher in reception.heard.keys() - reception.confirmed:
                heard = reception.heard[publisher]
                end = heard.last + int(ACTIVE * NANOSECONDS)
                # What was dropped sooner than its next message can have been sent was of others.
                if self._overflow.dropped(heard.last + heard.shortest // 2, end):
                    found[topic] = 'a buffer overflowed, and then its publisher ended or was silent'
                elif self._overflow.held(heard.last, end) and not self._lives(publisher, topic):
                    found[topic] = 'its publisher ended while this process was held'
        return found

    def _awaited(self) -> list[str]:
        """Return the topics of which dropped messages may still be sent again."""
        if time.time_ns() - self._overflow.last > HEARTBEAT * NANOSECONDS:
            return []
        return [
            topic
            for topic in self._in_doubt()
            if any(
                self._lives(publisher, topic)
                for publisher in self._receptions[topic].heard.keys() - self._receptions[topic].confirmed
            )
        ]

    def _lives(self, publisher: bytes, topic: str) -> bool:
        """Return whether a publisher has not ended, as far as that is known."""
        there = self.get_publishers_info_by_topic(topic)
        return any(bytes(one.endpoint_gid) == publisher for one in there)

    def _report_missed(self) -> None:
        for topic, reception in self._receptions.items():
            if missed := reception.missed:
                self._sink.set_missed(topic, missed)
            elif reception.doubtful:
                self._sink.set_left_out(f'possibly part of {topic}', f'its queue of {DEPTH} was full')

    def _resolved(self, topic: str) -> str:
        try:
            return str(self.resolve_topic_name(topic))
        except (RuntimeError, NameValidationException) as error:
            self.destroy_node()
            raise ParameterError(f'invalid topic name {topic!r}: {reason(error)}') from error

    def _wants(self, topic: str) -> bool:
        if topic in self._names:
            return True
        if self._everything and '/_' not in topic:
            return True
        return self._pattern is not None and self._pattern.search(topic) is not None

    def _subscribe(self, topic: str, publishers: list[Any]) -> None:
        types = sorted({one.topic_type for one in publishers})
        if len(types) > 1:
            self._leave_out(topic, f'it has several types: {", ".join(types)}')
            return
        try:
            described = definition(types[0])
            message = message_class(types[0])
        except UnknownTypeError as error:
            self._leave_out(topic, str(error))
            return
        channel = Channel(
            id=len(self._channels),
            topic=topic,
            type_name=types[0],
            definition=described.text,
            type_hash=described.type_hash,
            qos=_profiles(publishers),
        )
        self._channels[topic] = channel
        if self._intake is None:
            on_data = partial(self._on_data, channel.id)
            self._receptions[topic] = CallbackReception(self, message, topic, DEPTH, on_data)
        else:
            on_message = partial(self._on_message, channel.id)
            self._receptions[topic] = CountingReception(
                self, message, topic, DEPTH, self._intake, on_message, self._is_late
            )
        self._sink.add(channel)

    def _match(self, channel: Channel, publishers: list[Any]) -> None:
        try:
            self._receptions[channel.topic].match(
                [one.qos_profile for one in publishers if one.topic_type == channel.type_name]
            )
        except (RuntimeError, NameValidationException) as error:
            self._leave_out(channel.topic, reason(error))

    def _leave_out(self, topic: str, why: str) -> None:
        """Report once that a topic, or its publishers of one type, are not recorded."""
        self._refused.add(topic)
        self._sink.set_left_out(topic, why)
        # Other processes choose the names.
        self.get_logger().error(printable(f'{topic} is not recorded: {why}', MAX_REPORT))

    def _note_changes(self, channel: Channel, publishers: list[Any]) -> None:
        """Note new profiles and types of the publishers."""
        if new := tuple(one for one in _profiles(publishers) if one not in channel.qos):
            channel = replace(channel, qos=channel.qos + new)
            self._channels[channel.topic] = channel
            self._sink.add(channel)
        for other in {one.topic_type for one in publishers} - {channel.type_name}:
            if (mismatch := f'{channel.topic} of {other}') not in self._refused:
                self._leave_out(mismatch, f'{channel.topic} is recorded as {channel.type_name}')

    def destroy_node(self) -> None:
        """Let go of the sockets, too."""
        self._overflow.close()
        super().destroy_node()

    # --- Messages

    def _on_data(self, channel: int, data: bytes) -> None:
        self._add(channel, self._now(), data)

    def _on_message(self, channel: int, message: ReceivedMessage) -> None:
        self._last_added = time.monotonic()
        self._overflow.received(len(message.data), message.received)
        self._add(channel, message.received if self._stamped else self._now(), message.data)

    def _is_late(self, message: ReceivedMessage) -> bool:
        # Clocks of other machines may be ahead, so either time is sufficient.
        return self._end is not None and min(message.received, message.sent or inf) > self._end

    def _now(self) -> int:
        # A bag cannot contain a negative time.
        return max(0, self._clock_now())

    def _add(self, channel: int, stamp: int, data: bytes) -> None:
        self._sink.add(Message(channel, stamp, data))
        self.messages += 1

    # --- Parameters of the nodes that are recorded

    def _ask_for_parameters(self, namespace: str, name: str) -> None:
        node = full_name(namespace, name)
        # The name of a node may be discovered later than its topics.
        if name.startswith('_') or node in self._queries or node == self.get_fully_qualified_name():
            return
        self._queries[node] = ParameterQuery(
            self, node, partial(self._on_parameters, node), partial(self._on_trouble, node)
        )

    def _on_parameters(self, node: str, values: dict[str, Any]) -> None:
        self._sink.add(Text(PARAMETERS + node, json.dumps(values, default=list)))

    def _on_trouble(self, node: str, trouble: str) -> None:
        self.get_logger().warning(f'parameters of {node} are not all recorded: {trouble}')


def _profiles(publishers: list[Any]) -> tuple[Qos, ...]:
    """Return the distinct offered QoS profiles."""
    return tuple(dict.fromkeys(to_rosbags(one.qos_profile) for one in publishers))


# --- A recording by this node alone


class Status(NamedTuple):
    """The state of a recording."""

    messages: int
    """Number of messages received."""
    topics: int
    """Number of topics."""
    size: int
    """Size of the journal (bytes)."""
    seconds: float
    """Time since the start (s)."""
    lost: int
    """Number of messages that are known to be lost."""
    missing: tuple[str, ...] = ()
    """Topics that were selected by name and had no publisher so far, fully qualified."""
    published: tuple[str, ...] = ()
    """Topics of other nodes that have a publisher, if no topic is recorded. For messages."""


def record(
    recording: Recording,
    selection: Selection,
    *,
    max_duration: float | None,
    ros_arguments: Sequence[str],
    signals: Signals,
    on_status: Callable[[Status], object],
    on_wait: Callable[[Sequence[str]], object],
    on_end: Callable[[], object],
) -> Summary:
    """Record until a signal is caught, the time is over, ROS is shut down or the disk fails.

    Args:
        recording: Where to record. It is finished, or discarded on a `UserError`.
        selection: Which topics.
        max_duration: Longest duration (s). None: no limit.
        ros_arguments: ROS arguments of the node.
        signals: Counter of the signals that end the recording.
        on_status: Receives the status, several times a second.
        on_wait: Called if late messages are waited for at the end, with their topics.
        on_end: Called when nothing more is received, before the bag is written.

    Returns:
        What the bag contains.

    Raises:
        UserError: The ROS arguments are invalid.
        RecordingError: The recording is not complete.
    """
    if not signals.count:
        with (
            saved_on_error(recording),
            ros_context([NAME, *ros_arguments]) as context,
            running(context, isolated=False, with_info=True) as runner,
        ):
            recorder = runner.add(
                lambda: Recorder(selection, recording, with_info=True, context=context)
            )
            discovery = TokenBucket(1, DISCOVERY_PERIOD)

            def failed() -> bool:
                if discovery.permits(time.monotonic()):
                    recorder.discover()
                    on_status(_status(recorder, recording))
                return recording.error is not None

            left = inf if max_duration is None else recording.started + max_duration - time.monotonic()
            if not runner.spin(failed, timeout=left, signals=signals) and context.ok():
                _drain(recorder, runner, signals, on_wait)
    on_end()
    return recording.finish()


def _drain(
    recorder: Recorder,
    runner: NodeRunner,
    signals: Signals,
    on_wait: Callable[[Sequence[str]], object],
) -> None:
    """Receive what was sent before now, until a further signal."""
    recorder.end()
    before = signals.count
    # Until nothing is in transit any more, a second signal changes nothing.
    drained = runner.spin(recorder.drained, timeout=2.0 * IN_TRANSIT)
    if not drained:
        drained = runner.spin(recorder.drained, timeout=WAIT_SHOWN, signals=signals, handled=before)
    if not drained:
        if recorder.awaited and signals.count == before:
            on_wait(recorder.awaited)
        drained = runner.spin(recorder.drained, signals=signals, handled=before)
    if not drained and signals.count > before:
        recorder.give_up('a second signal ended the wait for late messages')


def _status(recorder: Recorder, recording: Recording) -> Status:
    return Status(
        messages=recorder.messages,
        topics=len(recorder.topics),
        size=recording.journal.size,
        seconds=time.monotonic() - recording.started,
        lost=sum(recording.lost.values()),
        missing=tuple(recorder.missing),
        published=() if recorder.topics else tuple(_published(recorder)),
    )


def _published(node: Node) -> list[str]:
    """Return the topics that have a publisher. Those that every node publishes are left out."""
    found = []
    for topic, _ in sorted(node.get_topic_names_and_types()):
        # A DDS application without ROS can use any name.
        with suppress(ValueError, NameValidationException):
            if topic not in OF_EVERY_NODE and node.count_publishers(topic):
                found.append(topic)
    return found
