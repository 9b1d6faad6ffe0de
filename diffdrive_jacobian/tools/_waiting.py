"""Messages that say what a tool is waiting for."""

from __future__ import annotations

import time

PERIOD = 3.0
"""Time between two messages (s)."""
FIRST = 1.0
"""Time before the first message (s)."""


class Waiting:
    """Prints what the tool is waiting for, after a second and then every few seconds."""

    def __init__(self) -> None:
        """Start the time to the first message."""
        self._due = time.monotonic() + FIRST

    def show(self, what: str) -> None:
        """Print what the tool is waiting for if a message is due."""
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + PERIOD
            print(f'waiting: {what}', flush=True)
