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

"""What the nodes of another process offer and use, as the graph of its ROS domain shows it."""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._wall_time import INFINITE
from diffdrive_jacobian.messages.names import full_name, node_of
from diffdrive_jacobian.messages.topics import OF_EVERY_NODE, PARAMETER_EVENTS
from diffdrive_jacobian.time_units import NANOSECONDS

UNKNOWN = '_NODE_NAME_UNKNOWN_'
"""Name of a node whose endpoints have been discovered before its name."""
CLOCK_TYPE = 'rosgraph_msgs/msg/Clock'
DESCRIPTIONS = 'type_description_interfaces/'
"""Package of the type of a service that every node has, and that only tools call."""
APART = 'lockstep'
"""Namespace, below the name of a node, of the topics that only this node of its process has."""


class Quality(NamedTuple):
    """What decides whether two ends of a topic match."""

    reliability: ReliabilityPolicy
    durability: DurabilityPolicy
    deadline: int
    """Longest period between two messages (ns)."""
    liveliness: LivelinessPolicy
    lease: int
    """Lease duration of the liveliness (ns)."""
    lifespan: int
    """For how long a message is valid (ns), which decides nothing but is warned of."""

    def __str__(self) -> str:
        """Return the policies, and the durations that have a limit."""
        limits = (('deadline', self.deadline), ('lease duration', self.lease))
        return ' and '.join(
            [
                self.reliability.name,
                self.durability.name,
                *(f'{name} {limit / NANOSECONDS:g} s' for name, limit in limits if limit < INFINITE),
            ]
        )

    def profile(self, depth: int) -> QoSProfile:
        """Return the profile with a depth, which the graph does not show."""
        return QoSProfile(
            depth=depth,
            reliability=self.reliability,
            durability=self.durability,
            deadline=Duration(nanoseconds=self.deadline),
            liveliness=self.liveliness,
            liveliness_lease_duration=Duration(nanoseconds=self.lease),
            lifespan=Duration(nanoseconds=self.lifespan),
        )


class NodeGraph(NamedTuple):
    """What a node of another process has. Names of topics and services with their types."""

    name: str
    namespace: str
    publishers: dict[str, str]
    subscriptions: dict[str, str]
    services: dict[str, str]
    clients: dict[str, str]

    @property
    def full_name(self) -> str:
        """Fully qualified name."""
        return full_name(self.namespace, self.name)

    @property
    def topics(self) -> set[str]:
        """Names of the topics that it publishes or is subscribed to."""
        return {*self.publishers, *self.subscriptions}

    def name_in_world(self, topic: str) -> str:
        """Return the name of a topic without what the rules of `rules_apart` have put before it."""
        before = f'{self.full_name}/{APART}'
        return topic.removeprefix(before) if topic.startswith(f'{before}/') else topic


def shared_topics(nodes: Sequence[NodeGraph]) -> list[str]:
    """Return the topics that several nodes have, and to which at least one of them is subscribed."""
    heard = {topic for node in nodes for topic in node.subscriptions}
    counts = Counter(topic for node in nodes for topic in node.topics)
    return sorted(topic for topic in heard if counts[topic] > 1)


def rules_apart(topics: Iterable[str]) -> list[str]:
    """Return arguments that give each node of a process topics of its own, below its name."""
    return ['--ros-args', *(word for topic in topics for word in ('-r', f'{topic}:=~/{APART}{topic}'))]


def nodes_beside(node: Node, without: Collection[str] = ()) -> list[NodeGraph]:
    """Return the other nodes in the domain of a node, by their names, without some topics."""
    own = node.get_name(), node.get_namespace()
    found = []
    for name, namespace in sorted(node.get_node_names_and_namespaces()):
        if name == UNKNOWN or (name, namespace) == own:
            continue
        parts = [
            {topic: types[0] for topic, types in sorted(names(name, namespace))}
            for names in (
                node.get_publisher_names_and_types_by_node,
                node.get_subscriber_names_and_types_by_node,
                node.get_service_names_and_types_by_node,
                node.get_client_names_and_types_by_node,
            )
        ]
        for topics in parts[:2]:
            # They stay within the process.
            for topic in OF_EVERY_NODE:
                topics.pop(topic, None)
        for services in parts[2:]:
            for service in [one for one, kind in services.items() if kind.startswith(DESCRIPTIONS)]:
                del services[service]
        graph = NodeGraph(name, namespace, *parts)
        for topics in parts[:2]:
            for topic in [one for one in topics if graph.name_in_world(one) in without]:
                del topics[topic]
        found.append(graph)
    return found


def marks(node: Node) -> dict[str, bytes]:
    """Return for the nodes in the domain of a node an id that differs if they are created anew.

    It is that of the publisher of parameter events, which a node has from its beginning to its end.
    """
    found = node.get_publishers_info_by_topic(PARAMETER_EVENTS)
    return {node_of(info): bytes(info.endpoint_gid) for info in found}


def qualities_of(infos: Iterable[TopicEndpointInfo], node: str) -> set[Quality]:
    """Return the qualities of service of the endpoints of a node."""
    profiles = [info.qos_profile for info in infos if node_of(info) == node]
    return {
        Quality(
            profile.reliability,
            profile.durability,
            profile.deadline.nanoseconds,
            profile.liveliness,
            profile.liveliness_lease_duration.nanoseconds,
            profile.lifespan.nanoseconds,
        )
        for profile in profiles
    }


def import_type(name: str, used_by: str) -> Any:
    """Return the class of the type of a topic or service.

    Raises:
        LockstepError: It is not installed for Python. `used_by` says in the message what uses it.
    """
    package, kind, member = name.split('/')
    action, _, part = member.partition('_')
    try:
        module = importlib.import_module(f'{package}.{kind}')
        if kind != 'action' or not part:
            return getattr(module, member)
        implementation = getattr(module, action).Impl
        suffix = '' if part == 'FeedbackMessage' else 'Service'
        return getattr(implementation, part + suffix)
    except (ImportError, AttributeError) as error:
        raise LockstepError(
            f'the type {name} of {used_by} cannot be imported in Python: {error}; source the setup file '
            'of the workspace that has it before pytest is started'
        ) from error
