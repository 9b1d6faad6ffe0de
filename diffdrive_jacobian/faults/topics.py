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

"""Faults of topics: messages that are lost, late, out of order, repeated, or old."""

from __future__ import annotations

import random
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

from diffdrive_jacobian.faults.fault import Filter, TopicFault
from diffdrive_jacobian.numerics.checks import Count, NotNegative, Positive, Probability
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds


@dataclass(frozen=True, repr=False)
class Loss(TopicFault):
    """Messages are lost: the receiver never gets them.

    Attributes:
        probability: Probability that a message is lost, or that a burst of lost messages begins.
        burst: Number of messages in a row that are lost each time.
    """

    probability: Probability = 1.0
    burst: Count = 1

    def begin(self, rng: random.Random, message_type: type) -> Filter:
        """Return the filter of one subscription."""
        left = 0

        def lose(_: int, data: bytes) -> list[tuple[int, bytes]]:
            nonlocal left
            if left == 0 and rng.random() < self.probability:
                left = self.burst
            if left == 0:
                return [(0, data)]
            left -= 1
            return []

        return lose


@dataclass(frozen=True, repr=False)
class Delay(TopicFault):
    """Messages arrive late, in the order in which they were published, also just after the fault.

    A message whose delay would let it overtake an earlier one arrives immediately after that.

    Attributes:
        seconds: Constant part of the delay (s).
        spread: Largest random part of the delay (s), uniformly distributed.
        growth: Growth of the delay since the fault began (s per s).
    """

    seconds: NotNegative
    spread: NotNegative = 0.0
    growth: NotNegative = 0.0

    keeps_order: ClassVar[bool] = True

    def begin(self, rng: random.Random, message_type: type) -> Filter:
        """Return the filter of one subscription."""
        start = nanoseconds(self.start)

        def delay(now: int, data: bytes) -> list[tuple[int, bytes]]:
            late = self.seconds + self.spread * rng.random()
            return [(nanoseconds(late + self.growth * (now - start) / NANOSECONDS), data)]

        return delay

    @property
    def longest_delay(self) -> float:
        """Delay at the end of the fault (s)."""
        growth = self.growth * self.duration if self.growth else 0.0
        return self.seconds + self.spread + growth


@dataclass(frozen=True, repr=False)
class Reorder(TopicFault):
    """Some messages are overtaken: they arrive late, after others that were published later.

    Attributes:
        probability: Probability that a message is held back.
        seconds: Time for which it is held back (s). If no other message is published meanwhile, it is
            late, but in order.
    """

    probability: Probability
    seconds: Positive

    def begin(self, rng: random.Random, message_type: type) -> Filter:
        """Return the filter of one subscription."""
        late = nanoseconds(self.seconds)

        def reorder(_: int, data: bytes) -> list[tuple[int, bytes]]:
            return [(late if rng.random() < self.probability else 0, data)]

        return reorder

    @property
    def longest_delay(self) -> float:
        """Time for which a message is held back (s)."""
        return self.seconds


@dataclass(frozen=True, repr=False)
class Duplicate(TopicFault):
    """Some messages arrive several times.

    Attributes:
        probability: Probability that a message is repeated.
        copies: Number of times that it arrives beyond the first.
        seconds: Time between two of its arrivals (s). 0: immediately after each other.
    """

    probability: Probability = 1.0
    copies: Count = 1
    seconds: NotNegative = 0.0

    def begin(self, rng: random.Random, message_type: type) -> Filter:
        """Return the filter of one subscription."""

        def duplicate(_: int, data: bytes) -> list[tuple[int, bytes]]:
            copies = self.copies if rng.random() < self.probability else 0
            return [(nanoseconds(number * self.seconds), data) for number in range(copies + 1)]

        return duplicate

    @property
    def longest_delay(self) -> float:
        """Time between the first and the last arrival of a message (s)."""
        return self.copies * self.seconds


@dataclass(frozen=True, repr=False)
class RateLimit(TopicFault):
    """At most `rate` messages per second arrive: one within 1/`rate` s of the last one is lost."""

    rate: Positive

    def begin(self, rng: random.Random, message_type: type) -> Filter:
        """Return the filter of one subscription."""
        period = nanoseconds(1.0 / self.rate)
        last: int | None = None

        def limit(now: int, data: bytes) -> list[tuple[int, bytes]]:
            nonlocal last
            if last is not None and now - last < period:
                return []
            last = now
            return [(0, data)]

        return limit


@dataclass(frozen=True, repr=False)
class Stale(TopicFault):
    """Instead of each message the last one before the fault arrives again, unchanged, stamp included.

    If there was none before, the first message during the fault arrives, and is then repeated.
    """

    def begin(self, rng: random.Random, message_type: type) -> Filter:
        """Return the filter of one subscription."""
        return _Stale()


class _Stale:
    def __init__(self) -> None:
        self._last: bytes | None = None

    def observe(self, _: int, data: bytes) -> None:
        """Keep a message that arrives unchanged."""
        self._last = data

    def __call__(self, _: int, data: bytes) -> Iterable[tuple[int, bytes]]:
        if self._last is None:
            self._last = data
        return [(0, self._last)]
