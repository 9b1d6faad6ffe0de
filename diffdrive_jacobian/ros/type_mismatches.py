"""Topics that another node uses with another type, which ROS does not report."""

from __future__ import annotations

import math
import time
from typing import Any
from weakref import WeakKeyDictionary

from rclpy.context import Context
from rclpy.node import Node

from diffdrive_jacobian.text import printable

NAME_PATIENCE = 3
"""Number of checks for the name of a node before it is reported without one."""
MAX_AGE = 0.5
"""Longest time for which the nodes of a context share the result of a query (s)."""


class TypeMismatches:
    """Logs each mismatch of the types of a node's topics once."""

    def __init__(self, node: Node) -> None:
        """Start without topics.

        Args:
            node: The node that has the topics.
        """
        self._node = node
        self._topics: list[tuple[str, str, bool]] = []
        self._mismatches: dict[tuple[str, str, str], int] = {}
        self._reported: set[tuple[str, str, str]] = set()

    def add(self, topic: str, kind: str, *, subscribed: bool) -> None:
        """Add a topic with its type, to which the node is subscribed, or which it publishes."""
        self._topics.append((topic, kind, subscribed))

    def check(self) -> None:
        """Compare the types with those in the graph, and log mismatches that are new."""
        node = self._node
        mismatches: dict[tuple[str, str, str], int] = {}
        types = _topic_types(node)
        for topic, wanted, subscribed in self._topics:
            name = node.resolve_topic_name(topic)
            if types.get(name) == [wanted]:
                continue
            endpoints = (
                node.get_publishers_info_by_topic if subscribed else node.get_subscriptions_info_by_topic
            )
            for other in endpoints(name):
                mismatch = (name, wanted, other.topic_type)
                if other.topic_type == wanted or mismatch in mismatches:
                    continue
                mismatches[mismatch] = self._mismatches.get(mismatch, 0) + 1
                # The name of a node may be discovered later than its topics.
                named = not other.node_name.startswith('_') or mismatches[mismatch] == NAME_PATIENCE
                if named and mismatch not in self._reported:
                    self._reported.add(mismatch)
                    self._report(mismatch, other, subscribed)
        self._mismatches = mismatches
        self._reported &= mismatches.keys()

    def _report(self, mismatch: tuple[str, str, str], other: Any, subscribed: bool) -> None:
        name, wanted, theirs = mismatch
        node = printable(f'{other.node_namespace.rstrip("/")}/{other.node_name}')
        they_do, this_does = (
            ('publishes', 'subscribes to') if subscribed else ('subscribes to', 'publishes')
        )
        hint = ''
        if 'Twist' in wanted and 'Twist' in theirs:
            hint = '; enable_stamped_cmd_vel selects Twist or TwistStamped'
        self._node.get_logger().error(
            f'{node} {they_do} {name} as {printable(theirs)}, but this node {this_does} it as {wanted}: '
            f'no message will arrive{hint}'
        )


def _topic_types(node: Node) -> dict[str, list[str]]:
    """Return the types of all topics in the graph, by name.

    The nodes of a context share the result. A query takes time proportional to the number of topics, so
    with many nodes in a process the queries would cost more than the nodes.
    """
    now = time.monotonic()
    queried, types = _topic_types_of.get(node.context, (-math.inf, {}))
    if now - queried > MAX_AGE:
        types = dict(node.get_topic_names_and_types())
        _topic_types_of[node.context] = now, types
    return types


_topic_types_of: WeakKeyDictionary[Context, tuple[float, dict[str, list[str]]]] = WeakKeyDictionary()
