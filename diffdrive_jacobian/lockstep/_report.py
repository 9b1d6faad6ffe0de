"""What was said on the topics of a world, for the one who reads why a test has failed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.time_units import NANOSECONDS

LONGEST_ARRAY = 4
"""Longer ones are told by their length and their first elements."""
LONG_ARRAY = 100
"""Longer ones are told without a look at whether they are all zero."""
SILENT = ('/clock', '/parameter_events', '/rosout')
"""Topics that tell nothing of a run."""


@dataclass(slots=True)
class _Line:
    """What one publisher said."""

    topic: str
    count: int = 0
    at: int = 0
    message: Any = None


class Traffic:
    """Counts the messages of every publisher and remembers the last one.

    rclpy's `Publisher.publish` is wrapped for that while the world is open: a reader for each topic
    would cost as much as the run, and change the counts of readers that nodes may look at. The message
    is not copied: one that its node changes after publishing is told as changed.
    """

    def __init__(self, now: Callable[[], int]) -> None:
        """Begin without messages; `now` gives the instant (ns)."""
        self._now = now
        self._lines: dict[Publisher, _Line] = {}
        self._publish = Publisher.publish

    def listen(self) -> None:
        """Count from here on."""
        lines, publish, now = self._lines, self._publish, self._now

        def counted(self: Publisher, msg: Any) -> None:
            line = lines.get(self)
            if line is None:
                line = lines[self] = _Line(self.topic_name)
            line.count += 1
            line.at = now()
            line.message = msg
            publish(self, msg)

        Publisher.publish = counted

    def close(self) -> None:
        """Count no longer."""
        Publisher.publish = self._publish

    def describe(self, nodes: list[Node]) -> str:
        """Tell the last message of every topic, and the topics that are read but were silent."""
        names = {
            publisher: node.get_fully_qualified_name() for node in nodes for publisher in node.publishers
        }
        said = [
            (line.topic, names.get(publisher, 'a node that is gone'), line)
            for publisher, line in self._lines.items()
            if line.topic not in SILENT
        ]
        lines = [
            f'  {topic}: {line.count} from {node}, last at {line.at / NANOSECONDS:g} s: '
            f'{brief(line.message)}'
            for topic, node, line in sorted(said, key=lambda one: one[:2])
        ]
        spoken = {topic for topic, _, _ in said}
        readers: dict[str, list[str]] = {}
        for node in nodes:
            for subscription in node.subscriptions:
                topic = subscription.topic_name
                if topic not in spoken and topic not in SILENT:
                    readers.setdefault(topic, []).append(node.get_fully_qualified_name())
        lines += [
            f'  {topic}: nothing; read by {", ".join(names)}' for topic, names in sorted(readers.items())
        ]
        if strangers := _not_served(nodes):
            lines.append(f'  made, but not added to the world: {", ".join(strangers)}')
        return '\n'.join([f'last messages, at {self._now() / NANOSECONDS:g} s:', *(lines or ['  none'])])


def _not_served(nodes: list[Node]) -> list[str]:
    """Name the nodes of the context that are not in the world: what they should do they do not."""
    served = {node.get_fully_qualified_name() for node in nodes}
    there = nodes[0].get_node_names_and_namespaces() if nodes else []
    return sorted({f'{space.rstrip("/")}/{name}' for name, space in there} - served)


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
            if len(value) > LONG_ARRAY or any(not _is_zero(one) for one in value):
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
    first = values[:LONGEST_ARRAY]
    shown = ', '.join(map(_scalar, first.tolist() if hasattr(first, 'tolist') else first))
    return f'[{shown}]' if len(values) <= LONGEST_ARRAY else f'[{shown}, ... {len(values)} in all]'
