"""Messages about what a tool waits for."""

from __future__ import annotations

import time

PERIOD = 3.0
"""Time between two messages (s)."""
FIRST = 1.0
"""Time before the first message (s)."""


class Waiting:
    """Prints what is waited for, after a second and then every few seconds."""

    def __init__(self) -> None:
        """Start to wait."""
        self._due = time.monotonic() + FIRST

    def show(self, what: str) -> None:
        """Print what is waited for if a message is due."""
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + PERIOD
            print(f'waiting: {what}', flush=True)
