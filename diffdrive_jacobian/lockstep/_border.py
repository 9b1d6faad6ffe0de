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

"""What the nodes of a world say, and nodes that are apart: they hear and say something else.

`Said` keeps all messages of a world. A `Border` runs a world again, in which some nodes are apart. What
they hear is changed at the border, and what they say does not cross it: the others hear what those nodes
have said in the first world, at the same times and in the same order. So the others do the same as in
the first world, and one difference is not followed by others.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message

from diffdrive_jacobian.lockstep._link import Link, Stage
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS
from diffdrive_jacobian.ros.rclpy_internals import wrap_publish

__tracebackhide__ = True

Heard = Callable[[Link, bytes], Iterable[tuple[int, bytes]]]
"""Receives a link to a node that is apart, and a message; returns what it hears, with delays (ns)."""


class Speaker(NamedTuple):
    """A publisher of a node, the same in each world."""

    node: str
    """Full name of the node."""
    topic: str
    """Full name of the topic."""
    number: int
    """Number of the publisher among those that the node has for the topic, from 0."""


class Message(NamedTuple):
    """What a node has said."""

    time: int
    """World time (ns)."""
    speaker: Speaker
    type: Any
    data: bytes
    """The serialized message."""


@dataclass
class Endpoints:
    """What a node has that belongs to no test."""

    published: set[str] = field(default_factory=set)
    """Full names of topics."""
    subscribed: set[str] = field(default_factory=set)
    periods: set[int] = field(default_factory=set)
    """Periods of its timers (ns)."""


def endpoints_of(world: Lockstep) -> dict[str, Endpoints]:
    """Return the nodes of a world by their full names, without those of the test. More may follow."""
    found: dict[str, Endpoints] = {}

    def look() -> None:
        for node in world.nodes:
            if node not in world._nodes.observers:
                endpoints = found.setdefault(node.get_fully_qualified_name(), Endpoints())
                endpoints.published.update(one.topic_name for one in node.publishers)
                endpoints.subscribed.update(one.topic_name for one in node.subscriptions)
                endpoints.periods.update(one.timer_period_ns for one in node.timers)

    world.on_new_topics(look)
    return found


def topics_of(world: Lockstep) -> tuple[frozenset[str], frozenset[str]]:
    """Return the topics with messages, and those that properties observe, by their full names."""
    said = {source.topic for _, source in world._scheduler.links.sources()}
    return frozenset(said), frozenset(world._properties.observed)


class Said:
    """What all nodes of a world say while this context manager is open."""

    def __init__(self, world: Lockstep) -> None:
        """Start without messages."""
        self._world = world
        self._scheduler = world._scheduler
        self.messages: list[Message] = []
        """In the order in which they were sent."""
        self.nodes = endpoints_of(world)
        """All nodes that there were, by their full names, without those that belong to the test."""
        self._speakers: dict[Publisher, Speaker | None] = {}
        self._publish: Callable[..., None]

    def __enter__(self) -> Said:
        """Start to listen."""

        def listening(publish: Callable[..., None]) -> Callable[..., None]:
            self._publish = publish

            def send(publisher: Publisher, msg: Any) -> None:
                speaker = self._speaker(publisher)
                if speaker is None or self._scheduler.gates.running is not None:
                    # It is none of a node, or is sent when the callback of a slow node ends.
                    publish(publisher, msg)
                else:
                    self._on_message(speaker, publisher, msg)

            return send

        self._restore = wrap_publish(listening)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        self._restore()

    def _on_message(self, speaker: Speaker, publisher: Publisher, msg: Any) -> None:
        self._note(speaker, publisher, msg)
        self._publish(publisher, msg)

    def _note(self, speaker: Speaker, publisher: Publisher, msg: Any) -> None:
        data = msg if isinstance(msg, bytes) else serialize_message(msg)
        self.messages.append(Message(self._scheduler.agenda.now, speaker, publisher.msg_type, data))

    def _speaker(self, publisher: Publisher) -> Speaker | None:
        """Return who publishes; None: the world itself, or rclpy."""
        if publisher not in self._speakers:
            self._speakers[publisher] = self._find(publisher)
        return self._speakers[publisher]

    def _find(self, publisher: Publisher) -> Speaker | None:
        topic = publisher.topic_name
        if topic in NOT_OF_ROBOTS or publisher in self._scheduler.links.unaffected:
            return None
        for node in self._scheduler.existing:
            same = [one for one in node.publishers if one.topic_name == topic]
            if publisher in same:
                return Speaker(node.get_fully_qualified_name(), topic, same.index(publisher))
        return None


class Border(Said):
    """A world in which some nodes are apart, while this context manager is open."""

    def __init__(
        self, world: Lockstep, first: Sequence[Message], apart: Collection[str], heard: Heard
    ) -> None:
        """Start without messages.

        Args:
            world: The world. Its faults have been injected.
            first: What all nodes have said in the first world.
            apart: Full names of the nodes that are apart.
            heard: Changes what they hear.
        """
        super().__init__(world)
        self._apart, self._heard = frozenset(apart), heard
        others = 0
        self._due: deque[tuple[int, Message]] = deque()
        """What they have said in the first world, with the number of messages of others before it."""
        for message in first:
            if message.speaker.node in apart:
                self._due.append((others, message))
            else:
                others += 1
        self._others = 0
        self._said: dict[str, Any] = {}

    def __enter__(self) -> Border:
        """Put the nodes apart."""
        super().__enter__()
        self._world.pauses.said = self._said
        agenda = self._scheduler.agenda
        for time in dict.fromkeys(message.time for _, message in self._due):
            agenda.at(time, self._say)
        # After the stages of the faults.
        self._scheduler.links.add_stages(self._stage_of)
        return self

    def _stage_of(self, link: Link) -> Stage | None:
        if link.topic in NOT_OF_ROBOTS or link.owner.get_fully_qualified_name() not in self._apart:
            return None

        def stage(data: bytes) -> Iterable[tuple[int, bytes]]:
            return self._heard(link, data)

        return stage

    def _on_message(self, speaker: Speaker, publisher: Publisher, msg: Any) -> None:
        self._note(speaker, publisher, msg)
        if speaker.node not in self._apart:
            self._publish(publisher, msg)
            self._others += 1
        else:
            self._said[publisher.topic_name] = msg
        self._say()

    def _say(self) -> None:
        """Send to the others what is due now, if the publishers are there."""
        due, now = self._due, self._scheduler.agenda.now
        while due and due[0][0] <= self._others and due[0][1].time <= now:
            message = due[0][1]
            publisher = self._publisher(message.speaker)
            if publisher is None and message.time == now:
                return
            due.popleft()
            if publisher is not None:
                self._publish(publisher, message.data)

    def _publisher(self, speaker: Speaker) -> Publisher | None:
        for node in self._scheduler.existing:
            if node.get_fully_qualified_name() == speaker.node:
                same = [one for one in node.publishers if one.topic_name == speaker.topic]
                return same[speaker.number] if speaker.number < len(same) else None
        return None
