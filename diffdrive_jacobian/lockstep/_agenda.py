"""Actions at future times: messages that arrive late, and faults that begin and end."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from itertools import count


class Agenda:
    """Actions, ordered by their time, and by the order in which they were added.

    Their time is world time: it starts at 0, and always advances, whatever the clocks of the nodes show.
    """

    def __init__(self) -> None:
        """Start without actions."""
        self.now = 0
        """World time (ns)."""
        self._entries: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = count()

    def __bool__(self) -> bool:
        """Return whether there are actions."""
        return bool(self._entries)

    def at(self, time: int, action: Callable[[], None]) -> None:
        """Add an action at a time (ns). One in the past is due now."""
        heapq.heappush(self._entries, (max(time, self.now), next(self._numbers), action))

    def until_next(self) -> int | None:
        """Return the time until the next action (ns); None: there is none."""
        return self._entries[0][0] - self.now if self._entries else None

    def pop_due(self) -> Callable[[], None] | None:
        """Return the next action that is due, and forget it; None: there is none."""
        if self._entries and self._entries[0][0] <= self.now:
            return heapq.heappop(self._entries)[2]
        return None
