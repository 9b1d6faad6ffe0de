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

"""The properties that are required of a world, and observing it for them without subscriptions.

What a property is, is in `diffdrive_jacobian.properties`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from rclpy.node import Node
from rclpy.service import Service

from diffdrive_jacobian.lockstep._errors import LockstepError, PropertyViolation, described, raised
from diffdrive_jacobian.lockstep._link import Delivered, Published
from diffdrive_jacobian.lockstep._nodes import Nodes
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS
from diffdrive_jacobian.ros.rclpy_internals import SERVICES_OF_RCLPY
from diffdrive_jacobian.time_units import NANOSECONDS

__tracebackhide__ = True


class Watch(Protocol):
    """What observes one run for a property."""

    def violated_now(self) -> str | None:
        """Return what is violated at the current time, after all callbacks; None: nothing."""

    def violated_at_end(self) -> str | None:
        """Return what is violated at the end of the run; None: nothing."""


class Property(Protocol):
    """What lockstep needs of a property."""

    def watch(self, world: Any) -> Watch:
        """Begin to observe a world."""


class _Required(NamedTuple):
    """A property and what observes the run for it."""

    property: Property
    watch: Watch
    observing: list[tuple[list[Any], Any]]
    """The functions that observe, each with the list that it is in."""

    def end(self) -> None:
        """Stop observing."""
        for observers, observe in self.observing:
            observers.remove(observe)


def answer(question: Callable[[], str | None]) -> str | None:
    """Return what a property answers. That it raises something violates it."""
    try:
        return question()
    except LockstepError:
        raise
    except Exception as error:
        return raised(error)


class Properties:
    """What is required of a world.

    The functions that observe are called while a node publishes or receives. They must not raise,
    advance time or publish. They change nothing that a node can notice.
    """

    def __init__(self, scheduler: Scheduler, nodes: Nodes, report: Callable[[], str]) -> None:
        """Start without properties.

        Args:
            scheduler: Executes the nodes.
            nodes: The nodes of the world.
            report: Returns the last messages of all topics as text.
        """
        self._scheduler = scheduler
        self._nodes = nodes
        self._report = report
        self.required: list[_Required] = []
        """What is required now."""
        self.observed: set[str] = set()
        """Full names of the topics that properties have observed."""
        self._offered: set[str] = set()
        self._expected: list[tuple[Property, tuple[str, ...]]] = []
        self._requiring: Property | None = None
        self._observing: list[tuple[list[Any], Any]] = []

    def __bool__(self) -> bool:
        """Return whether there is anything to check at the end."""
        return bool(self.required or self._expected)

    def require(self, world: Any, properties: tuple[Property, ...]) -> None:
        """Require properties of a world, as `Lockstep.require`."""
        for one in properties:
            if isinstance(one, type) or not callable(getattr(one, 'watch', None)):
                hint = f'; create one: {one.__name__}(...)' if isinstance(one, type) else ''
                raise LockstepError(f'require takes properties, got {described(one)}{hint}')
        if not self:
            self._note_offered()
            self._nodes.on_change.append(self._note_offered)
        for one in properties:
            self._requiring, self._observing = one, []
            try:
                self.required.append(_Required(one, one.watch(world), self._observing))
            finally:
                self._requiring = None

    def check(self) -> None:
        """Check what is required at the current time, when all callbacks have been executed."""
        for required in self.required:
            if (text := answer(required.watch.violated_now)) is not None:
                self.required.remove(required)
                required.end()
                raise self._violation(required.property, text)

    def finish(self) -> None:
        """Check the properties at the end of a run. Nothing is required any longer afterwards."""
        required, self.required = self.required, []
        expected, self._expected = self._expected, []
        left = {id(one.property) for one in required}
        for of, names in expected:
            # One that was violated has observed something, or its absence.
            if id(of) in left and self._offered.isdisjoint(names):
                known = ', '.join(sorted(self._offered.difference(NOT_OF_ROBOTS))) or 'none'
                raise LockstepError(
                    f'{of} observes {" and ".join(names)}, which no node has a publisher or a service '
                    f'of; topics and services: {known}'
                )
        for one in required:
            one.end()
        for one in required:
            if (text := answer(one.watch.violated_at_end)) is not None:
                raise self._violation(one.property, text)

    def _violation(self, violated: Property, text: str) -> PropertyViolation:
        seconds = self._scheduler.agenda.now / NANOSECONDS
        return PropertyViolation(violated, seconds, text, self._report())

    # --- Observing

    def expect(self, names: tuple[str, ...]) -> None:
        """Expect that some node offers one of these topics or services, as `Lockstep.expect`."""
        if self._requiring is not None:
            resolve = self._nodes.own.resolve_topic_name
            self._expected.append((self._requiring, tuple(str(resolve(name)) for name in names)))

    def on_published(self, topic: str, observe: Published) -> str:
        """Observe what is published, as `Lockstep.on_published`."""
        name = str(self._nodes.own.resolve_topic_name(topic))
        self.observed.add(name)
        self._observe(self._scheduler.links.observers_of_published(name), observe)
        return name

    def on_delivered(self, topic: str, observe: Delivered) -> str:
        """Observe what is received, as `Lockstep.on_delivered`."""
        name = str(self._nodes.own.resolve_topic_name(topic))
        self.observed.add(name)
        self._observe(self._scheduler.links.observers_of_delivered(name), observe)
        return name

    def on_response(self, service: str, observe: Callable[[Node, Any], None]) -> str:
        """Observe what a service responds, as `Lockstep.on_response`."""
        name = str(self._nodes.own.resolve_service_name(service))

        def observe_response(node: Node, endpoint: Service, response: Any) -> None:
            if endpoint.service_name == name:
                observe(node, response)

        self._observe(self._scheduler.responses.observers, observe_response)
        return name

    def _observe(self, observers: list[Any], observe: Any) -> None:
        observers.append(observe)
        if self._requiring is not None:
            self._observing.append((observers, observe))

    def _note_offered(self) -> None:
        for node in self._scheduler.nodes:
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
