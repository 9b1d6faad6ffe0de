"""What several tools print."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.text import PATH_LIMIT, printable

if TYPE_CHECKING:
    from diffdrive_jacobian.bags.bag_writer import Summary

NO_MATPLOTLIB = "matplotlib is not installed: pip install 'diffdrive_jacobian[plot]'"
PERIOD = 3.0
"""Time between two messages (s)."""
FIRST = 0.5
"""Time of waiting before the first message (s)."""
PAUSE = 0.5
"""Time between two calls of `show` after which another wait starts (s)."""


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 topic`, `2 topics`."""
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def describe_distances(distance: float, true_distance: float) -> str:
    """Return how far a robot is from its goal (m), in words. A true distance of NaN is not known."""
    if math.isnan(true_distance):
        return f'{distance:.3f} m from the goal'
    return f'{distance:.3f} m from the goal by odometry, {true_distance:.3f} m by ground truth'


def describe_bag(bag: Path, summary: Summary, state: str = 'complete') -> str:
    """Return one line about the content of a bag."""
    what = f'{printable(bag, PATH_LIMIT)} is {state}'
    if summary.start is None or summary.end is None:
        return f'{what} and empty: no message was received'
    counts = sorted(summary.topics.items())
    topics = ', '.join(f'{printable(topic)} {count}' for topic, count in counts if count)
    seconds = (summary.end - summary.start) / 1e9
    lost = f'; {sum(summary.lost.values())} lost' if summary.lost else ''
    return f'{what}: {counted(summary.messages, "message")} in {seconds:.1f} s ({topics}){lost}'


@contextmanager
def explaining_no_matplotlib(hint: str = '') -> Iterator[None]:
    """Raise UserError where matplotlib is imported and not installed.

    Args:
        hint: End of the message.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or '').split('.')[0] != 'matplotlib':
            raise
        raise UserError(f'{NO_MATPLOTLIB}{hint}') from error


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
