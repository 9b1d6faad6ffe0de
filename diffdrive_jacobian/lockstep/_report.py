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

"""The last messages of all topics, for the reports of failed tests."""

from __future__ import annotations

import math
from collections.abc import Sequence as Values
from typing import TYPE_CHECKING, Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.messages.structure import (
    Array,
    FieldType,
    Sequence,
    Structure,
    Text,
    is_stamp,
    plain,
    structure,
    walk,
)
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep._link import Source

REPORT = 'last messages'
"""Beginning of the report."""
MAX_SHOWN = 4
"""Number of elements that are shown of an array."""
MAX_TEXT = 80
"""Most characters of a text field that are shown."""
MAX_CHECKED = 100
"""Length up to which arrays of zeros are omitted. Longer ones are not searched."""


def describe(
    sources: Values[tuple[Publisher, Source]],
    nodes: Values[Node],
    existing: Values[Node],
    now: int,
    world_time: int,
) -> str:
    """Return the last message of each publisher, and the subscribed topics without messages, as text.

    Args:
        sources: What was published, each with its publisher.
        nodes: The nodes of the world.
        existing: These, and those that were created but not added.
        now: Simulated time (ns).
        world_time: Time since the start (ns).
    """
    names = {
        publisher: node.get_fully_qualified_name() for node in existing for publisher in node.publishers
    }
    published = [
        (source.topic, names.get(publisher, 'a destroyed publisher'), source)
        for publisher, source in sources
        if source.topic not in NOT_OF_ROBOTS
    ]
    lines = [
        f'  {topic}: {source.count} from {node}, last at {source.last[1] / NANOSECONDS:g} s: '
        f'{brief(source.received())}'
        for topic, node, source in sorted(published, key=lambda item: item[:2])
    ]
    active = {topic for topic, _, _ in published}
    subscribers: dict[str, list[str]] = {}
    for node in nodes:
        for subscription in node.subscriptions:
            topic = subscription.topic_name
            if topic not in active and topic not in NOT_OF_ROBOTS:
                subscribers.setdefault(topic, []).append(node.get_fully_qualified_name())
    lines += [
        f'  {topic}: no message; subscribed by {", ".join(dict.fromkeys(those))}'
        for topic, those in sorted(subscribers.items())
    ]
    # Their callbacks are not executed.
    if missing := [node.get_fully_qualified_name() for node in existing if node not in nodes]:
        lines.append(f'  created, but not added to lockstep: {", ".join(sorted(missing))}')
    clock, passed = now / NANOSECONDS, world_time / NANOSECONDS
    title = f'{REPORT}, at {clock:g} s of the clock, {passed:g} s after the start:'
    return '\n'.join([title, *(lines or ['  none'])])


def brief(message: Any) -> str:
    """Return a message as one line with its nonzero fields."""
    if isinstance(message, bytes):
        return f'{len(message)} serialized bytes'
    kind = structure(type(message))
    fields = (
        (path, _shown(field, value)) for path, field, value in walk(kind, message, whole=_is_shown_whole)
    )
    return f'{kind.short_name}({", ".join(f"{path}={text}" for path, text in fields if text)})'


def _is_shown_whole(kind: FieldType) -> bool:
    return is_stamp(kind) or isinstance(kind, (Array, Sequence))


def _shown(kind: FieldType, value: Any) -> str:
    """Return the value of a field; '': it is zero, false or empty."""
    if value is None:
        # Not valid any more, see `Source.received`.
        return 'None'
    if is_stamp(kind):
        nonzero = value.sec or value.nanosec
        return f'{value.sec + value.nanosec / NANOSECONDS:.9g} s' if nonzero else ''
    match kind:
        case Array(element=element) | Sequence(element=element):
            zero = len(value) <= MAX_CHECKED and all(_is_zero(one) for one in value)
            return '' if zero else _array(element, value)
        case Text():
            return printable(repr(value), MAX_TEXT) if value else ''
        case _:
            return '' if _is_zero(value) else _scalar(kind, value)


def _is_zero(value: Any) -> bool:
    return isinstance(value, (bool, int, float)) and value == 0


def _scalar(kind: FieldType, value: Any) -> str:
    if isinstance(kind, Structure):
        return brief(value)
    if isinstance(value, float):
        # Six digits, or all of them where that is shorter: 5e-324.
        return min(f'{value:.6g}', repr(value), key=len) if math.isfinite(value) else str(value)
    return repr(value)


def _array(element: FieldType, values: Any) -> str:
    shown = ', '.join(_scalar(element, one) for one in plain(values[:MAX_SHOWN]))
    return f'[{shown}]' if len(values) <= MAX_SHOWN else f'[{shown}, ... {len(values)} in all]'
