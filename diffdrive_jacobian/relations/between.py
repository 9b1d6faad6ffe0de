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

"""Whether what was said in the image of a world lies between what was said around its time."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise
from operator import attrgetter
from typing import Any

from diffdrive_jacobian.lockstep._border import Speaker
from diffdrive_jacobian.lockstep._report import brief
from diffdrive_jacobian.messages.structure import Array, FieldType, Number, Structure, plain
from diffdrive_jacobian.messages.structure import Sequence as SequenceType
from diffdrive_jacobian.relations.differences import (
    QUATERNION,
    Difference,
    Spoken,
    components,
    differing,
    fields_of,
    is_close,
    named,
    shown,
)

FIRST, IMAGE = 'in the first world', 'in the image'


def first_outside(
    speaker: Speaker,
    expected: Sequence[Spoken],
    image: Sequence[Spoken],
    *,
    tolerance: float,
    early: int,
    late: int,
    end: int,
) -> Difference | None:
    """Return the first message that is not between those of the other world around its time.

    Args:
        speaker: The publisher.
        expected: The images of what it has said.
        image: What it said in the image.
        tolerance: Largest difference of numbers.
        early: How much earlier the image may say something (ns).
        late: How much later (ns).
        end: Time until which both were listened to (ns).
    """
    found = []
    for here, there, before, after, names in (
        (image, expected, late, early, (IMAGE, FIRST)),
        (expected, image, early, late, (FIRST, IMAGE)),
    ):
        for one in here:
            if one.time + after >= end:
                break
            near = _around(there, one.time - before, one.time + after)
            if text := _not_between(one, near, tolerance, early + late, *names):
                found.append(Difference(one.time, text))
    if not found:
        return None
    first = min(found, key=lambda difference: difference.time)
    text = f'{speaker.node} on {speaker.topic}: {first.text}'
    return Difference(first.time, text, speaker)


def _around(spoken: Sequence[Spoken], first: int, last: int) -> Sequence[Spoken]:
    """Return what was said between two times (ns), both included."""
    begin = bisect_left(spoken, first, key=attrgetter('time'))
    return spoken[begin : bisect_right(spoken, last, key=attrgetter('time'))]


def _not_between(
    one: Spoken, near: Sequence[Spoken], tolerance: float, late: int, here: str, there: str
) -> str:
    """Return why a message is not between others; '': it is. `here` and `there` say where they are."""
    if not near:
        return f'{brief(one.message)} {here}, and nothing {there} around this time'
    if any(not differing(two.message, one.message, tolerance, late) for two in near):
        return ''
    others = [{path: value for path, _, value in fields_of(two.message)} for two in near]
    for path, kind, value in fields_of(one.message):
        values = [other[path] for other in others if path in other]
        if any(is_close(kind, value, other, tolerance, late) for other in values):
            continue
        numbers, series = _numbers(kind, value), [_numbers(kind, other) for other in values]
        series = [other for other in series if len(other) == len(numbers)]
        if not numbers or not series:
            return f'{named(path)} {shown(kind, value)} {here}, another one {there} around this time'
        if isinstance(kind, Structure):
            series = [_aligned(other, numbers) for other in series]
        for index, number in enumerate(numbers):
            along = [other[index] for other in series]
            # An event that comes one message earlier cuts off the last step before it.
            step = max((abs(after - before) for before, after in pairwise(along)), default=0.0)
            margin = step + tolerance * max(1.0, abs(number))
            if not min(along) - margin <= number <= max(along) + margin:
                return (
                    f'{named(path)} {number:.9g} {here}, '
                    f'from {min(along):.9g} to {max(along):.9g} {there} around this time'
                )
    return ''


def _numbers(kind: FieldType, value: Any) -> Sequence[float]:
    """Return the numbers of a field that may lie between others. One byte has a meaning, and may not."""
    match kind:
        case Structure(name=name) if name == QUATERNION:
            return components(value)
        case Number() if kind.size > 1:
            return [value]
        case Array(Number() as element) | SequenceType(Number() as element) if element.size > 1:
            return tuple(plain(value))
    return ()


def _aligned(quaternion: Sequence[float], other: Sequence[float]) -> Sequence[float]:
    """Return that of the two quaternions of a rotation which is nearer to another one."""
    product = sum(one * two for one, two in zip(quaternion, other, strict=True))
    return quaternion if product >= 0.0 else [-one for one in quaternion]
