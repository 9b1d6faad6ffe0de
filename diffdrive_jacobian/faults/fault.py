"""The base classes of all faults.

A fault is a value: a frozen dataclass that can be compared, pickled and printed as the Python expression
that makes it. `Lockstep.inject` lets it happen. How it happens is in `install`, which uses the hooks
that the world offers to every fault (`lockstep._injection.Injection`).
"""

from __future__ import annotations

import math
import numbers
import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import ClassVar

from diffdrive_jacobian.faults.expression import Expression
from diffdrive_jacobian.lockstep import Injection

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

    start: float = 0.0
    duration: float = math.inf

    def __post_init__(self) -> None:
        """Check the times.

        Raises:
            ValueError: A value is invalid.
        """
        self._number('start', low=0.0)
        self._number('duration', low=0.0, infinite=True, above=True)

    @abstractmethod
    def install(self, injection: Injection) -> None:
        """Schedule the fault in a world."""

    def _number(
        self,
        name: str,
        *,
        low: float = -math.inf,
        high: float = math.inf,
        above: bool = False,
        infinite: bool = False,
    ) -> None:
        """Check that a field is a number between two limits, and make it a float.

        Args:
            name: Name of the field.
            low: Least value.
            high: Largest value.
            above: Whether the value must be larger than `low`.
            infinite: Whether it may be infinite.

        Raises:
            ValueError: It is not.
        """
        value = getattr(self, name)
        valid = not isinstance(value, bool) and isinstance(value, numbers.Real)
        if valid:
            value = float(value)
            valid = low < value <= high if above else low <= value <= high
            valid = valid and (infinite or math.isfinite(value))
        if not valid:
            allowed = _range(low, high, above) + (', or infinite' if infinite else '')
            raise ValueError(f'{type(self).__name__}: {name} must be {allowed}, got {value!r}')
        object.__setattr__(self, name, value)

    def _count(self, name: str) -> None:
        """Check that a field is a positive integer.

        Raises:
            ValueError: It is not.
        """
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < 1:
            raise ValueError(
                f'{type(self).__name__}: {name} must be an integer of at least 1, got {value!r}'
            )
        object.__setattr__(self, name, int(value))


@dataclass(frozen=True, repr=False)
class TopicFault(Fault):
    """A fault of the messages of one topic.

    Each subscription has its own state and its own random numbers. Messages that a `Lockstep` itself
    observes (`listen`, `last`, the recorder) are not affected, unless `node` names its node.

    Attributes:
        topic: Name of the topic, resolved as by `Lockstep.publish`.
        node: Name of the node whose subscriptions are affected (default: all).
    """

    topic: str
    node: str = field(default='', kw_only=True)

    keeps_order: ClassVar[bool] = False
    """Whether a message never overtakes an earlier one, also not after the fault has ended."""
    at_publisher: ClassVar[bool] = False
    """Whether messages are changed when they are published, for all subscriptions and recorders alike.

    `node` is then the name of the publishing node.
    """

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ValueError: A value is invalid.
        """
        super().__post_init__()
        self._text('topic')
        self._text('node', empty=True)

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


def _range(low: float, high: float, above: bool) -> str:
    if math.isfinite(low) and math.isfinite(high):
        return f'{"above" if above else "between"} {low:g} and {"at most " if above else ""}{high:g}'
    if math.isfinite(low):
        return f'a number above {low:g}' if above else f'a number of at least {low:g}'
    return 'a finite number'
