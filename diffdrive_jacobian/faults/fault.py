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

"""The base classes of all faults.

A fault is a value: a frozen dataclass that can be compared, pickled and printed as the Python expression
that makes it. `Lockstep.inject` lets it happen. How it happens is in `install`, which uses what the
world offers to every fault (`Injection`).
"""

from __future__ import annotations

import math
import random
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields
from typing import Annotated, Any, ClassVar

from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.validate_topic_name import validate_topic_name

from diffdrive_jacobian.lockstep._injection import Filter as Filter
from diffdrive_jacobian.lockstep._injection import Injection
from diffdrive_jacobian.lockstep._injection import Undo as Undo
from diffdrive_jacobian.numerics.checks import Checked, NotNegative, PositiveOrInfinite, nonempty

LONG, SHOWN = 8, 2
"""Length beyond which a message shows the beginning of a sequence only, and how many elements of it."""


def _ros_name(name: str, value: Any) -> str:
    """Require the name of a topic or a service, relative names and private ones included."""
    try:
        validate_topic_name(nonempty(name, value))
    except InvalidTopicNameException as error:
        why = str(error).splitlines()[0].rstrip(':')
        raise ValueError(f'{name} must be a name as ROS has them, got {value!r}: {why}') from None
    return str(value)


RosName = Annotated[str, _ros_name]


class Expression(Checked):
    """Base class of checked dataclasses that are printed as the expression that makes them.

    Subclasses are dataclasses with `repr=False`.
    """

    def __post_init__(self) -> None:
        """Check the fields. Errors begin with the name of the class."""
        try:
            super().__post_init__()
        except ValueError as error:
            raise ValueError(f'{type(self).__name__}: {error}') from None

    def __repr__(self) -> str:
        """Return the expression that makes this value."""
        return self._expression(literal)

    def __str__(self) -> str:
        """Return the expression with long sequences cut, for messages."""
        return self._expression(brief)

    def _expression(self, literal: Callable[[Any], str]) -> str:
        shown = []
        own: Any = self
        for one in sorted(fields(own), key=lambda one: bool(one.kw_only)):
            value = getattr(self, one.name)
            if one.default is MISSING and not one.kw_only:
                shown.append(literal(value))
            elif value != one.default:
                shown.append(f'{one.name}={literal(value)}')
        return f'{type(self).__name__}({", ".join(shown)})'


def literal(value: Any) -> str:
    """Return a Python expression for a value; `repr` of an infinite float is none."""
    if isinstance(value, float) and not math.isfinite(value):
        return f"float('{value}')"
    if isinstance(value, (list, tuple)):
        inner = ', '.join(map(literal, value))
        return f'[{inner}]' if isinstance(value, list) else f'({inner}{"," * (len(value) == 1)})'
    return repr(value)


def brief(value: Any) -> str:
    """Return `literal` of a value, of a long sequence only the beginning."""
    if isinstance(value, (list, tuple)) and len(value) > LONG:
        first = literal(value[:SHOWN])
        return f'{first[:-1]}, ... {len(value)} in all{first[-1]}'
    return literal(value)


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

    at_once: ClassVar[bool] = False
    """Whether it happens once, when it begins, and is over then unless it has a duration."""

    @abstractmethod
    def install(self, injection: Injection) -> None:
        """Schedule what the fault does to a world when it begins and ends."""

    @property
    def end(self) -> float:
        """World time at which it has ended (s); infinite: never."""
        if self.at_once and math.isinf(self.duration):
            return self.start
        return self.start + self.duration

    @property
    def longest_delay(self) -> float:
        """How long something that it has delayed is under way at most (s)."""
        return 0.0

    @property
    def clock_jumps(self) -> tuple[float, ...]:
        """World times at which the clock of the nodes jumps because of it (s)."""
        return ()

    @property
    def affected_node(self) -> str:
        """Name of the node that it affects; empty: none in particular."""
        return ''

    def reaction_delay(self, node: Node, since: float, now: float) -> float:
        """Return by how much it may have delayed a reaction of the node that it affects (s).

        The node could react from the world time `since` on, and did at `now` (s).
        """
        return 0.0

    def overlap(self, since: float, now: float) -> float:
        """Return how much of an interval of world time it lasts (s); negative: it is as far away."""
        return min(now, self.start + self.duration) - max(since, self.start)


@dataclass(frozen=True, repr=False)
class TopicFault(Fault):
    """A fault of the messages of one topic.

    Each subscription has its own state and its own random numbers. Messages that a `Lockstep` itself
    observes (`listen`, `last`, the recorder) are not affected, unless `node` names its node.

    Attributes:
        topic: Name of the topic, resolved as by `Lockstep.publish`.
        node: Name of the node whose subscriptions are affected (default: all).
    """

    topic: RosName
    node: str = field(default='', kw_only=True)

    keeps_order: ClassVar[bool] = False
    """Whether a message never overtakes an earlier one, also not after the fault has ended."""

    @abstractmethod
    def begin(self, rng: random.Random, message_type: type) -> Filter:
        """Return what this fault does with the messages of one subscription, with its random numbers."""

    def install(self, injection: Injection) -> None:
        """Filter the messages of the topic."""
        injection.filter_topic(self.topic, self.node, self.begin, keeps_order=self.keeps_order)
