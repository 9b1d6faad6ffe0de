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

"""All links of a world.

Within a process Fast DDS puts a message into the queues of its subscriptions before `publish` returns.
So whoever observes `Publisher.publish` knows which subscriptions may have received something, and in
which order. The messages are taken from there directly: an event of the EventsExecutor takes several
times as long. A further subscription for each topic would cost as much as the run, and change the number
of subscriptions, which nodes may query.

Messages are not copied, so one that its node modifies after publishing is reported as modified.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Container, Iterable
from functools import partial
from itertools import count
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription

from diffdrive_jacobian.lockstep._clock import Agenda, Clocks
from diffdrive_jacobian.lockstep._gate import Gates, send_unless_destroyed
from diffdrive_jacobian.lockstep._link import Delivered, Link, Published, Source, Stage
from diffdrive_jacobian.lockstep._services import Member
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS
from diffdrive_jacobian.ros.rclpy_internals import (
    RCLError,
    message_receiver,
    message_taker,
    raw_sender,
    wrap_publish,
)

__tracebackhide__ = True

StageOf = Callable[[Link], Stage | None]
"""Returns the stage of a fault, or of a process, in a link; None: it does not affect it."""


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


class Links:
    """The links of a world: who publishes, who receives, and what waits in which order."""

    def __init__(self, agenda: Agenda, gates: Gates, clocks: Clocks) -> None:
        """Start without links.

        Args:
            agenda: What happens later.
            gates: The gates of the nodes.
            clocks: The clocks of the nodes.
        """
        self._agenda, self._gates, self._clocks = agenda, gates, clocks
        self.pending: deque[Link | None] = deque()
        """One entry for each message and link. None: a request or a response of a service."""
        self.thread = threading.get_ident()
        """The thread of the nodes."""
        self.elsewhere: dict[Any, SentElsewhere] = {}
        """What another thread has sent last, by publisher, client or service."""
        self.unaffected: set[Publisher] = set()
        """Publishers of the world itself, whose messages no fault affects."""
        self._sources: dict[Publisher, Source] = {}
        self._links: dict[Subscription, Link] = {}
        self._by_topic: dict[str, list[Link]] = {}
        self._published: dict[str, list[Published]] = {}
        self._delivered: dict[str, list[Delivered]] = {}
        self._admitted: set[Link] = set()
        self.polled: list[Link] = []
        """Links whose topic has publishers that cannot be observed."""
        self._stages_of: list[StageOf] = []
        self._numbers = count(1)
        self._restore: Callable[[], None] | None = None

    def to(self, topic: str) -> list[Link]:
        """Return the links of a topic. The list stays up to date."""
        return self._by_topic.setdefault(topic, [])

    def observers_of_published(self, topic: str) -> list[Published]:
        """Return the functions that are called after each message of a topic is sent."""
        return self._published.setdefault(topic, [])

    def observers_of_delivered(self, topic: str) -> list[Delivered]:
        """Return the functions that are called before each message of a topic is received."""
        return self._delivered.setdefault(topic, [])

    def add_stages(self, stage_of: StageOf, *, first: bool = False) -> None:
        """Add the stage of a fault to all links that it affects, now and later.

        Args:
            stage_of: Returns the stage.
            first: Whether it is the first stage of later links.
        """
        self._stages_of.insert(0 if first else len(self._stages_of), stage_of)
        for link in self._links.values():
            if (stage := stage_of(link)) is not None:
                link.add_stage(stage)

    # --- Sending

    def start(self, note_thread: Callable[..., None]) -> None:
        """Start to observe what is published.

        Args:
            note_thread: Called in other threads, as `Scheduler.note_thread`.
        """
        links, sources, gates, clocks = self, self._sources, self._gates, self._clocks
        numbers = self._numbers
        extend, thread, get_ident = self.pending.extend, self.thread, threading.get_ident

        def sending(publish: Callable[..., None]) -> Callable[..., None]:
            def send(self: Publisher, msg: Any) -> None:
                if get_ident() != thread:
                    topic = self.topic_name
                    heard = bool(links.to(topic) or links.observers_of_published(topic))
                    note_thread(self, f'publishes {topic}', heard=heard and topic not in NOT_OF_ROBOTS)
                try:
                    source = sources[self]
                except KeyError:
                    source = links._source_of(self)
                if gates.running is not None and self not in links.unaffected:
                    # When the time of the callback is over.
                    data = msg if isinstance(msg, bytes) else serialize_message(msg)
                    gates.running.leave(partial(send_unless_destroyed, self.publish, data))
                    return
                if type(msg) is bytes:
                    # Without the two calls of `Publisher.publish`.
                    try:
                        source.send(msg)
                    except RCLError:
                        # It raises what it raises for a publisher that was destroyed.
                        publish(self, msg)
                else:
                    publish(self, msg)
                source.count += 1
                source.last = next(numbers), clocks.now, msg
                extend(source.links)
                if source.observers:
                    for observer in source.observers:
                        observer(self, msg)

            return send

        self._restore = wrap_publish(sending)

    def _source_of(self, publisher: Publisher) -> Source:
        """Return the source of a publisher that publishes for the first time."""
        topic = publisher.topic_name
        links, observers = self.to(topic), self.observers_of_published(topic)
        source = Source(topic, publisher.msg_type, links, observers, raw_sender(publisher))
        self._sources[publisher] = source
        return source

    # --- Receiving

    def update(
        self,
        members: Iterable[Member],
        without: Container[Subscription] = (),
        publishers: Iterable[Publisher] = (),
    ) -> list[Link]:
        """Serve the present subscriptions of the nodes.

        Args:
            members: The nodes.
            without: Subscriptions that are not served.
            publishers: All publishers of the context that can be observed.

        Returns:
            Those that wait for `admit`.
        """
        known, self._links = self._links, {}
        for member in members:
            for subscription in member.node.subscriptions:
                if subscription in without:
                    continue
                link = known.pop(subscription, None)
                self._links[subscription] = link or self._link(subscription, member)
        for link in known.values():
            link.close()
        self._admitted.intersection_update(self._links.values())
        observable = Counter(publisher.topic_name for publisher in publishers)
        self.polled = [
            link
            for link in self._links.values()
            if link.owner.count_publishers(link.topic) > observable[link.topic]
        ]
        for links in self._by_topic.values():
            links.clear()
        for link in self._links.values():
            self.to(link.topic).append(link)
        return [link for link in self._links.values() if link not in self._admitted]

    def _link(self, subscription: Subscription, member: Member) -> Link:
        """Return a new link to a subscription."""
        take, release = message_taker(subscription)
        link = Link(
            subscription,
            member.node,
            gate=member.gate,
            agenda=self._agenda,
            pending=self.pending,
            observers=self.observers_of_delivered(subscription.topic_name),
            take=take,
            receive=message_receiver(subscription),
            create_task=member.create_task,
            release=release,
        )
        for stage_of in self._stages_of:
            if (stage := stage_of(link)) is not None:
                link.add_stage(stage)
        return link

    def drop_destroyed(self, nodes: Iterable[Node]) -> None:
        """Deliver nothing more to subscriptions that the nodes do not have any more."""
        present = {subscription for node in nodes for subscription in node.subscriptions}
        for subscription in self._links.keys() - present:
            self._links.pop(subscription).close()

    def admit(self, link: Link) -> None:
        """Deliver the messages that a new subscription has received before."""
        while link.deliver():
            pass
        self._admitted.add(link)

    def poll(self) -> bool:
        """Deliver one message of each subscription that is polled. Return whether there was one.

        rcl itself publishes some messages, for example the status of actions, which nobody can observe.
        """
        found = False
        for link in self.polled:
            found |= link.deliver()
        return found

    def close(self) -> None:
        """Stop to observe what is published."""
        if self._restore is not None:
            self._restore()

    # --- What has happened

    def sources(self) -> list[tuple[Publisher, Source]]:
        """Return all sources with messages, with their publishers."""
        return [pair for pair in self._sources.items() if pair[1].count]

    def last(self, topic: str) -> Any:
        """Return the last message of a topic as it was received; None: there is none."""
        sources = [source for _, source in self.sources() if source.topic == topic]
        return max(sources, key=lambda source: source.last[0]).received() if sources else None
