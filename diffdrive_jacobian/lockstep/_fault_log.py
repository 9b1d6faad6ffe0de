"""What faults did, for the report, the recording and the tests."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from std_msgs.msg import String

from diffdrive_jacobian.time_units import NANOSECONDS

TOPIC = '/fault_events'
"""Topic of the events."""
MAX_EVENTS = 200
"""Largest number of events of one fault. Afterwards only its end is noted, with the total."""
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
        return f'{self.time_ns / NANOSECONDS:g} s: {self.fault!r} {self.what}'

    def message(self) -> String:
        """Return the event as a message with a JSON object: time, fault, what."""
        fields = {'time': self.time_ns / NANOSECONDS, 'fault': repr(self.fault), 'what': self.what}
        return String(data=json.dumps(fields))


class FaultLog:
    """The events of all faults."""

    def __init__(self, times: Callable[[], tuple[int, int]]) -> None:
        """Start without events.

        Args:
            times: Returns the world time and the time of the clock of the nodes (ns).
        """
        self._times = times
        self.events: list[FaultEvent] = []
        self.publish: Callable[[String], None] | None = None
        """Publishes an event."""

    def add(self, fault: Any, what: str) -> None:
        """Add an event."""
        world, clock = self._times()
        event = FaultEvent(world, fault, what, clock)
        self.events.append(event)
        if self.publish is not None:
            self.publish(event.message())
