"""Messages and services of a test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from diffdrive_jacobian.lockstep._deliveries import is_latched
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._external_graph import compatible, node_name, qos_name
from diffdrive_jacobian.lockstep._simulated_time import SimulatedTime
from diffdrive_jacobian.ros.rclpy_internals import SERVICES_OF_RCLPY

LISTENING_DEPTH = 1000
"""Queue size of `listen`: the number of messages of a topic at one simulated time."""


class Messaging(SimulatedTime):
    """Publishing, listening and calling. Base class of `Lockstep`."""

    node: Node
    """Node for the publishers, subscriptions and clients of a test."""

    def __init__(self, start: int) -> None:
        """Start at a time (ns)."""
        super().__init__(start)
        self._publishers: dict[tuple[type, str, bool], Publisher] = {}
        self._all_served: dict[Publisher, tuple[int, int]] = {}

    def publish(self, topic: str, message: Any, *, latched: bool = False) -> None:
        """Publish a message and execute all callbacks that it causes (within a callback: later).

        Args:
            topic: Name of the topic.
            message: The message.
            latched: Whether latched (transient local) subscriptions receive it, too, also later ones.

        Raises:
            LockstepError: The topic has no subscription (and the message is not latched), one of another
                quality of service, or another type, or it is subscribed to by a node that was not added.
                Or the arguments are no topic and no message.
        """
        self._check_open()
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
            create = self.node.create_publisher
            self._publishers[key] = self._with_type(topic, create, type(message), topic, profile)
        publisher = self._publishers[key]
        self._settle_unless_busy()
        self.connect()
        subscriptions = publisher.get_subscription_count()
        if subscriptions == 0 and not latched and self._external is not None and not self._busy:
            self._external.waiting.for_subscription(publisher)
            self.connect()
            subscriptions = publisher.get_subscription_count()
        # Both: a node that was not added may have come in place of one that was removed.
        counts = subscriptions, len(self._executor.deliveries.readers_of(publisher.topic_name))
        if counts != self._all_served.get(publisher) or subscriptions == 0:
            self._check_compatible(topic, publisher)
            if subscriptions == 0 and not latched:
                raise LockstepError(
                    f'{publisher.topic_name} has no subscription of type {_type_name(type(message))}\n'
                    f'{self.report()}'
                )
            self._check_all_served(publisher.topic_name)
            self._all_served[publisher] = counts
        publisher.publish(message)
        self._settle_unless_busy()

    def _check_compatible(self, given: str, publisher: Publisher) -> None:
        """Check that all subscriptions of a topic receive what a publisher sends.

        Args:
            given: Name of the topic, before it is remapped.
            publisher: The publisher.
        """
        offered = publisher.qos_profile
        for info in self.node.get_subscriptions_info_by_topic(given):
            requested = info.qos_profile
            if info.topic_type == _type_name(publisher.msg_type) and not compatible(offered, requested):
                volatile = offered.durability != DurabilityPolicy.TRANSIENT_LOCAL
                hint = ': publish(..., latched=True)' if volatile and is_latched(info) else ''
                raise LockstepError(
                    f'{publisher.topic_name} is subscribed to by {node_name(info)} with the quality of '
                    f'service {qos_name(requested)}, and published with {qos_name(offered)}, which does '
                    f'not reach it{hint}\n{self.report()}'
                )

    def _check_all_served(self, topic: str) -> None:
        """Check that all subscriptions of a topic are those of nodes that were added.

        Args:
            topic: Fully qualified name of the topic.
        """
        nodes = self._executor.nodes
        added = {node.get_fully_qualified_name() for node in nodes}
        missing = sorted(
            f'{name} (a second node of this name)' if name in added else name
            for node in self._executor.existing
            if node not in nodes and any(one.topic_name == topic for one in node.subscriptions)
            for name in [node.get_fully_qualified_name()]
        )
        if missing:
            raise LockstepError(
                f'{topic} is subscribed to by {", ".join(missing)}: created, but not added to lockstep'
            )

    def last(self, topic: str) -> Any:
        """Return the last message of a topic, as its subscriptions received it.

        Raises:
            LockstepError: No message was published on the topic.
        """
        self._check_open()
        if not isinstance(topic, str):
            raise LockstepError(f'last takes a topic, got {described(topic)}')
        self._check_threads()
        name = self.node.resolve_topic_name(topic)
        message = self._traffic.last(name)
        if message is None:
            raise LockstepError(f'no message was published on {name}\n{self.report()}')
        return message

    def listen(self, message_type: type, topic: str, *, latched: bool = False) -> list[Any]:
        """Return a list to which the messages of a topic are appended.

        Args:
            message_type: Type of the topic.
            topic: Name of the topic.
            latched: Whether to include earlier messages of a latched topic.

        Raises:
            LockstepError: The topic has another type, or an argument is no type or no name.
        """
        self._check_open()
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
        create = self.node.create_subscription
        self._with_type(topic, create, message_type, topic, received.append, profile)
        self._settle_unless_busy()
        return received

    def call(self, service_type: Any, name: str, request: Any = None, *, timeout: float = 10.0) -> Any:
        """Call a service and return the response.

        Args:
            service_type: Type of the service.
            name: Name of the service.
            request: The request; None: an empty one.
            timeout: Longest simulated time for the response (s); wall time if another process provides
                the service.

        Raises:
            LockstepError: There is no such service, or it does not respond in time.
        """
        self._check_open()
        name = self.node.resolve_service_name(name)
        self.connect()
        external = None if self._is_served(name) else self._external
        if external is not None:
            external.waiting.for_service(name)
        services = dict(self.node.get_service_names_and_types())
        wanted = _type_name(service_type, 'srv')
        if wanted not in services.get(name, []):
            others = ', '.join(other for other, kinds in services.items() if not _is_of_rclpy(kinds))
            raise LockstepError(
                f'there is no service {name} of type {wanted}; services: {others or "none"}'
                if name not in services
                else f'{name} is of type {services[name][0]}, not {wanted}'
            )
        client = self.node.create_client(service_type, name)
        try:
            if external is not None:
                external.waiting.until(client.service_is_ready, timeout, lambda: f'{name} is not ready')
            future = client.call_async(request or service_type.Request())
            if external is not None:
                external.waiting.until(future.done, timeout, lambda: f'no response of {name}')
            self.run_until(future.done, timeout, f'a response of {name}')
            return future.result()
        finally:
            self.node.destroy_client(client)

    def _is_served(self, service: str) -> bool:
        """Return whether a node of the world provides a service."""
        return any(
            node.resolve_service_name(server.srv_name) == service
            for node in self._executor.nodes
            for server in node.services
        )

    def _settle_unless_busy(self) -> None:
        """Settle, except within a callback, after which it happens anyway."""
        if not self._busy:
            self.settle()

    def _with_type(self, topic: str, create: Callable[..., Any], *args: Any) -> Any:
        try:
            return create(*args)
        except RuntimeError as error:
            # Within one process Fast DDS refuses a topic of two types.
            name = self.node.resolve_topic_name(topic)
            types = dict(self.node.get_topic_names_and_types()).get(name, [])
            raise LockstepError(
                f'{name} is of type {", ".join(types) or "unknown"}, not {_type_name(args[0])}'
            ) from error


def _is_message(value: Any) -> bool:
    """Return whether a value is a message: an object of a generated class."""
    return not isinstance(value, type) and hasattr(value, 'get_fields_and_field_types')


def _type_name(interface: Any, kind: str = 'msg') -> str:
    return f'{interface.__module__.split(".")[0]}/{kind}/{interface.__name__}'


def described(value: Any) -> str:
    """Return a description of an argument of a wrong kind."""
    if isinstance(value, type):
        return f'the class {value.__name__}'
    return f"'{value}'" if isinstance(value, str) else f'an object of the class {type(value).__name__}'


def _is_of_rclpy(types: list[str]) -> bool:
    """Return whether a service is one that rclpy provides for every node."""
    return types[0].startswith(SERVICES_OF_RCLPY)
