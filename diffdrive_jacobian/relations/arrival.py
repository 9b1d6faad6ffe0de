"""Relations of when messages arrive: twice, or late."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from diffdrive_jacobian.faults.fault import Fault, RosName
from diffdrive_jacobian.lockstep._border import Endpoints
from diffdrive_jacobian.numerics.checks import NotNegative, Positive
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.relations.imaging import Imaging


@dataclass(frozen=True, repr=False)
class _Arrival(Relation):
    """How the messages of one topic arrive. Base class.

    Attributes:
        topic: Name of the topic. The nodes under test are those that are subscribed to it, unless `node`
            names one.
    """

    topic: RosName

    def is_disturbed_by(self, fault: Fault) -> bool:
        """Return True: what waits longer than it may because of a fault must not wait still longer."""
        return True

    def image(self, topic: str, message: Any) -> Any:
        """Return the message: what is said stays as it is."""
        return message

    def under_test(self, nodes: Mapping[str, Endpoints], namespace: str) -> set[str]:
        """Return the nodes that are subscribed to the topic."""
        return self._with_topic(nodes, namespace, self.topic, 'subscribed')

    def _is_of(self, topic: str) -> bool:
        """Return whether a full name is that of the topic, whatever its namespace."""
        return topic == self.topic or topic.endswith(f'/{self.topic}')


@dataclass(frozen=True, repr=False)
class Repeated(_Arrival):
    """Each message of a topic arrives twice, and nothing changes.

    It is compared in the world without faults. What a node says twice at the same time counts once.

    Attributes:
        after: Time after which it arrives again (s).
    """

    after: NotNegative = field(default=0.0, kw_only=True)

    def heard(self, topic: str, message: Any) -> list[tuple[float, Any]]:
        """Return the message twice."""
        return [(0.0, message), (self.after, message)] if self._is_of(topic) else [(0.0, message)]


@dataclass(frozen=True, repr=False)
class Late(_Arrival):
    """The messages of a topic arrive late, by less than their period, and the same is said, later.

    What comes after them waits, so the order stays. It is compared in the world without faults. Numbers
    must lie between those that were said in the first world, from one `period` before to `seconds` and
    one period after.

    Attributes:
        seconds: Delay of each message (s).
        period: The longest period of the nodes under test and of what they hear (s). Whether a message
            comes before a timer or after it may move an event by so much.
    """

    keeps_order: ClassVar[bool] = True

    seconds: Positive = 0.01
    period: Positive = field(default=0.1, kw_only=True)

    def heard(self, topic: str, message: Any) -> list[tuple[float, Any]]:
        """Return the message with its delay."""
        return [(self.seconds if self._is_of(topic) else 0.0, message)]

    def nearby(self) -> list[Imaging]:
        """Return none: between limits rounding decides nothing."""
        return []

    @property
    def early(self) -> float:
        """How much earlier the image may say something (s)."""
        return self.period

    @property
    def late(self) -> float:
        """How much later the image may say something (s)."""
        return self.seconds + self.period
