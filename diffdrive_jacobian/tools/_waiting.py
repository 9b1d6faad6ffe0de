"""Messages that say what a tool is waiting for."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PERIOD = 3.0
"""Time between two messages (s)."""
FIRST = 0.5
"""Time of waiting before the first message (s)."""
PAUSE = 0.5
"""Time between two calls of `show` after which another wait starts (s)."""


class Waiting:
    """Prints what the tool is waiting for, after half a second and then every few seconds."""

    def __init__(self) -> None:
        """Create it before the wait, which starts with the first call of `show`."""
        self._due = 0.0
        self._last = -PAUSE

    def show(self, what: str) -> None:
        """Print what the tool is waiting for if a message is due."""
        now = time.monotonic()
        new, self._last = now - self._last >= PAUSE, now
        if new:
            self._due = now + FIRST
        elif now >= self._due:
            self._due = now + PERIOD
            print(f'waiting: {what}', flush=True)


@contextmanager
def busy(program: str, what: str) -> Iterator[None]:
    """Print on a terminal what the program does, if that takes longer than FIRST.

    Args:
        program: Name of the program.
        what: What it does.
    """
    if not sys.stderr.isatty():
        yield
        return
    timer = threading.Timer(
        FIRST, print, [f'{program}: {what} ...'], {'file': sys.stderr, 'flush': True}
    )
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
