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

"""Messages and services of a test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.duration import Infinite
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from diffdrive_jacobian.diagnosis.graph import Quality, mismatch
from diffdrive_jacobian.lockstep._errors import LockstepError, described
from diffdrive_jacobian.lockstep._link import is_latched
from diffdrive_jacobian.lockstep._nodes import Nodes
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep._simulated_time import SimulatedTime
from diffdrive_jacobian.messages.names import node_of, type_name
from diffdrive_jacobian.ros.rclpy_internals import SERVICES_OF_RCLPY
from diffdrive_jacobian.time_units import NANOSECONDS

__tracebackhide__ = True

LISTENING_DEPTH = 1000
"""Queue size of `listen`: the number of messages of a topic at one simulated time."""


class Messaging:
    """Publishing, listening and calling with the node of the test."""

    def __init__(
        self, scheduler: Scheduler, nodes: Nodes, time: SimulatedTime, report: Callable[[], str]
    ) -> None:
        """Start without publishers.

        Args:
            scheduler: Executes the nodes.
            nodes: The nodes of the world.
            time: Lets time pass.
            report: Returns the last messages of all topics as text.
        """
        self._scheduler = scheduler
        self._node = nodes.own
        self._time = time
        self._report = report
        self._publishers: dict[tuple[type, str, bool], Publisher] = {}
        self._all_served: dict[Publisher, tuple[int, int]] = {}

    def publish(self, topic: str, message: Any, latched: bool) -> None:
        """Publish a message, as `Lockstep.publish`."""
        if not isinstance(topic, str) or not _is_message(message):
            got = f'{described(topic)} and {described(message)}'
            hint = ''
            if isinstance(message, (bytes, bytearray, memoryview)):
                hint = '; serialized messages: node.create_publisher(TYPE, TOPIC, 10).publish(BYTES)'
            raise LockstepError(f'publish takes a topic and a message, got {got}{hint}')
        key = type(message), topic, latched
        if key not in self._publishers:
            profile = QoSProfile(depth=10)
            if latched:
                profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
            create = self._node.create_publisher
            self._publishers[key] = self._with_type(topic, create, type(message), topic, profile)
        publisher = self._publishers[key]
        self._time.settle_unless_busy()
        subscriptions = publisher.get_subscription_count()
        # Both: a node that was not added may have come in place of one that was removed.
        counts = subscriptions, len(self._scheduler.links.to(publisher.topic_name))
        if counts != self._all_served.get(publisher) or subscriptions == 0:
            self._check_compatible(topic, publisher)
            if subscriptions == 0 and not latched:
                raise LockstepError(
                    f'{publisher.topic_name} has no subscription of type {type_name(type(message))}\n'
                    f'{self._report()}'
                )
            self._check_all_served(publisher.topic_name)
            self._all_served[publisher] = counts
        publisher.publish(message)
        self._time.settle_unless_busy()

    def _check_compatible(self, given: str, publisher: Publisher) -> None:
        """Check that all subscriptions of a topic receive what a publisher sends.

        Args:
            given: Name of the topic, before it is remapped.
            publisher: The publisher.
        """
        offered = publisher.qos_profile
        for info in self._node.get_subscriptions_info_by_topic(given):
            requested = info.qos_profile
            if info.topic_type == type_name(publisher.msg_type) and not _compatible(offered, requested):
                volatile = offered.durability != DurabilityPolicy.TRANSIENT_LOCAL
                hint = ': publish(..., latched=True)' if volatile and is_latched(info) else ''
                raise LockstepError(
                    f'{publisher.topic_name} is subscribed to by {node_of(info)} with the quality of '
                    f'service {_qos_name(requested)}, and published with {_qos_name(offered)}, which '
                    f'does not reach it{hint}\n{self._report()}'
                )

    def _check_all_served(self, topic: str) -> None:
        """Check that all subscriptions of a topic are those of nodes that were added.

        Args:
            topic: Fully qualified name of the topic.
        """
        nodes = self._scheduler.nodes
        added = {node.get_fully_qualified_name() for node in nodes}
        missing = sorted(
            f'{name} (a second node of this name)' if name in added else name
            for node in self._scheduler.existing
            if node not in nodes and any(one.topic_name == topic for one in node.subscriptions)
            for name in [node.get_fully_qualified_name()]
        )
        if missing:
            raise LockstepError(
                f'{topic} is subscribed to by {", ".join(missing)}: created, but not added to lockstep'
            )

    def last(self, topic: str) -> Any:
        """Return the last message of a topic, as `Lockstep.last`."""
        if not isinstance(topic, str):
            raise LockstepError(f'last takes a topic, got {described(topic)}')
        self._time.check_threads()
        name = self._node.resolve_topic_name(topic)
        message = self._scheduler.links.last(name)
        if message is None:
            raise LockstepError(f'no message was published on {name}\n{self._report()}')
        return message

    def listen(self, message_type: type, topic: str, latched: bool) -> list[Any]:
        """Return a list to which messages are appended, as `Lockstep.listen`."""
        if not isinstance(message_type, type) or not isinstance(topic, str):
            raise LockstepError(
                f'listen takes a type and a topic, got {described(message_type)} and {described(topic)}'
            )
        received: list[Any] = []
        profile = QoSProfile(depth=LISTENING_DEPTH)
        if latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        else:
            # Matches every publisher. Within a process no message is lost.
            profile.reliability = ReliabilityPolicy.BEST_EFFORT
        create = self._node.create_subscription
        self._with_type(topic, create, message_type, topic, received.append, profile)
        self._time.settle_unless_busy()
        return received

    def call(self, service_type: Any, name: str, request: Any, timeout: float) -> Any:
        """Call a service, as `Lockstep.call`."""
        name = self._node.resolve_service_name(name)
        services = dict(self._node.get_service_names_and_types())
        wanted = type_name(service_type)
        if wanted not in services.get(name, []):
            known = ', '.join(other for other, kinds in services.items() if not _is_of_rclpy(kinds))
            raise LockstepError(
                f'there is no service {name} of type {wanted}; services: {known or "none"}'
                if name not in services
                else f'{name} is of type {services[name][0]}, not {wanted}'
            )
        request = service_type.Request() if request is None else request
        if not isinstance(request, service_type.Request):
            raise LockstepError(
                f'a request of {name} must be a {wanted}.Request, got {described(request)}'
            )
        client = self._node.create_client(service_type, name)
        try:
            future = client.call_async(request)
            self._time.run_until(future.done, timeout, f'a response of {name}')
            return future.result()
        finally:
            self._node.destroy_client(client)

    def _with_type(self, topic: str, create: Callable[..., Any], *args: Any) -> Any:
        try:
            return create(*args)
        except (LockstepError, RuntimeError) as error:
            # Within one process Fast DDS refuses a topic of two types.
            name = self._node.resolve_topic_name(topic)
            types = dict(self._node.get_topic_names_and_types()).get(name, [])
            raise LockstepError(
                f'{name} is of type {", ".join(types) or "unknown"}, not {type_name(args[0])}'
            ) from error


def _is_message(value: Any) -> bool:
    """Return whether a value is a message: an object of a generated class."""
    return not isinstance(value, type) and hasattr(value, 'get_fields_and_field_types')


def _is_of_rclpy(types: list[str]) -> bool:
    """Return whether a service is one that rclpy provides for every node."""
    return types[0].startswith(SERVICES_OF_RCLPY)


def _compatible(offered: QoSProfile, requested: QoSProfile) -> bool:
    """Return whether a publisher and a subscription with these profiles are matched."""
    return not mismatch(Quality.of(offered), Quality.of(requested))


def _qos_name(profile: QoSProfile) -> str:
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
