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

"""Checks of the graph around a node for `ParameterizedNode.watch`.

A check returns a line for the log with the remedy, or None. It takes some microseconds, and some ten
beside a hundred robots.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from rclpy.node import Node

from diffdrive_jacobian.messages.names import node_of, type_name
from diffdrive_jacobian.messages.topic_faults import ALTERNATING, TopicFault
from diffdrive_jacobian.messages.topics import TOPICS
from diffdrive_jacobian.text import printable

Check: TypeAlias = Callable[[], str | None]

ALTERNATION_PATIENCE = 3
"""Number of checks with alternating commands before that is reported: a driver may take over."""
TYPE_PATIENCE = 3
"""Number of checks with another type before that is reported: the name of its node may come later."""
MIN_FALLS = 2
"""Number of falls of the sequence numbers within a second that no restarted publisher explains."""


class LastingFault:
    """A fault that counts only after several checks: the order in which nodes start must not matter."""

    def __init__(self, patience: int) -> None:
        """Start without the fault. It is reported after `patience` consecutive checks that find it."""
        self._patience = patience
        self._present: str | None = None
        self._checks = 0

    def check(self, present: str | None) -> str | None:
        """Return the fault that is present at this check if it is to be reported now."""
        if present != self._present:
            self._present, self._checks = present, 0
        self._checks += 1
        return present if self._checks == self._patience else None


def topic_check(
    node: Node, fault: TopicFault, name: str, readers: Callable[[], int] | None = None
) -> Check:
    """Return a check for a fault of a topic.

    Args:
        node: The node that publishes the topic or is subscribed to it.
        fault: The fault.
        name: Name of the topic as the node gives it, before it is remapped.
        readers: Returns the number of subscriptions that count. None: all in the graph do.
    """
    topic = node.resolve_topic_name(name)

    def check() -> str | None:
        subscriptions = node.count_subscribers(topic) if readers is None else readers()
        if not fault.present(node.count_publishers(topic), subscriptions):
            return None
        return fault.logged(topic, TOPICS[name], publishers_of(node, topic))

    return check


class Interleaving:
    """Detects several publishers whose messages alternate, by the sequence numbers of the messages.

    The numbers of one publisher increase. Where messages of two of them alternate, they fall again and
    again. A publisher that is restarted lets them fall once.
    """

    def __init__(self) -> None:
        """Start without messages."""
        self.number: int | None = None
        """Sequence number of the present message. None: the middleware has none."""
        self._last = -1
        self._falls = 0

    def count(self) -> None:
        """Count the present message."""
        number = self.number
        if number is not None:
            if number <= self._last:
                self._falls += 1
            self._last = number

    def falls(self) -> int:
        """Return how often the numbers did not increase since the last call."""
        falls, self._falls = self._falls, 0
        return falls


def alternating_commands(node: Node, name: str, commands: Interleaving) -> Check:
    """Return a check whether the commands that are not zero on a topic alternate."""
    several = topic_check(node, ALTERNATING, name)
    return lambda: several() if commands.falls() >= MIN_FALLS else None


def wrong_type(node: Node, name: str, message: type, *, subscribed: bool) -> Check:
    """Return a check whether other nodes use a topic with other types, which ROS does not report.

    Args:
        node: The node that publishes the topic or is subscribed to it.
        name: Name of the topic as the node gives it, before it is remapped.
        message: Type of its messages.
        subscribed: Whether the node is subscribed. Otherwise it publishes.
    """
    topic, wanted = node.resolve_topic_name(name), type_name(message)
    they_do, this_does = ('publishes', 'subscribes to') if subscribed else ('subscribes to', 'publishes')

    def check() -> str | None:
        ends = node.get_publishers_info_by_topic if subscribed else node.get_subscriptions_info_by_topic
        others = {one.topic_type: printable(node_of(one)) for one in ends(topic)}
        lines = []
        for theirs, other in sorted(others.items()):
            twists = 'Twist' in wanted and 'Twist' in theirs
            hint = '; enable_stamped_cmd_vel selects Twist or TwistStamped' if twists else ''
            if theirs != wanted:
                lines.append(
                    f'{other} {they_do} {topic} as {printable(theirs)}, but this node {this_does} it as '
                    f'{wanted}: no message will arrive{hint}'
                )
        return '\n'.join(lines) or None

    return check


def publishers_of(node: Node, topic: str, *, others: bool = False) -> list[str]:
    """Return the fully qualified names of the nodes that publish a topic, sorted.

    Args:
        node: The node that asks.
        topic: Name of the topic.
        others: Whether to leave out one publisher of the node itself.
    """
    names = sorted(printable(node_of(one)) for one in node.get_publishers_info_by_topic(topic))
    own = node.get_fully_qualified_name()
    if others and own in names:
        names.remove(own)
    return names
