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

"""How what was said in the image of a world differs from the image of what was said."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import takewhile, zip_longest
from typing import Any, NamedTuple

from diffdrive_jacobian.lockstep._border import Speaker
from diffdrive_jacobian.lockstep._report import brief
from diffdrive_jacobian.messages.structure import (
    Array,
    FieldType,
    Number,
    Structure,
    is_identifier,
    is_stamp,
    plain,
    structure,
    walk,
)
from diffdrive_jacobian.messages.structure import Sequence as SequenceType
from diffdrive_jacobian.time_units import NANOSECONDS

STAMP_TOLERANCE = 1000
"""Largest difference of times in messages (ns): they may have been floats."""
SHOWN = 3
"""Number of fields that a difference names."""
QUATERNION = 'geometry_msgs/Quaternion'


class Spoken(NamedTuple):
    """A message of one publisher."""

    time: int
    """World time (ns)."""
    message: Any


class Difference(NamedTuple):
    """The first message that is not the image of what was said."""

    time: int
    """World time (ns)."""
    text: str
    speaker: Speaker | None = None
    """The publisher; None: the image has ended by an error."""


# --- Messages


def differing(one: Any, other: Any, tolerance: float, late: int = 0) -> list[str]:
    """Return how the fields of two messages differ: 'linear.x is 0.1, expected 0.2'.

    Args:
        one: What was said.
        other: What is expected.
        tolerance: Largest difference of numbers, above 1 relative to their size.
        late: Largest difference of times in messages (ns), beside that of rounding.
    """
    if isinstance(one, bytes) or isinstance(other, bytes) or type(one) is not type(other):
        return [] if one == other else [f'it is {brief(one)}, expected {brief(other)}']
    fields = zip_longest(fields_of(one), fields_of(other))
    found = []
    for mine, theirs in fields:
        if mine is None or theirs is None or mine[0] != theirs[0]:
            # An array of other length, whose length was noted before.
            break
        path, kind, value = mine
        if not is_close(kind, value, theirs[2], tolerance, late):
            found.append(f'{named(path)} {shown(kind, value)}, expected {shown(kind, theirs[2])}')
    return found


def exact(message: Any) -> str:
    """Return all fields of a message with every bit of the numbers, but no random identifiers."""
    if isinstance(message, bytes):
        return message.hex()
    fields = walk(structure(type(message)), message, whole=is_identifier)
    return ' '.join(repr(plain(value)) for _, kind, value in fields if not is_identifier(kind))


def fields_of(message: Any) -> Iterator[tuple[str, FieldType, Any]]:
    """Yield path, type and value of each field. Times, identifiers and quaternions are one value."""
    return walk(structure(type(message)), message, whole=_is_whole)


def _is_whole(kind: FieldType) -> bool:
    is_quaternion = isinstance(kind, Structure) and kind.name == QUATERNION
    return is_stamp(kind) or is_identifier(kind) or is_quaternion


def is_close(kind: FieldType, one: Any, other: Any, tolerance: float, late: int) -> bool:
    """Return whether two values of a field are equal but for rounding."""
    if isinstance(kind, Structure):
        if is_identifier(kind):
            # They are random.
            return True
        if is_stamp(kind):
            return abs(_nanoseconds(one) - _nanoseconds(other)) <= STAMP_TOLERANCE + late
        # A quaternion and its negative are the same rotation.
        first, second = components(one), components(other)
        return _allis_close(first, second, tolerance) or _allis_close(
            first, [-value for value in second], tolerance
        )
    if isinstance(kind, Number):
        return _allis_close([one], [other], tolerance) if kind.is_float else bool(one == other)
    if isinstance(kind, (Array, SequenceType)) and isinstance(kind.element, Number):
        first, second = plain(one), plain(other)
        if isinstance(first, tuple) and kind.element.is_float:
            return len(first) == len(second) and _allis_close(first, second, tolerance)
        return bool(first == second)
    return bool(plain(one) == plain(other))


def _allis_close(first: Iterable[float], second: Iterable[float], tolerance: float) -> bool:
    return all(
        one == other
        or (math.isnan(one) and math.isnan(other))
        or abs(one - other) <= tolerance * max(1.0, min(abs(one), abs(other)))
        for one, other in zip(first, second, strict=True)
    )


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def components(value: Any) -> list[float]:
    """Return the components of a quaternion."""
    return [value.x, value.y, value.z, value.w]


def shown(kind: FieldType, value: Any) -> str:
    """Return the value of a field as text."""
    if isinstance(kind, Structure):
        return brief(value)
    value = plain(value)
    if isinstance(value, float):
        return f'{value:.9g}'
    return f'{value!r:.80}'


# --- Publishers


def first_difference(
    speaker: Speaker,
    expected: Sequence[Spoken],
    image: Sequence[Spoken],
    *,
    tolerance: float,
    period: float = 0.0,
) -> tuple[Difference | None, int | None]:
    """Return the first difference of what a publisher said, and the time from which on it is unknown.

    What is said twice at one time counts once.

    Args:
        speaker: The publisher.
        expected: The images of what it has said.
        image: What it said in the image.
        tolerance: Largest difference of numbers.
        period: How far an event may be moved (s), after which nothing is compared.
    """
    expected, image = _once(expected, tolerance), _once(image, tolerance)
    for index, (old, new) in enumerate(zip_longest(expected, image)):
        if old is not None and new is not None and old.time == new.time:
            differences = differing(new.message, old.message, tolerance)
            if not differences:
                continue
            text = f'{"; ".join(differences[:SHOWN])}{_more(differences)}'
        elif new is None or (old is not None and old.time < new.time):
            text = f'nothing is said, expected {brief(old.message)}'
        else:
            text = f'{brief(new.message)} is said, expected nothing'
        time = min(one.time for one in (old, new) if one is not None)
        if _is_moved(old, image[index:], time, period, tolerance) or _is_moved(
            new, expected[index:], time, period, tolerance
        ):
            return None, time
        return Difference(time, f'{speaker.node} on {speaker.topic}: {text}', speaker), None
    return None, None


def _once(spoken: Sequence[Spoken], tolerance: float) -> list[Spoken]:
    """Leave out what is said again at the same time."""
    kept: list[Spoken] = []
    for one in spoken:
        same = takewhile(lambda other: other.time == one.time, reversed(kept))  # noqa: B023
        if all(differing(one.message, other.message, tolerance) for other in same):
            kept.append(one)
    return kept


def _is_moved(
    event: Spoken | None, others: Sequence[Spoken], time: int, period: float, tolerance: float
) -> bool:
    """Return whether something is said later in the other world, by up to a period."""
    if event is None or not period:
        return False
    last = time + round(period * NANOSECONDS)
    return any(
        not differing(other.message, event.message, tolerance, last - time)
        for other in others
        if time < other.time <= last
    )


def _more(differences: Sequence[str]) -> str:
    more = len(differences) - SHOWN
    return f'; and {more} more fields' if more > 0 else ''


def named(path: str) -> str:
    """Return the beginning of what is said of a field, or of a message that is one value."""
    return f'{path} is' if path else 'it is'
