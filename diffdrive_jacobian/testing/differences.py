"""Comparison of the messages of two runs, field by field."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Values
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, TypeAlias

from diffdrive_jacobian.messages.fields import is_identifier, plain, walk
from diffdrive_jacobian.messages.structure import COUNT, Array, FieldType, Sequence, structure
from diffdrive_jacobian.time_units import NANOSECONDS

Messages: TypeAlias = Values[tuple[int, bytes]]
"""Messages of a topic: the time of each (ns), and its CDR."""
MAX_SHOWN = 200
"""Length of the longest value that is shown (characters)."""


@dataclass(frozen=True, slots=True)
class TopicDifference:
    """How the messages of a topic differ from the golden ones."""

    topic: str
    time: int
    """Time of the first message that differs (ns)."""
    first: str
    """Which message that is, and how it differs."""
    different: int
    """Number of messages that differ, are missing or are additional."""
    compared: int
    """Number of messages, of the run that has more."""


class Comparison:
    """Comparison of a run with a golden one.

    Identifiers (`unique_identifier_msgs/UUID`) are random, such as those of goals. They are equal if
    each identifier of the run always stands for the same one of the golden run.
    """

    def __init__(self, tolerance: float) -> None:
        """Set the tolerance: the largest difference of two floats, relative to the smaller one if that
        exceeds 1. Everything else must be equal, times included.
        """
        self._tolerance = tolerance
        self._golden_of: dict[bytes, bytes] = {}
        self._run_of: dict[bytes, bytes] = {}

    def of_topic(
        self, topic: str, run: Messages, golden: Messages, deserialize: Callable[[bytes], Any]
    ) -> TopicDifference | None:
        """Compare the messages of a topic, each with the golden one of the same number.

        Args:
            topic: Its name.
            run: Its messages.
            golden: Its messages in the golden run.
            deserialize: Returns a message from its CDR.

        Returns:
            The difference; None: there is none.
        """
        first: tuple[int, str] | None = None
        different = 0
        for number, (one, other) in enumerate(zip_longest(run, golden), start=1):
            what = self._difference(one, other, deserialize)
            if what is None:
                continue
            different += 1
            if first is None:
                time = min(message[0] for message in (one, other) if message is not None)
                first = time, f'message {number} of {topic}, {what}'
        if first is None:
            return None
        return TopicDifference(topic, *first, different, max(len(run), len(golden)))

    def _difference(
        self,
        one: tuple[int, bytes] | None,
        golden: tuple[int, bytes] | None,
        deserialize: Callable[[bytes], Any],
    ) -> str | None:
        """Return how a message differs from the golden one; None: it does not."""
        if one is None or golden is None:
            present = one or golden
            assert present is not None
            return f'at {_seconds(present[0])}, is {"missing" if one is None else "additional"}'
        if one[0] != golden[0]:
            return f'was published at {_seconds(one[0])}, golden at {_seconds(golden[0])}'
        if one[1] == golden[1]:
            return None
        for path, kind, value, expected in _pairs(deserialize(one[1]), deserialize(golden[1])):
            if (what := self._value_difference(kind, value, expected)) is not None:
                return f'at {_seconds(one[0])}: {path} {what}'
        # Only the bytes of the padding differ, or identifiers.
        return None

    def _value_difference(self, kind: FieldType, value: Any, golden: Any) -> str | None:
        """Return how a value differs from the golden one; None: it does not. NaN is equal to NaN."""
        if is_identifier(kind):
            one, other = bytes(value.uuid), bytes(golden.uuid)
            renamed = self._golden_of.setdefault(one, other), self._run_of.setdefault(other, one)
            return (
                None if renamed == (other, one) else 'identifies something else than in the golden run'
            )
        if value == golden or (value != value and golden != golden):
            return None
        if not isinstance(value, float):
            return f'is {_shown(value)}, golden {_shown(golden)}'
        apart = abs(value - golden)
        if math.isfinite(apart) and apart <= self._tolerance * max(1.0, min(abs(value), abs(golden))):
            return None
        return f'is {value!r}, golden {golden!r}: differs by {apart:.3g}, allowed {self._tolerance:g}'


def _pairs(value: Any, golden: Any) -> Iterator[tuple[str, FieldType, Any, Any]]:
    """Yield path and type of each number or string of two messages of one type, and its two values."""
    kind = structure(type(value))
    walks = (walk(kind, one, whole=is_identifier) for one in (value, golden))
    # Where a length differs, what follows does not correspond, but the length comes first.
    for (path, field, one), (_, _, other) in zip(*walks, strict=False):
        if not isinstance(field, (Array, Sequence)):
            yield path, field, one, other
            continue
        if len(one) != len(other):
            yield f'len({path})', COUNT, len(one), len(other)
        for index, pair in enumerate(zip(plain(one), plain(other), strict=False)):
            yield f'{path}[{index}]', field.element, *pair


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else f'{text[:MAX_SHOWN]}...'


def _seconds(time: int) -> str:
    seconds, rest = divmod(time, NANOSECONDS)
    # Exact, also for the time of today.
    return f'{seconds}.{rest:09}'.rstrip('0').rstrip('.') + ' s'
