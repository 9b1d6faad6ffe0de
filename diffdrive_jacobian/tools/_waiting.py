"""Messages that say what a tool is waiting for."""

from __future__ import annotations

import time

PERIOD = 3.0
"""Time between two messages (s)."""
FIRST = 1.0
"""Time of waiting before the first message (s)."""


class Waiting:
    """Prints what the tool is waiting for, after a second and then every few seconds."""

    def __init__(self) -> None:
        """Create it before the wait, which starts with the first call of `show`."""
        self._due: float | None = None

    def show(self, what: str) -> None:
        """Print what the tool is waiting for if a message is due."""
        now = time.monotonic()
        if self._due is None:
            self._due = now + FIRST
        elif now >= self._due:
            self._due = now + PERIOD
            print(f'waiting: {what}', flush=True)
