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

"""What a property is. `Lockstep.require` requires one of a run."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message

from diffdrive_jacobian.faults.fault import Expression
from diffdrive_jacobian.lockstep._errors import LockstepError, raised
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.names import full_name
from diffdrive_jacobian.time_units import NANOSECONDS

RECENT = 5
"""Number of messages that a violation lists."""
ROUNDING = 1e-9
"""Tolerance on times (s) and distances (m)."""
OF_PROPERTIES = ('world', '_recent', '_found', '_owners', '_names')
"""Attributes of a property that observes a run."""
P = TypeVar('P', bound='Property')


@dataclass(repr=False)
class Property(Expression, ABC):
    """Something that must hold in a run of a `Lockstep`. Base class.

    A property is a value: it can be compared, pickled, and printed as the expression that makes it. A
    copy of it observes the run. `begin` says what it observes, and sets attributes for what it has seen,
    which are no fields of the dataclass. Subclasses are decorated with `@dataclass(repr=False)`.

    What is violated is noted by `found`, or returned by `check` or `finish`, and raised by `Lockstep`. A
    property that raises an exception is violated, too.

    Attributes:
        namespace: Namespace of the topics, such as '/robot1' (default: that of the `Lockstep`).
    """

    namespace: str = field(default='', kw_only=True)

    def watch(self: P, world: Lockstep) -> P:
        """Return a copy that observes a run. `Lockstep.require` calls it."""
        kind = type(self)
        if '__init__' in vars(kind) and '__dataclass_fields__' not in vars(kind):
            raise LockstepError(f'{kind.__name__} must be decorated with @dataclass(repr=False)')
        observing = deepcopy(self)
        observing._start(world)
        return observing

    def __init_subclass__(cls) -> None:
        """Refuse fields with the names of what a property has."""
        super().__init_subclass__()
        for name in inspect.get_annotations(cls):
            if name in OF_PROPERTIES or (name != 'namespace' and hasattr(Property, name)):
                raise TypeError(f'{cls.__name__}.{name}: each property has something of this name')

    def _start(self, world: Lockstep) -> None:
        self.world = world
        self._recent: deque[tuple[int, tuple[object, ...]]] = deque(maxlen=RECENT)
        self._found: str | None = None
        self._owners: dict[Publisher, Node] = {}
        self._names: dict[Node, str] = {}
        self.begin()

    # --- What a property defines

    @abstractmethod
    def begin(self) -> None:
        """Begin to observe `self.world`, with `on_published` and so on."""

    def check(self) -> str | None:
        """Return what is violated at the current time, after all callbacks; None: nothing.

        It is asked where time stops: at timers, and where faults begin, end or let a message arrive.
        """
        return None

    def finish(self) -> str | None:
        """Return what is violated at the end of the run; None: nothing."""
        return None

    # --- What `Lockstep` asks

    def violated_now(self) -> str | None:
        """Return what was found, or what `check` returns."""
        text = None if self._found else self.check()
        return self._found or text

    def violated_at_end(self) -> str | None:
        """Return what was found, or what `finish` returns."""
        text = None if self._found else self.finish()
        return self._found or text

    # --- Observing

    def on_published(
        self,
        topic: str,
        observe: Callable[[Publisher, Any], None],
        *,
        optional: bool = False,
        raw: bool = False,
    ) -> str:
        """Call a function with the publisher and the message after each message of a topic is published.

        Bytes that are no message are a violation.

        Args:
            topic: Name of the topic.
            observe: The function.
            optional: Whether no node needs to offer the topic. It is an error otherwise.
            raw: Whether serialized messages remain bytes, whatever they are.

        Returns:
            The full name of the topic.
        """
        if not optional:
            self.world.expect(self.resolved(topic))

        def observe_decoded(publisher: Publisher, message: Any) -> None:
            if (decoded := self._decoded(publisher.msg_type, message, topic)) is not None:
                self._call(observe, publisher, decoded)

        def observe_raw(publisher: Publisher, message: Any) -> None:
            self._call(observe, publisher, message)

        return self.world.on_published(self.resolved(topic), observe_raw if raw else observe_decoded)

    def on_delivered(
        self,
        topic: str,
        observe: Callable[[Node, Any, Any], None],
        *,
        optional: bool = False,
        raw: bool = False,
    ) -> str:
        """Call a function with each message of a topic that the nodes receive, before their callbacks.

        The function receives the node, the type of the message, and the message. The rest is as of
        `on_published`.
        """
        if not optional:
            self.world.expect(self.resolved(topic))

        def observe_decoded(node: Node, message_type: Any, message: Any) -> None:
            if (decoded := self._decoded(message_type, message, topic)) is not None:
                self._call(observe, node, message_type, decoded)

        def observe_raw(node: Node, message_type: Any, message: Any) -> None:
            self._call(observe, node, message_type, message)

        return self.world.on_delivered(self.resolved(topic), observe_raw if raw else observe_decoded)

    def _decoded(self, message_type: Any, message: Any, topic: str) -> Any:
        """Return a message that may be serialized. None: it is invalid, which is a violation."""
        if not isinstance(message, bytes):
            return message
        try:
            return deserialize_message(message, message_type)
        except RuntimeError:
            self.found(f'{self.resolved(topic)}: bytes that are no {message_type.__name__}')
            return None

    def on_response(
        self, service: str, observe: Callable[[Node, Any], None], *, optional: bool = False
    ) -> str:
        """Call a function with the node and each response of a service. Return its full name.

        It is an error if no node ever has the service, unless it is `optional`.
        """
        if not optional:
            self.world.expect(self.resolved(service))

        def observe_safely(node: Node, response: Any) -> None:
            self._call(observe, node, response)

        return self.world.on_response(self.resolved(service), observe_safely)

    def _call(self, observe: Callable[..., None], *args: Any) -> None:
        """Call a function that observes. An exception of it is not one of the node that publishes."""
        try:
            observe(*args)
        except LockstepError:
            raise
        except Exception as error:
            self.found(raised(error))

    def resolved(self, name: str) -> str:
        """Return the name of a topic or service with the namespace of this property."""
        if not self.namespace or name.startswith('/'):
            return name
        return full_name(self.namespace, name)

    @property
    def world_seconds(self) -> float:
        """World time since the start of the `Lockstep` (s)."""
        return self.world.world_seconds

    def owner(self, publisher: Publisher) -> Node | None:
        """Return the node that has a publisher; None: it was removed, or not added yet."""
        owner = self._owners.get(publisher)
        if owner is None:
            owner = self.world.node_of(publisher)
            if owner is not None:
                self._owners[publisher] = owner
        return owner

    def name_of(self, node: Node) -> str:
        """Return the fully qualified name of a node, also after it was destroyed."""
        if node not in self._names:
            self._names[node] = node.get_fully_qualified_name()
        return self._names[node]

    # --- Describing

    def note(self, *parts: object) -> None:
        """Note something that happened, for the description of a violation.

        The text is the parts one after the other. They become text only when it is needed.
        """
        self._recent.append((self.world.world_time, parts))

    def found(self, text: str) -> None:
        """Note a violation, which is raised when all callbacks are done. Only the first one counts."""
        if self._found is None:
            self._found = self.described(text)

    def described(self, text: str) -> str:
        """Return a text with what happened last."""
        notes = [
            f'  {time / NANOSECONDS:.9g} s: {"".join(map(str, parts))}' for time, parts in self._recent
        ]
        return '\n'.join([text, *(['before that:'] if notes else []), *notes])


def end_of_faults(world: Lockstep) -> float:
    """Return the world time at which all faults have ended, and what they delayed has arrived (s).

    Infinite: one of them has no end. Faults of one topic may delay a message one after the other.
    """
    end = max((fault.end for fault in world.faults), default=0.0)
    return float(end + sum(fault.longest_delay for fault in world.faults))
