"""Topics in the graph, queried once after each change of the graph for all nodes of a context.

A query of rcl takes time proportional to the number of publishers or subscriptions in the graph. If each
node queried for itself once a second, a hundred robots in one process would need a quarter of a core for
that. rcl signals changes, so nothing is queried while the graph stays the same.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from weakref import WeakKeyDictionary

from rclpy.context import Context
from rclpy.node import Node

from diffdrive_jacobian.ros.rclpy_internals import graph_changed

MAX_AGE = 0.1
"""`max_age` of periodic checks that need not be reproducible (s)."""


class Snapshot:
    """What was queried since the last change of the graph. Another change leads to another object."""

    def __init__(self) -> None:
        """Start without results of queries."""
        self.publishers: dict[str, int] = {}
        """Numbers of publishers by topic, as far as they were queried."""
        self.subscriptions: dict[str, int] = {}
        """Numbers of subscriptions by topic, as far as they were queried."""
        self.types: dict[str, list[str]] | None = None
        """Types of all topics by name; None: not queried."""


class _Latest:
    """The latest snapshot of a context."""

    def __init__(self) -> None:
        self.snapshot = Snapshot()
        self.refreshed = -math.inf


class SharedGraph:
    """Topics in the graph of a node, by their fully qualified names after remapping.

    `refresh` must be called before results are used. It notices the changes since the last call for any
    node of the context.
    """

    def __init__(self, node: Node) -> None:
        """Share the snapshot of a node's context.

        Args:
            node: The node that queries.
        """
        self._node = node
        # All nodes must share one object: a change is signaled once.
        with _lock:
            self._latest = _latest_of.setdefault(node.context, _Latest())

    def refresh(self, max_age: float = 0.0) -> Snapshot:
        """Discard the snapshot if the graph has changed. Return the valid one.

        Args:
            max_age: For how long a snapshot is valid without looking for changes (wall time, s). To look
                for them takes 0.03 to 0.15 ms.
        """
        latest, now = self._latest, time.monotonic()
        if now - latest.refreshed >= max_age:
            latest.refreshed = now
            if graph_changed(self._node):
                # Replaced, not cleared: another thread may still add a result to the previous one.
                latest.snapshot = Snapshot()
        return latest.snapshot

    def count_publishers(self, topic: str) -> int:
        """Return the number of publishers of a topic."""
        return _known(self._latest.snapshot.publishers, topic, self._node.count_publishers)

    def count_subscriptions(self, topic: str) -> int:
        """Return the number of subscriptions to a topic."""
        return _known(self._latest.snapshot.subscriptions, topic, self._node.count_subscribers)

    def types(self) -> dict[str, list[str]]:
        """Return the types of all topics, by name."""
        snapshot = self._latest.snapshot
        if snapshot.types is None:
            snapshot.types = dict(self._node.get_topic_names_and_types())
        return snapshot.types


def _known(counts: dict[str, int], topic: str, query: Callable[[str], int]) -> int:
    count = counts.get(topic)
    if count is None:
        count = counts[topic] = query(topic)
    return count


_lock = threading.Lock()
_latest_of: WeakKeyDictionary[Context, _Latest] = WeakKeyDictionary()
