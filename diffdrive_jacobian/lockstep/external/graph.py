"""The endpoints of other processes, and what is still to be discovered before they can take part."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence

from rclpy.duration import Infinite
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSProfile,
)
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from diffdrive_jacobian.diagnosis.graph import Quality, mismatch
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep.external.expectations import Due
from diffdrive_jacobian.lockstep.external.waiting import Probe
from diffdrive_jacobian.messages.names import node_of, type_name
from diffdrive_jacobian.messages.topics import CLOCK, NOT_OF_ROBOTS, OF_EVERY_NODE
from diffdrive_jacobian.time_units import NANOSECONDS

UNKNOWN = '_NODE_NAME_UNKNOWN_'
"""Name of a node whose endpoints have been discovered before its name."""
UNTIMED = 2.0
"""Time for which a node that lacks nothing but the time is waited for (s)."""
PARTICIPANT = 12
"""Number of bytes at the start of a GID that are those of the participant."""


class ExternalGraph:
    """Publishers and subscriptions in other processes."""

    def __init__(self, node: Node) -> None:
        """Find out the participant of this process.

        Args:
            node: A node that publishes /clock, before any other is discovered.
        """
        self._node = node
        (clock, *_) = node.get_publishers_info_by_topic(CLOCK)
        self._own = bytes(clock.endpoint_gid)[:PARTICIPANT]

    def publishers(self, topic: str) -> list[TopicEndpointInfo]:
        """Return the external publishers of a topic."""
        return self._external(self._node.get_publishers_info_by_topic(topic))

    def subscriptions(self, topic: str) -> list[TopicEndpointInfo]:
        """Return the external subscriptions of a topic."""
        return self._external(self._node.get_subscriptions_info_by_topic(topic))

    def _external(self, infos: Iterable[TopicEndpointInfo]) -> list[TopicEndpointInfo]:
        return [info for info in infos if bytes(info.endpoint_gid)[:PARTICIPANT] != self._own]

    def published_topics(self) -> list[str]:
        """Return the topics that external nodes publish, without those of every node."""
        names = (name for name, _ in self._node.get_topic_names_and_types())
        return [name for name in names if name not in OF_EVERY_NODE and self.publishers(name)]

    def subscribed_nodes(self, topic: str) -> set[str]:
        """Return the names of the external nodes that are subscribed to a topic."""
        return {node_of(info) for info in self.subscriptions(topic)}

    def topics_of(self, node: str) -> list[str]:
        """Return the topics that an external node publishes, without those of every node."""
        return [
            name
            for name in self.published_topics()
            if any(node_of(info) == node for info in self.publishers(name))
        ]

    def unmatched_publisher(self, publisher: Publisher) -> Iterator[str]:
        """Yield what a publisher of the world still lacks."""
        topic = publisher.topic_name
        infos = self._node.get_subscriptions_info_by_topic(topic)
        wanted = sum(compatible(publisher.qos_profile, info.qos_profile) for info in infos)
        matched = publisher.get_subscription_count()
        if matched < wanted:
            yield f'the publisher of {topic} is matched with {matched} of {wanted} subscriptions'

    def unmatched_subscription(self, node: Node, subscription: Subscription) -> Iterator[str]:
        """Yield what a subscription of the world still lacks, or why it cannot be matched."""
        topic, requested = subscription.topic_name, subscription.qos_profile
        infos = self._node.get_publishers_info_by_topic(topic)
        where = f'the subscription of {node.get_fully_qualified_name()} to {topic}'
        own_type = type_name(subscription.msg_type)
        for info in self._external(infos):
            if info.topic_type != own_type:
                yield f'{where} is of type {own_type}, the publisher of {info.topic_type}'
                return
            if not compatible(info.qos_profile, requested):
                yield (
                    f'{where} and its publisher have incompatible QoS: {qos_name(requested)}, and '
                    f'{qos_name(info.qos_profile)}'
                )
                return
        wanted = sum(compatible(info.qos_profile, requested) for info in infos)
        matched = subscription.get_publisher_count()
        if matched < wanted:
            yield f'{where} is matched with {matched} of {wanted} publishers'


def compatible(offered: QoSProfile, requested: QoSProfile) -> bool:
    """Return whether a publisher and a subscription with these profiles are matched."""
    return not mismatch(Quality.of(offered), Quality.of(requested))


def qos_name(profile: QoSProfile) -> str:
    """Return what decides whether a profile is compatible, in words."""
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    words = [profile.reliability.name.lower(), 'transient local' if latched else 'volatile']
    if profile.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC:
        words.append('liveliness manual by topic')
    for name, limit in (
        ('lease', profile.liveliness_lease_duration),
        ('deadline', profile.deadline),
    ):
        # 0 and infinite: there is none.
        if 0 < limit.nanoseconds < Infinite.nanoseconds:
            words.append(f'{name} {limit.nanoseconds / NANOSECONDS:g} s')
    return ', '.join(words)


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
        return {node_of(info) for info in infos} | {probe.name for probe in probes}

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
            raise LockstepError(f'{node_of(others[0])} publishes {CLOCK}, which only lockstep may do')
        found = [text for one in expected for text in self._missing_topics(one)]
        found += [f'no external node provides {probe.service}' for probe in probes if not probe.ready()]
        found += self._unmatched(topics)
        timed = {node_of(info) for info in self._graph.subscriptions(CLOCK)}
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
