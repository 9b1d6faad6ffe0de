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

"""What faults did, for the report, the recording and the tests."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import Any

from rclpy.publisher import Publisher
from std_msgs.msg import String

from diffdrive_jacobian.time_units import NANOSECONDS, in_seconds

MAX_EVENTS = 200
"""Largest number of events of one fault. Later ones are omitted, except its end with the totals."""
MAX_REPORTED = 20
"""Number of events at the end of a report."""


@dataclass(frozen=True)
class FaultEvent:
    """What a fault did.

    Attributes:
        time_ns: World time, since the `Lockstep` was created (ns).
        fault: The fault.
        what: What it did.
        clock_ns: Time of the clock of the nodes (ns).
    """

    time_ns: int
    fault: Any
    what: str
    clock_ns: int = 0

    def __str__(self) -> str:
        """Return the event as one line."""
        return f'{in_seconds(self.time_ns)}: {self.fault!r} {self.what}'

    def message(self) -> String:
        """Return the event as a message: a JSON object.

        Time (s), fault as Python source, what it did, and the fault as data: kind and arguments.
        """
        given = {one.name: getattr(self.fault, one.name) for one in fields(self.fault)}
        event = {
            'time': self.time_ns / NANOSECONDS,
            'fault': repr(self.fault),
            'what': self.what,
            'kind': type(self.fault).__name__,
            'arguments': {name: value for name, value in given.items() if _is_data(value)},
        }
        return String(data=json.dumps(event))


def _is_data(value: object) -> bool:
    """Return whether a value is a finite number or text, as JSON has them."""
    return isinstance(value, (str, int)) or (isinstance(value, float) and math.isfinite(value))


class FaultLog:
    """The events of all faults."""

    def __init__(self, times: Callable[[], tuple[int, int]]) -> None:
        """Start without events.

        Args:
            times: Returns the world time and the time of the clock of the nodes (ns).
        """
        self._times = times
        self._counts: Counter[int] = Counter()
        self.events: list[FaultEvent] = []
        self.publisher: Publisher | None = None
        """Publishes the events."""

    def add(self, position: int, fault: Any, what: str, *, last: bool = False) -> None:
        """Add an event.

        Args:
            position: Number of the fault.
            fault: The fault.
            what: What it did.
            last: Whether it is the end of the fault, which is never omitted.
        """
        self._counts[position] += 1
        if self._counts[position] > MAX_EVENTS and not last:
            return
        if self._counts[position] == MAX_EVENTS:
            what += ' (further events of this fault are omitted)'
        event = self.event(fault, what)
        self.events.append(event)
        if self.publisher is not None:
            self.publisher.publish(event.message())

    def event(self, fault: Any, what: str) -> FaultEvent:
        """Return an event of the current time."""
        world, clock = self._times()
        return FaultEvent(world, fault, what, clock)


class Hits:
    """The messages of one subscription that a fault affected, as events of consecutive ones.

    They are numbered from 1, from the injection of the fault.
    """

    def __init__(self, name: str, note: Callable[[str], None]) -> None:
        """Start without messages.

        Args:
            name: Name of the topic and of the node.
            note: Adds an event.
        """
        self.name = name
        self._note = note
        self._number = 0
        self.counts: Counter[str] = Counter()
        """Messages `during` the fault, those that it `hit`, and later ones `behind` them."""
        # Of the messages that are not noted yet: what happened, first and last number, and time.
        self._kind = ''
        self._first = self._last = self._since = self._until = 0
        self._delays = (0, 0)

    def add(self, now: int, data: bytes, out: list[tuple[int, bytes]], *, active: bool) -> None:
        """Add a message.

        Args:
            now: World time (ns).
            data: The message.
            out: What came out instead.
            active: Whether the fault is active.
        """
        self._number += 1
        self.counts['during'] += active
        kind = _kind(data, out)
        if kind != self._kind:
            self.flush()
            self._kind, self._first, self._since = kind, self._number, now
            self._delays = (0, 0)
        if kind:
            self.counts['hit' if active else 'behind'] += 1
            self._last, self._until = self._number, now
            delays = [delay for delay, _ in out if delay > 0]
            least, most = self._delays
            if delays:
                self._delays = min([*delays, *([least] if most else [])]), max([*delays, most])

    def flush(self) -> None:
        """Note the messages since the last event."""
        if text := self.open():
            self._note(text)
        self._kind = ''

    def open(self) -> str:
        """Return what has not been noted yet; empty: nothing."""
        if not self._kind:
            return ''
        number, when = f'message {self._first}', f'at {in_seconds(self._since)}'
        if self._last > self._first:
            number = f'messages {self._first} to {self._last}'
            when = f'from {in_seconds(self._since)} to {in_seconds(self._until)}'
        by = ''
        if self._delays[1] > 0:
            least, most = (in_seconds(delay) for delay in self._delays)
            by = f' by {least}' if least == most else f' by {least} to {most}'
        return f'{number} of {self.name} {self._kind}{by}, {when}'


def totals(hits: Iterable[Hits]) -> str:
    """Return how many of the messages during a fault were affected, by topic and node.

    A node that was started again has new subscriptions with the same names.
    """
    counts: dict[str, Counter[str]] = {}
    for one in hits:
        counts.setdefault(one.name, Counter()).update(one.counts)
    return ', '.join(
        f'{count["hit"]} of {count["during"]} messages of {name}'
        + (f' and {count["behind"]} behind them' if count['behind'] else '')
        for name, count in counts.items()
    )


def _kind(data: bytes, out: list[tuple[int, bytes]]) -> str:
    """Return what was done to a message; empty: nothing."""
    if not out:
        return 'lost'
    changed = ' and changed' if any(other != data for _, other in out) else ''
    late = any(delay > 0 for delay, _ in out)
    if len(out) > 1:
        return f'arrives {len(out)} times{changed}'
    return f'delayed{changed}' if late else changed.removeprefix(' and ')
