"""The last messages of all topics, for the reports of failed tests."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.time_units import NANOSECONDS

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep._link import Source

MAX_SHOWN = 4
"""Number of elements that are shown of an array."""
MAX_CHECKED = 100
"""Length up to which arrays of zeros are omitted. Longer ones are not searched."""
OMITTED = ('/clock', '/fault_events', '/parameter_events', '/rosout')
"""Topics that are not reported."""


def describe(
    sources: Sequence[tuple[Publisher | None, Source]],
    nodes: Sequence[Node],
    existing: Sequence[Node],
    now: int,
    world_time: int,
) -> str:
    """Return the last message of each publisher, and the subscribed topics without messages, as text.

    Args:
        sources: What was published, each with its publisher. None: by other processes.
        nodes: The nodes of the world.
        existing: These, and those that were created but not added.
        now: Simulated time (ns).
        world_time: Time since the start (ns).
    """
    names: dict[Publisher | None, str] = {
        publisher: node.get_fully_qualified_name() for node in existing for publisher in node.publishers
    }
    names[None] = 'other processes'
    published = [
        (source.topic, names.get(publisher, 'a destroyed publisher'), source)
        for publisher, source in sources
        if source.topic not in OMITTED or publisher is None
    ]
    lines = [
        f'  {topic}: {source.count} from {node}, last at {source.at / NANOSECONDS:g} s: '
        f'{brief(source.received())}'
        for topic, node, source in sorted(published, key=lambda item: item[:2])
    ]
    active = {topic for topic, _, _ in published}
    subscribers: dict[str, list[str]] = {}
    for node in nodes:
        for subscription in node.subscriptions:
            topic = subscription.topic_name
            if topic not in active and topic not in OMITTED:
                subscribers.setdefault(topic, []).append(node.get_fully_qualified_name())
    lines += [
        f'  {topic}: no message; subscribed by {", ".join(dict.fromkeys(those))}'
        for topic, those in sorted(subscribers.items())
    ]
    # Their callbacks are not executed.
    if missing := [node.get_fully_qualified_name() for node in existing if node not in nodes]:
        lines.append(f'  created, but not added to lockstep: {", ".join(sorted(missing))}')
    clock, passed = now / NANOSECONDS, world_time / NANOSECONDS
    title = f'last messages, at {clock:g} s of the clock, {passed:g} s after the start:'
    return '\n'.join([title, *(lines or ['  none'])])


def brief(message: Any) -> str:
    """Return a message as one line with its nonzero fields."""
    if isinstance(message, bytes):
        return f'{len(message)} serialized bytes'
    fields = ', '.join(f'{name}={value}' for name, value in _fields(message, ''))
    return f'{type(message).__name__}({fields})'


def _fields(message: Any, prefix: str) -> Iterator[tuple[str, str]]:
    for name in message.get_fields_and_field_types():
        value, path = getattr(message, name), prefix + name
        if hasattr(value, 'get_fields_and_field_types'):
            if {'sec', 'nanosec'} == set(value.get_fields_and_field_types()):
                if value.sec or value.nanosec:
                    yield path, f'{value.sec + value.nanosec / NANOSECONDS:.9g} s'
            else:
                yield from _fields(value, f'{path}.')
        elif isinstance(value, (str, bytes)):
            if value:
                yield path, repr(value)
        elif hasattr(value, '__len__'):
            if len(value) > MAX_CHECKED or any(not _is_zero(element) for element in value):
                yield path, _array(value)
        elif not _is_zero(value):
            yield path, _scalar(value)


def _is_zero(value: Any) -> bool:
    return isinstance(value, (bool, int, float)) and value == 0


def _scalar(value: Any) -> str:
    if hasattr(value, 'get_fields_and_field_types'):
        return brief(value)
    if isinstance(value, float):
        # Six digits, or all of them where that is shorter: 5e-324.
        return min(f'{value:.6g}', repr(value), key=len) if math.isfinite(value) else str(value)
    return repr(value)


def _array(values: Any) -> str:
    first = values[:MAX_SHOWN]
    shown = ', '.join(map(_scalar, first.tolist() if hasattr(first, 'tolist') else first))
    return f'[{shown}]' if len(values) <= MAX_SHOWN else f'[{shown}, ... {len(values)} in all]'
