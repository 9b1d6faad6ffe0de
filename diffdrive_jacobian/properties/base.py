"""The base classes of all properties."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.faults.fault import Expression, RosName
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.names import full_name
from diffdrive_jacobian.properties._messages import Pose, Twist, read_pose, read_twist
from diffdrive_jacobian.time_units import NANOSECONDS

RECENT = 5
"""Number of messages that a violation lists."""
ROUNDING = 1e-9
"""Tolerance on times (s) and distances (m)."""


@dataclass(frozen=True, repr=False)
class Property(Expression, ABC):
    """Something that must hold in a run of a `Lockstep`. Required by `Lockstep.require`.

    A property is a value. It can be compared, pickled, and printed as the expression that makes it. What
    it observes of a run is in the Watch that `watch` returns.

    Attributes:
        namespace: Namespace of the topics, such as '/robot1' (default: that of the `Lockstep`).
    """

    namespace: str = field(default='', kw_only=True)

    @abstractmethod
    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run, and return what observes it."""

    def resolved(self, name: str) -> str:
        """Return the name of a topic or service with the namespace of this property."""
        if not self.namespace or name.startswith('/'):
            return name
        return full_name(self.namespace, name)


class Watch:
    """What observes one run for one property. Base class.

    What it observes it stores. The methods return violations, which `Lockstep` raises: an exception
    within an observing function would be raised in the node that publishes.
    """

    def __init__(self, world: Lockstep) -> None:
        """Observe a run."""
        self.world = world
        self._recent: deque[tuple[int, tuple[object, ...]]] = deque(maxlen=RECENT)
        self._found: str | None = None
        self._owners: dict[Publisher, Node] = {}
        self._names: dict[Node, str] = {}

    @property
    def seconds(self) -> float:
        """World time since the start of the `Lockstep` (s)."""
        return self.world.world_time / NANOSECONDS

    def check(self) -> str | None:
        """Return what is violated at the current time, after all callbacks; None: nothing."""
        return self._found

    def finish(self) -> str | None:
        """Return what is violated at the end of the run; None: nothing."""
        return None

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

    def note(self, *parts: object) -> None:
        """Note something that happened, for the description of a violation.

        The text is the parts one after the other. They become text only when it is needed.
        """
        self._recent.append((self.world.world_time, parts))

    def found(self, text: str) -> None:
        """Note a violation, which `check` will return. Only the first one counts."""
        if self._found is None:
            self._found = self.described(text)

    def described(self, text: str) -> str:
        """Return a text with what happened last."""
        notes = [
            f'  {time / NANOSECONDS:.9g} s: {"".join(map(str, parts))}' for time, parts in self._recent
        ]
        return '\n'.join([text, *(['before that:'] if notes else []), *notes])


P = TypeVar('P', bound=Property)


class PropertyWatch(Watch, Generic[P]):
    """A watch that knows its property, and observes the topics that this names."""

    def __init__(self, required: P, world: Lockstep) -> None:
        """Observe a run."""
        super().__init__(world)
        self.required = required

    def on_published(self, topic: str, observe: Callable[[Publisher, Any], None]) -> str:
        """Observe a topic, which some node must offer. Return its full name."""
        self.world.expect(self.required.resolved(topic))
        return self.world.on_published(self.required.resolved(topic), observe)

    def on_delivered(self, topic: str, observe: Callable[[Node, Any, Any], None]) -> str:
        """Observe what is received of a topic, which some node must offer. Return its full name."""
        self.world.expect(self.required.resolved(topic))
        return self.world.on_delivered(self.required.resolved(topic), observe)


@dataclass(frozen=True, repr=False)
class MotionProperty(Property):
    """A property of the motion in the odometry. Base class.

    Attributes:
        odom: Topic of type Odometry (default: 'odom'). 'ground_truth' for the true pose of a virtual
            robot that drifts.
    """

    odom: RosName = field(default='odom', kw_only=True)


M = TypeVar('M', bound=MotionProperty)


class MotionWatch(PropertyWatch[M]):
    """A watch of the last pose and twist in the odometry."""

    def __init__(self, required: M, world: Lockstep) -> None:
        """Observe a run."""
        super().__init__(required, world)
        self.pose: Pose | None = None
        self.twist: Twist | None = None
        self.odom = self.on_published(required.odom, self._on_odometry)

    def _on_odometry(self, publisher: Publisher, message: Any) -> None:
        self.pose = read_pose(publisher.msg_type, message)
        self.twist = read_twist(publisher.msg_type, message)
        if self.pose is None or self.twist is None:
            self.on_invalid()
        else:
            self.on_motion(self.pose, self.twist)

    def on_motion(self, pose: Pose, twist: Twist) -> None:
        """Receive a message of the odometry."""

    def on_invalid(self) -> None:
        """Receive bytes that are no Odometry."""
