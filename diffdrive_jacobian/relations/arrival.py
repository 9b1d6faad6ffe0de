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

"""Relations of when messages arrive: twice, or late."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar

from diffdrive_jacobian.faults.fault import Fault, RosName
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.numerics.checks import NotNegative, Positive
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.relations.imaging import Imaging
from diffdrive_jacobian.relations.worlds import Ran
from diffdrive_jacobian.time_units import NANOSECONDS


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

    @property
    def topics(self) -> tuple[str, ...]:
        """The topic."""
        return (self.topic,)

    def _at_topic(self, first: Ran) -> set[str]:
        """Return the nodes that are subscribed to the topic."""
        return first.subscribers(self.topic)

    def in_world(self, world: Lockstep) -> Imaging:
        """Return it with the full name that its topic has in a world."""
        return replace(self, topic=world.node.resolve_topic_name(self.topic))


@dataclass(frozen=True, repr=False)
class Repeated(_Arrival):
    """Each message of a topic arrives twice, and nothing changes.

    It is compared in the world without faults.

    Attributes:
        after: Time after which it arrives again (s).
    """

    after: NotNegative = field(default=0.0, kw_only=True)

    def heard(self, topic: str, message: Any) -> list[tuple[float, Any]]:
        """Return the message twice."""
        return [(0.0, message), (self.after, message)] if topic == self.topic else [(0.0, message)]


@dataclass(frozen=True, repr=False)
class Late(_Arrival):
    """The messages of a topic arrive late, by less than their period, and the same is said, later.

    What comes after them waits, so the order stays. It is compared in the world without faults. Numbers
    must lie between those that were said in the first world, from `seconds` and one `period` before to
    one `period` after. The last such time of a world is not compared.

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
        return [(self.seconds if topic == self.topic else 0.0, message)]

    def nearby(self, first: Ran) -> list[Imaging]:
        """Return none: rounding is covered by the limits."""
        return []

    def fitted(self, first: Ran) -> Late:
        """Check that messages are late by less than their period."""
        name = first.full(self.topic)
        times = [one.time for one in first.messages if one.speaker.topic == name]
        gaps = sorted(after - before for before, after in pairwise(times) if after > before)
        period = gaps[len(gaps) // 2] / NANOSECONDS if gaps else math.inf
        if self.seconds >= period:
            raise LockstepError(
                f'{self!r}: seconds must be less than the period of {name}, which is {period:g} s'
            )
        return self

    @property
    def early(self) -> float:
        """How much earlier the image may say something (s)."""
        return self.period

    @property
    def late(self) -> float:
        """How much later the image may say something (s)."""
        return self.seconds + self.period
