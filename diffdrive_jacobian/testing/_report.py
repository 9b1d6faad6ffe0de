"""What was said on the topics of a world, for the one who reads why a test has failed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

NANOSECONDS = 1_000_000_000
LONGEST_ARRAY = 4
"""Longer ones are told by their length and their first elements."""
SILENT = ('/clock', '/parameter_events', '/rosout')
"""Topics that tell nothing of a run."""


@dataclass(slots=True)
class _Line:
    """What one node said on one topic."""

    topic: str
    node: str
    count: int = 0
    at: int = 0
    message: Any = None


class Traffic:
    """Counts the messages of every publisher and remembers the last one.

    The publishers' own `publish` is wrapped for that: a reader for each topic would cost as much as
    the run, and change the counts of readers that nodes may look at.
    """

    def __init__(self, now: Callable[[], int]) -> None:
        """Begin without publishers; `now` gives the instant (ns)."""
        self._now = now
        self._lines: list[_Line] = []

    def watch(self, node: Node) -> None:
        """Watch those publishers of a node that are not watched yet."""
        for publisher in node.publishers:
            if 'publish' not in vars(publisher) and publisher.topic_name not in SILENT:
                self._watch(publisher, node.get_fully_qualified_name())

    def _watch(self, publisher: Any, node: str) -> None:
        line = _Line(publisher.topic_name, node)
        self._lines.append(line)
        publish, now = publisher.publish, self._now

        def counted(message: Any) -> None:
            line.count += 1
            line.at = now()
            line.message = message
            publish(message)

        publisher.publish = counted

    def describe(self, nodes: list[Node]) -> str:
        """Tell the last message of every topic, and the topics that are read but were silent."""
        said = [line for line in self._lines if line.count]
        lines = [
            f'  {line.topic}: {line.count} from {line.node}, last at {line.at / NANOSECONDS:g} s: '
            f'{brief(line.message)}'
            for line in sorted(said, key=lambda one: (one.topic, one.node))
        ]
        spoken = {line.topic for line in said}
        readers: dict[str, list[str]] = {}
        for node in nodes:
            for subscription in node.subscriptions:
                topic = subscription.topic_name
                if topic not in spoken and topic not in SILENT:
                    readers.setdefault(topic, []).append(node.get_fully_qualified_name())
        lines += [
            f'  {topic}: nothing; read by {", ".join(names)}' for topic, names in sorted(readers.items())
        ]
        return '\n'.join([f'last messages, at {self._now() / NANOSECONDS:g} s:', *(lines or ['  none'])])


def brief(message: Any) -> str:
    """Write a message in one line: those of its fields that are not zero."""
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
            if any(not _is_zero(one) for one in value):
                yield path, _array(value)
        elif not _is_zero(value):
            yield path, _scalar(value)


def _is_zero(value: Any) -> bool:
    return isinstance(value, (bool, int, float)) and value == 0


def _scalar(value: Any) -> str:
    if hasattr(value, 'get_fields_and_field_types'):
        return brief(value)
    if isinstance(value, float):
        return f'{value:.6g}' if math.isfinite(value) else str(value)
    return repr(value)


def _array(values: Any) -> str:
    plain = values.tolist() if hasattr(values, 'tolist') else list(values)
    shown = ', '.join(_scalar(value) for value in plain[:LONGEST_ARRAY])
    return f'[{shown}]' if len(plain) <= LONGEST_ARRAY else f'[{shown}, ... {len(plain)} in all]'
