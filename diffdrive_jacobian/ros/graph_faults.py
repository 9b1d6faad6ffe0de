"""Checks of the graph around a node for `ParameterizedNode.watch`.

A check returns a line for the log with the remedy, or None, and costs microseconds unless there is a
fault. The `SharedGraph` must be refreshed before.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar
from weakref import WeakKeyDictionary

from rclpy.context import Context
from rclpy.node import Node

from diffdrive_jacobian.messages.names import node_of, type_name
from diffdrive_jacobian.messages.topic_faults import ALTERNATING, TopicFault
from diffdrive_jacobian.messages.topics import TOPICS
from diffdrive_jacobian.ros.rclpy_internals import graph_changed
from diffdrive_jacobian.text import printable

Check: TypeAlias = Callable[[], str | None]
T = TypeVar('T')

MAX_AGE = 0.1
"""`max_age` of periodic checks that need not be reproducible (s)."""
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


class _Snapshot:
    """Results of queries of the graph since its last change, shared by the nodes of a context."""

    def __init__(self) -> None:
        self.results: dict[str, Any] = {}
        self.refreshed = -math.inf


_lock = threading.Lock()
_snapshots: WeakKeyDictionary[Context, _Snapshot] = WeakKeyDictionary()


class SharedGraph:
    """Topics in the graph of a node, by their fully qualified names after remapping.

    `refresh` must be called before results are used. It notices the changes since the last call for any
    node of the context.
    """

    def __init__(self, node: Node) -> None:
        """Share the snapshot of the context of a node."""
        self._node = node
        # All nodes must share one object: a change is signaled once.
        with _lock:
            self._snapshot = _snapshots.setdefault(node.context, _Snapshot())

    def refresh(self, max_age: float = 0.0) -> None:
        """Discard the results if the graph has changed.

        Args:
            max_age: For how long they are valid without looking for changes (wall time, s). To look for
                them takes 0.03 to 0.15 ms.
        """
        snapshot, now = self._snapshot, time.monotonic()
        if now - snapshot.refreshed >= max_age:
            snapshot.refreshed = now
            if graph_changed(self._node):
                # Replaced, not cleared: another thread may still add a result to the previous ones.
                snapshot.results = {}

    def count_publishers(self, topic: str) -> int:
        """Return the number of publishers of a topic."""
        return self._query(f'to {topic}', lambda: int(self._node.count_publishers(topic)))

    def count_subscriptions(self, topic: str) -> int:
        """Return the number of subscriptions to a topic."""
        return self._query(f'from {topic}', lambda: int(self._node.count_subscribers(topic)))

    def types(self) -> dict[str, list[str]]:
        """Return the types of all topics, by name."""
        return self._query('types', lambda: dict(self._node.get_topic_names_and_types()))

    def _query(self, what: str, query: Callable[[], T]) -> T:
        results = self._snapshot.results
        if what not in results:
            results[what] = query()
        found: T = results[what]
        return found


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
    graph, topic = SharedGraph(node), node.resolve_topic_name(name)

    def check() -> str | None:
        subscriptions = graph.count_subscriptions(topic) if readers is None else readers()
        if not fault.present(graph.count_publishers(topic), subscriptions):
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
    graph, topic, wanted = SharedGraph(node), node.resolve_topic_name(name), type_name(message)
    they_do, this_does = ('publishes', 'subscribes to') if subscribed else ('subscribes to', 'publishes')

    def check() -> str | None:
        if graph.types().get(topic) in (None, [wanted]):
            return None
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
