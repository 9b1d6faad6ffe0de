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

"""What is known of the nodes of a process: each has a stand-in, each topic and service a relay.

The graph of the domain tells it. What must not be, because runs would differ, is an error here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.task import Future
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep.external import graph as graphs
from diffdrive_jacobian.lockstep.external import relays
from diffdrive_jacobian.lockstep.external.domain import Domain
from diffdrive_jacobian.lockstep.external.relays import CALL, INPUT, SERVICE, TOPIC, Deliver, Relay
from diffdrive_jacobian.lockstep.external.stand_in import StandIn
from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.messages.names import node_of
from diffdrive_jacobian.messages.topics import CLOCK
from diffdrive_jacobian.ros.rclpy_internals import clients_of, process_number, raw_sender


class ForeignNodeError(LockstepError):
    """There is a node in the domain that is in no process of the world."""


class Discovery:
    """The nodes, topics and services of a process that are known.

    Attributes:
        stand_ins: The nodes of the world for those of the process, by name.
        relays: The relays, by what they pass and the name in the domain.
        topics: Names in the domain, by stand-in and name in the world.
        sent: What the world sends now, by topic in the domain. It arrives at the world, too.
        clock_publishers: Give the nodes the time, by topic in the domain.
        participants: Ids of the processes with nodes, one at most.
        unanswered: Calls of the process that the world has not answered yet.
        joined: Whether the nodes take part in the world.
        services_changed: Whether services of the world may have changed.
    """

    def __init__(
        self,
        domain: Domain,
        scheduler: Scheduler,
        apart: set[str],
        *,
        end: Callable[[StandIn], None],
        deliver: Deliver,
        respond: Deliver,
    ) -> None:
        """Start without nodes.

        Args:
            domain: The domain of the process.
            scheduler: Executes the nodes of the world.
            apart: Topics of which each node of the process has its own. Those that must be are added.
            end: Called with a stand-in that is destroyed.
            deliver: Delivers messages and requests to the process.
            respond: Delivers responses.
        """
        self.domain, self._outside = domain, domain.node
        self._scheduler, self._apart, self._end = scheduler, apart, end
        self._deliver, self._respond = deliver, respond
        self.stand_ins: dict[str, StandIn] = {}
        self.relays: dict[tuple[int, str], Relay] = {}
        self.topics: dict[tuple[StandIn, str], str] = {}
        self.sent: dict[str, list[bytes]] = {}
        self.clock_publishers: dict[str, Publisher] = {}
        self._clock_owners: dict[str, StandIn] = {}
        self.participants: set[int] = set()
        self.unanswered: set[Future] = set()
        self.joined = False
        self.services_changed = True
        self._called: dict[str, tuple[str, StandIn]] = {}
        self._qualities: dict[tuple[int, str], set[graphs.Quality]] = {}

    @property
    def names(self) -> str:
        """The names of the nodes, for errors; before there are any, the command line."""
        return ', '.join(self.stand_ins) or self.domain.title

    def graph(self) -> list[graphs.NodeGraph]:
        """Return what the nodes of the process have."""
        return graphs.nodes_beside(self._outside, self.domain.command.without)

    # --- What there is

    def learn(self) -> bool:
        """Create what the topics and services of the process need. Return whether it has nodes."""
        found = self.graph()
        if len({graph.full_name for graph in found}) < len(found):
            names = [graph.full_name for graph in found]
            raise LockstepError(
                f'several nodes of {self.domain.title} have the name '
                f'{", ".join(sorted({name for name in names if names.count(name) > 1}))}'
            )
        offered = {name for graph in found for name in graph.services}
        for graph in found:
            self._check_started_by_world(graph)
            name = graph.full_name
            if name not in self.stand_ins:
                self.stand_ins[name] = StandIn(graph, self._end)
            node = self.stand_ins[name]
            self._learn_topics(graph, node)
            for service, kind in graph.services.items():
                self._relay(SERVICE, service, kind, node, relays.offered_service, self._deliver)
            for service, kind in graph.clients.items():
                # A request to a service that does not know its client yet would be lost.
                if service not in offered and clients_of(self._outside, service):
                    self._called.setdefault(service, (kind, node))
        self.offer_called()
        return bool(found)

    def _learn_topics(self, graph: graphs.NodeGraph, node: StandIn) -> None:
        outside, name, command = self._outside, graph.full_name, self.domain.command
        for own, kind in graph.publishers.items():
            topic = graph.name_in_world(own)
            self.topics[node, topic] = own
            infos = outside.get_publishers_info_by_topic(own)
            profile = self._profile(TOPIC, own, graphs.qualities_of(infos, name), relays.DEPTH)
            sent = self.sent.setdefault(own, [])
            self._relay(TOPIC, own, kind, node, relays.from_topic, topic, profile, sent)
        for own, kind in graph.subscriptions.items():
            topic = graph.name_in_world(own)
            if kind == graphs.CLOCK_TYPE and topic.rpartition('/')[2] == 'clock':
                if own not in self.clock_publishers:
                    self.clock_publishers[own] = outside.create_publisher(Clock, own, 1)
                    self._clock_owners[own] = node
                continue
            self.topics[node, topic] = own
            infos = outside.get_subscriptions_info_by_topic(own)
            qualities = graphs.qualities_of(infos, name)
            profile = self._profile(INPUT, own, qualities, command.queue_depth)
            sent = self.sent.setdefault(own, [])
            self._relay(
                *(INPUT, own, kind, node, relays.to_topic),
                *(topic, profile, self._deliver, sent, command.patience),
            )

    def _profile(
        self, role: int, topic: str, qualities: Iterable[graphs.Quality], depth: int
    ) -> QoSProfile:
        """Return the profile of a topic, whose depth the graph does not show.

        Raises:
            LockstepError: There are several.
        """
        known = self._qualities.setdefault((role, topic), set())
        known |= set(qualities)
        (quality, *others) = known
        if others:
            raise LockstepError(
                f'{self.domain.title} uses {topic} with several qualities of service, at once or one '
                f'after the other: {", ".join(sorted(map(str, known)))}; a process may use one for each '
                'topic'
            )
        return quality.profile(depth)

    def _relay(
        self, role: int, name: str, kind: str, node: StandIn, create: Callable[..., Relay], *args: Any
    ) -> None:
        """Create a relay unless it is there. DDS does not promise an order between topics: by name."""
        if (role, name) not in self.relays:
            imported = graphs.import_type(kind, f'{name} of {node.get_fully_qualified_name()}')
            self.relays[role, name] = create(self._outside, node, name, imported, *args)
            self.relays = dict(sorted(self.relays.items()))

    def offer_called(self) -> None:
        """Offer the process the services that it calls and that other nodes of the world have."""
        self.services_changed = False
        there = {
            service.service_name
            for node in self._scheduler.nodes
            if node not in self.stand_ins.values()
            for service in node.services
        }
        for key in [(role, name) for role, name in self.relays if role == CALL and name not in there]:
            self.relays.pop(key).close()
        for name, (kind, node) in self._called.items():
            if name in there:
                self._relay(
                    *(CALL, name, kind, node, relays.called_service),
                    *(self._respond, self.unanswered),
                )

    def is_matched(self) -> bool:
        """Return whether the world has discovered all endpoints of the process."""
        return all(relay.is_matched() for relay in self.relays.values()) and all(
            publisher.get_subscription_count() for publisher in self.clock_publishers.values()
        )

    def send_time(self, now: int) -> None:
        """Send all nodes a time (ns)."""
        for publisher in self.clock_publishers.values():
            raw_sender(publisher)(time_message(now))

    def close(self) -> None:
        """Destroy the stand-ins and the relays. Nothing is delivered any more."""
        self.joined = False
        for node in self.stand_ins.values():
            node.destroy_node()
        for relay in self.relays.values():
            relay.close()

    # --- What must not be

    def share_topics(self) -> bool:
        """Return whether several nodes of the process have a topic that they need not share.

        Which of them receives a message, or the time, first would differ.

        Raises:
            LockstepError: They share one although they were given topics of their own.
        """
        found = self.graph()
        shared = graphs.shared_topics(found)
        if not shared:
            return False
        if self.joined or not self._apart.isdisjoint(shared):
            raise LockstepError(
                f'several nodes of {self.domain.title} share {", ".join(shared)}, which cannot be '
                'separated: the command remaps it itself, or it was created after the start; which of '
                'them receives a message first would differ: start each node by itself, and load each '
                'component into a container of its own'
            )
        self._apart |= {graph.name_in_world(topic) for graph in found for topic in graph.topics}
        return True

    def check_order(self) -> None:
        """Check that every message is received once, so that the order of callbacks is determined.

        Raises:
            LockstepError: It is not.
        """
        clocks = {(node, CLOCK): name for name, node in self._clock_owners.items()}
        for (stand_in, topic), name in {**self.topics, **clocks}.items():
            infos = self._outside.get_subscriptions_info_by_topic(name)
            owner = stand_in.get_fully_qualified_name()
            if (number := sum(node_of(info) == owner for info in infos)) > 1:
                raise LockstepError(
                    f'{owner} has {number} subscriptions to {topic}: which of them receives a message '
                    'first differs from run to run; it may have one for each topic'
                )

    def _check_started_by_world(self, graph: graphs.NodeGraph) -> None:
        """Check that a node is in the process or one that it has started."""
        infos = [
            info
            for topic in graph.publishers.keys() | graph.subscriptions.keys()
            for info in (
                *self._outside.get_publishers_info_by_topic(topic),
                *self._outside.get_subscriptions_info_by_topic(topic),
            )
            if node_of(info) == graph.full_name
        ]
        numbers = set(map(process_number, infos))
        pids = {pid for pid in self.domain.quiet.threads.processes() if pid & 0xFFFF in numbers}
        if numbers and not pids:
            raise ForeignNodeError(
                f'node {graph.full_name} is in domain {self.domain.number}, but in no process that '
                f'{self.domain.title} has started and that runs on: a container or another machine '
                'cannot take part in lockstep'
            )
        self.participants |= pids
        if len(self.participants) > 1:
            raise LockstepError(
                f'{self.domain.title} has started several processes with nodes: '
                f'{", ".join(map(str, sorted(self.participants)))}; start each of them by itself, '
                'because messages between them would not be received one at a time'
            )


def time_message(now: int) -> bytes:
    """Return a serialized message of /clock with a time (ns)."""
    message = Clock()
    set_time(message.clock, now)
    return bytes(serialize_message(message))
