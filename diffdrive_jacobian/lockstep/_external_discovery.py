"""What is still to be discovered before nodes in other processes can take part."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from rclpy.node import Node

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._external_expectations import Due
from diffdrive_jacobian.lockstep._external_graph import UNKNOWN, ExternalGraph, node_name
from diffdrive_jacobian.lockstep._external_probe import Probe
from diffdrive_jacobian.messages.topics import CLOCK, NOT_OF_ROBOTS

UNTIMED = 2.0
"""Time for which a node that lacks nothing but the time is waited for (s)."""


class Discovery:
    """The endpoints of the world and those of external nodes."""

    def __init__(self, graph: ExternalGraph, nodes: Sequence[Node]) -> None:
        """Take the present nodes of the world."""
        self._graph = graph
        self._nodes = nodes

    def endpoints(self) -> frozenset[object]:
        """Return the publishers and subscriptions of the world."""
        return frozenset(
            endpoint
            for node in self._nodes
            for endpoints in (node.publishers, node.subscriptions)
            for endpoint in endpoints
            if endpoint.topic_name not in NOT_OF_ROBOTS
        )

    def awaited_nodes(self, expected: Sequence[Due], probes: Sequence[Probe]) -> set[str]:
        """Return the names of the external nodes from which something is awaited."""
        infos = [info for one in expected for info in self._graph.publishers(one.topic)]
        return {node_name(info) for info in infos} | {probe.name for probe in probes}

    def missing(
        self, expected: Sequence[Due], probes: Sequence[Probe], topics: Collection[str]
    ) -> tuple[list[str], list[str]]:
        """Return what is missing of the nodes, and which of them are not subscribed to /clock.

        Args:
            expected: What is due.
            probes: Requests to the nodes that are to be idle.
            topics: Topics from which the world is to receive messages.

        Raises:
            LockstepError: Another process publishes /clock.
        """
        if others := self._graph.publishers(CLOCK):
            raise LockstepError(f'{node_name(others[0])} publishes {CLOCK}, which only lockstep may do')
        found = [text for one in expected for text in self._missing_topics(one)]
        found += [f'no external node provides {probe.service}' for probe in probes if not probe.ready()]
        found += self._unmatched(topics)
        timed = {node_name(info) for info in self._graph.subscriptions(CLOCK)}
        untimed = [
            f'{name} is not subscribed to {CLOCK}: its parameter use_sim_time must be true'
            for name in sorted(self.awaited_nodes(expected, probes) - timed)
        ]
        return list(dict.fromkeys(found)), untimed

    def _missing_topics(self, one: Due) -> Iterator[str]:
        publishers = self._graph.publishers(one.topic)
        if not publishers:
            yield f'no external node publishes {one.topic}'
        if any(info.node_name == UNKNOWN for info in publishers):
            yield f'the name of the node that publishes {one.topic} is not known'
        if one.question and not self._graph.subscriptions(one.question):
            yield f'no external node is subscribed to {one.question}'

    def _unmatched(self, awaited: Collection[str]) -> Iterator[str]:
        """Yield what the endpoints of the world lack."""
        for node in self._nodes:
            for publisher in node.publishers:
                if self._graph.subscriptions(publisher.topic_name):
                    yield from self._graph.unmatched_publisher(publisher)
            for subscription in node.subscriptions:
                if subscription.topic_name in awaited:
                    yield from self._graph.unmatched_subscription(node, subscription)
