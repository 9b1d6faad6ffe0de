"""Properties that are required of a run, and observing the run for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service

from diffdrive_jacobian.lockstep._disturbed import Disturbed
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._injection import Injectable
from diffdrive_jacobian.lockstep._messaging import described
from diffdrive_jacobian.lockstep._requirement import Required, Requirement
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS
from diffdrive_jacobian.ros.rclpy_internals import SERVICES_OF_RCLPY


class Requirements(Disturbed):
    """Requiring properties, and observing messages without subscriptions. Base class of `Lockstep`.

    The functions that observe are called while a node publishes or receives. They must not raise,
    advance time or publish. They change nothing that a node can notice.
    """

    def __init__(self, start: int) -> None:
        """Start at a time (ns)."""
        super().__init__(start)
        self.faults: list[Any] = []
        """The faults that were injected."""
        self._offered: set[str] = set()
        self._expected: list[tuple[Requirement, tuple[str, ...]]] = []
        self._requiring: Requirement | None = None
        self._observing: list[tuple[list[Any], Any]] = []

    def inject(self, *faults: Injectable, seed: int = 0) -> None:
        """Inject faults, as `Disturbed.inject`."""
        super().inject(*faults, seed=seed)
        self.faults.extend(faults)

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
            self._note_offered()
            self.on_new_topics(self._note_offered)
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
            LockstepError: A property observes a topic of which no node has had a publisher, or a service
                that no node has had, or a fault met nothing. A name may be misspelt.
        """
        self._check_open()
        self._check_threads()
        if self._watches or self._expected:
            # Not otherwise: a test may have passed because a callback raises what it expects.
            self.settle()
        watches, self._watches = self._watches, []
        expected, self._expected = self._expected, []
        left = {id(required.requirement) for required in watches}
        if self._external is not None:
            self._offered.update(self._external.topics())
        for requirement, names in expected:
            # One that was violated has observed something, or its absence.
            if id(requirement) in left and self._offered.isdisjoint(names):
                known = ', '.join(sorted(self._offered.difference(NOT_OF_ROBOTS))) or 'none'
                raise LockstepError(
                    f'{requirement} observes {" and ".join(names)}, which no node has offered; topics '
                    f'and services: {known}'
                )
        for required in watches:
            required.end()
        for required in watches:
            if (text := required.watch.finish()) is not None:
                raise self._violation(required.requirement, text)
        self.check_faults()

    @property
    def nodes(self) -> list[Node]:
        """The nodes that are there now, with that of the test."""
        return self._executor.nodes

    @property
    def killed(self) -> set[Node]:
        """The nodes that were removed without being stopped."""
        return self._executor.killed

    def expect(self, *names: str) -> None:
        """Expect that some node has a publisher of one of these topics, or one of these services.

        Called by properties. `finish` raises an error if none had.
        """
        if self._requiring is not None:
            resolve = self.node.resolve_topic_name
            self._expected.append((self._requiring, tuple(str(resolve(name)) for name in names)))

    def on_published(self, topic: str, observe: Callable[[Publisher, Any], None]) -> str:
        """Call a function with the publisher and the message after each message of a topic is published.

        The message is a `bytes` object if serialized bytes were published.

        Returns:
            The full name of the topic.
        """
        name = str(self.node.resolve_topic_name(topic))
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

    def on_response(self, service: str, observe: Callable[[Node, Any], None]) -> str:
        """Call a function with the node and each response of a service, when the node has given it.

        A fault may delay the response on its way.

        Returns:
            The full name of the service.
        """
        name = str(self.node.resolve_service_name(service))

        def observe_response(node: Node, endpoint: Service, response: Any) -> None:
            if endpoint.service_name == name:
                observe(node, response)

        self._observe(self._executor.response_observers, observe_response)
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

    def _note_offered(self) -> None:
        for node in self._executor.nodes:
            self._offered.update(publisher.topic_name for publisher in node.publishers)
            if node.services:
                self._offered.update(_services(node))


def _services(node: Node) -> set[str]:
    """Return the names of the services of a node, without those that rclpy provides."""
    return {
        service.service_name
        for service in node.services
        if service.srv_type.__module__.split('.')[0] + '/' not in SERVICES_OF_RCLPY
    }
