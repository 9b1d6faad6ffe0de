"""The base classes of all faults.

A fault is a value: a frozen dataclass that can be compared, pickled and printed as the Python expression
that makes it. `Lockstep.inject` lets it happen. How it happens is in `install`, which uses the hooks
that the world offers to every fault (`Injection`).
"""

from __future__ import annotations

import math
import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import ClassVar

from diffdrive_jacobian.faults.expression import Expression
from diffdrive_jacobian.lockstep._injection import Injection
from diffdrive_jacobian.numerics.checks import NotNegative, PositiveOrInfinite
from diffdrive_jacobian.numerics.fields import Name, Text

Filter = Callable[[int, bytes], Iterable[tuple[int, bytes]]]
"""What a topic fault does with a message.

Receives the world time (ns since the start of the `Lockstep`) and the serialized message, while the
fault lasts. Returns the messages that arrive instead, each with its delay (ns): `[]` loses it,
`[(0, data)]` leaves it as it is. An attribute `observe(now, data)`, if there is one, is called with each
message before the fault begins and after it has ended.
"""


@dataclass(frozen=True, repr=False, kw_only=True)
class Fault(Expression, ABC):
    """Something that goes wrong in a `Lockstep`, from `start` for `duration`.

    Subclasses are decorated with `@dataclass(frozen=True, repr=False)`.

    Attributes:
        start: World time at which it begins, since the `Lockstep` was created (s). World time always
            advances, whatever the clock of the nodes shows.
        duration: How long it lasts (s); infinite: until the end.
    """

    start: NotNegative = 0.0
    duration: PositiveOrInfinite = math.inf

    @abstractmethod
    def install(self, injection: Injection) -> None:
        """Schedule the fault in a world."""


@dataclass(frozen=True, repr=False)
class TopicFault(Fault):
    """A fault of the messages of one topic.

    Each subscription has its own state and its own random numbers. Messages that a `Lockstep` itself
    observes (`listen`, `last`, the recorder) are not affected, unless `node` names its node.

    Attributes:
        topic: Name of the topic, resolved as by `Lockstep.publish`.
        node: Name of the node whose subscriptions are affected (default: all).
    """

    topic: Name
    node: Text = field(default='', kw_only=True)

    keeps_order: ClassVar[bool] = False
    """Whether a message never overtakes an earlier one, also not after the fault has ended."""
    at_publisher: ClassVar[bool] = False
    """Whether messages are changed when they are published, for all subscriptions and recorders alike.

    `node` is then the name of the publishing node.
    """

    @abstractmethod
    def begin(self, rng: random.Random, message_type: type) -> Filter:
        """Return what this fault does with the messages of one subscription.

        Args:
            rng: Random numbers of this fault for this subscription.
            message_type: Type of the messages.
        """

    def install(self, injection: Injection) -> None:
        """Filter the messages of the topic."""
        injection.filter_topic(
            self.topic,
            self.node,
            self.begin,
            keeps_order=self.keeps_order,
            at_publisher=self.at_publisher,
        )
