"""Properties that are required of a run, and observing the run for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._messaging import Messaging, described
from diffdrive_jacobian.lockstep._report import OMITTED
from diffdrive_jacobian.lockstep._requirement import Required, Requirement


class Requirements(Messaging):
    """Requiring properties, and observing messages without subscriptions. Base class of `Lockstep`.

    The functions that observe are called while a node publishes or receives. They must not raise,
    advance time or publish. They change nothing that a node can notice.
    """

    def __init__(self, start: int) -> None:
        """Start at a time (ns)."""
        super().__init__(start)
        self._published_topics: set[str] = set()
        self._expected: dict[str, Requirement] = {}
        self._requiring: Requirement | None = None
        self._observing: list[tuple[list[Any], Any]] = []

    def require(self, *properties: Requirement) -> None:
        """Require properties from now on, at each time step.

        A violation is raised as a PropertyViolation by the method that advanced time. The property is
        not required any longer afterwards.

        Args:
            properties: Objects such as `NeverFasterThan(0.5, 2.0)` of the package `properties`.

        Raises:
            LockstepError: An argument is not a property.
        """
        self._check_open()
        for one in properties:
            if isinstance(one, type) or not callable(getattr(one, 'watch', None)):
                hint = f'; create one: {one.__name__}(...)' if isinstance(one, type) else ''
                raise LockstepError(f'require takes properties, got {described(one)}{hint}')
        if not self._watches and not self._expected:
            self._note_publishers()
            self.on_new_topics(self._note_publishers)
        for one in properties:
            self._requiring, self._observing = one, []
            try:
                self._watches.append(Required(one, one.watch(self), self._observing))
            finally:
                self._requiring = None

    def finish(self) -> None:
        """Check the properties at the end of a run. Nothing is required any longer afterwards.

        The fixture `lockstep` calls it at the end of a test that has passed.

        Raises:
            PropertyViolation: A property is violated: something that had to happen has not happened.
            LockstepError: A property observes a topic on which no node has ever been able to publish.
        """
        self._check_open()
        self.settle()
        watches, self._watches = self._watches, []
        expected, self._expected = self._expected, {}
        for topic, requirement in expected.items():
            if topic not in self._published_topics:
                known = ', '.join(sorted(self._published_topics.difference(OMITTED))) or 'none'
                raise LockstepError(
                    f'{requirement!r} observes {topic}, for which there was no publisher; '
                    f'topics: {known}'
                )
        for required in watches:
            required.end()
        for required in watches:
            if (text := required.watch.finish()) is not None:
                raise self._violation(required.requirement, text)

    def on_published(self, topic: str, observe: Callable[[Publisher, Any], None]) -> str:
        """Call a function with the publisher and the message after each message of a topic is published.

        The message is a `bytes` object if serialized bytes were published.

        Returns:
            The full name of the topic. If a property observes it, somebody must have a publisher of it
            before `finish`.
        """
        name = str(self.node.resolve_topic_name(topic))
        if self._requiring is not None:
            self._expected.setdefault(name, self._requiring)
        self._observe(self._traffic.observers_of(name), observe)
        return name

    def on_delivered(self, topic: str, observe: Callable[[Node, Any, Any], None]) -> str:
        """Call a function with each message of a topic that the nodes receive, before their callbacks.

        The function receives the node, the type of the message, and the message, a `bytes` object if the
        subscription is raw.

        Returns:
            The full name of the topic.
        """
        name = str(self.node.resolve_topic_name(topic))
        self._observe(self._executor.deliveries.observers_of(name), observe)
        return name

    def on_response(self, service: str, observe: Callable[[Any], None]) -> str:
        """Call a function with each response of a service, when the service has sent it.

        Returns:
            The full name of the service.
        """
        name = str(self.node.resolve_service_name(service))

        def observe_call(endpoint: Any, message: Any, *_: Any) -> None:
            if isinstance(endpoint, Service) and endpoint.service_name == name:
                observe(message)

        self._observe(self._executor.call_observers, observe_call)
        return name

    def _observe(self, observers: list[Any], observe: Any) -> None:
        observers.append(observe)
        if self._requiring is not None:
            self._observing.append((observers, observe))

    def node_of(self, publisher: Publisher) -> Node | None:
        """Return the node that has a publisher; None: it was removed."""
        for node in self._executor.nodes:
            if any(one is publisher for one in node.publishers):
                return node
        return None

    def on_new_topics(self, callback: Callable[[], None]) -> None:
        """Call a function whenever a node is added, or has created or destroyed an entity."""
        raise NotImplementedError

    def _note_publishers(self) -> None:
        for node in self._executor.nodes:
            self._published_topics.update(publisher.topic_name for publisher in node.publishers)
