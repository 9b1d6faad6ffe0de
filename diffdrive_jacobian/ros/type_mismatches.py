"""Topics that another node uses with another type, which ROS does not report."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

from diffdrive_jacobian.messages.names import node_of
from diffdrive_jacobian.ros.shared_graph import SharedGraph, Snapshot
from diffdrive_jacobian.text import printable

NAME_PATIENCE = 3
"""Number of checks for the name of a node before it is reported without one."""


class TypeMismatches:
    """Logs each mismatch of the types of a node's topics once."""

    def __init__(self, node: Node) -> None:
        """Start without topics.

        Args:
            node: The node that has the topics.
        """
        self._node = node
        self._graph = SharedGraph(node)
        self._matching: Snapshot | None = None
        self._topics: list[tuple[str, str, bool]] = []
        self._mismatches: dict[tuple[str, str, str], int] = {}
        self._reported: set[tuple[str, str, str]] = set()

    def add(self, topic: str, kind: str, *, subscribed: bool) -> None:
        """Add a topic with its type, to which the node is subscribed, or which it publishes."""
        self._topics.append((topic, kind, subscribed))

    def check(self, snapshot: Snapshot) -> None:
        """Compare the types with those in the graph, and log mismatches that are new.

        Args:
            snapshot: That of the graph at present. Nothing is compared twice with the same one, unless
                there are mismatches.
        """
        if snapshot is self._matching:
            return
        node = self._node
        mismatches: dict[tuple[str, str, str], int] = {}
        types = self._graph.types()
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
        self._matching = None if mismatches else snapshot
        self._mismatches = mismatches
        self._reported &= mismatches.keys()

    def _report(self, mismatch: tuple[str, str, str], other: Any, subscribed: bool) -> None:
        name, wanted, theirs = mismatch
        node = printable(node_of(other))
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
