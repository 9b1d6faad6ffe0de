"""The progress of a drive, for those who watch. Apart from `_cli`, for rich is slow to import."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


class Drive:
    """The progress of a drive: a bar on a terminal, a line per second elsewhere."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin without a goal; elsewhere the second is one of this clock (s)."""
        self._console = Console()
        self._clock = time.monotonic if self._console.is_terminal else clock
        self._progress = Progress(
            TextColumn('{task.description}'),
            BarColumn(),
            TextColumn('{task.fields[state]}'),
            console=self._console,
            auto_refresh=False,
            transient=True,
        )
        self._task: TaskID | None = None
        self._farthest = 0.0
        self._shown = -math.inf

    def __enter__(self) -> Drive:
        """Show the bar, where there is a terminal."""
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Take the bar away."""
        if self._console.is_terminal:
            self._progress.stop()

    def show(self, what: str, distance: float, wheels: tuple[float, float] | None = None) -> None:
        """Show how far it still is (m) and how fast the wheels turn, `(right, left)` (rad/s)."""
        period = 0.1 if self._console.is_terminal else 1.0
        now = self._clock()
        if now - self._shown < period:
            return
        self._shown = now
        self._farthest = max(self._farthest, distance)
        state = f'{distance:7.3f} m to go'
        if wheels is not None:
            state += f', wheels left {wheels[1]:7.2f}, right {wheels[0]:7.2f} rad/s'
        if not self._console.is_terminal:
            print(f'{what} {state}', flush=True)
            return
        if self._task is None:
            self._task = self._progress.add_task(what, total=1.0, state=state)
        done = 1.0 - distance / self._farthest if self._farthest else 1.0
        self._progress.update(self._task, description=what, completed=done, state=state)
        self._progress.refresh()

    def next(self) -> None:
        """Begin the bar anew, for another waypoint."""
        self._farthest = 0.0


class Playing:
    """How far a bag is played: a bar on a terminal, nothing elsewhere."""

    def __init__(self, seconds: float) -> None:
        """Begin a bag of so many seconds."""
        self._console = Console()
        self._progress = Progress(
            TextColumn('{task.description}'),
            BarColumn(),
            TextColumn('{task.completed:.1f} of {task.total:.1f} s'),
            console=self._console,
            auto_refresh=False,
        )
        self._task = self._progress.add_task('playing', total=seconds)
        self._shown = -math.inf

    def __enter__(self) -> Playing:
        """Show the bar, where there is a terminal."""
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave it as it is."""
        if self._console.is_terminal:
            self._progress.refresh()
            self._progress.stop()

    def show(self, seconds: float, *, paused: bool) -> None:
        """Show how far it came (s)."""
        if self._console.is_terminal and time.monotonic() - self._shown >= 0.1:
            self._shown = time.monotonic()
            what = 'paused (Enter)' if paused else 'playing'
            self._progress.update(self._task, completed=seconds, description=what)
            self._progress.refresh()


class Batch:
    """How many of a batch are done: a bar on a terminal, nothing elsewhere."""

    def __init__(self, what: str, count: int) -> None:
        """Begin a batch of so many."""
        self._console = Console()
        self._progress = Progress(
            TextColumn('{task.description}'),
            BarColumn(),
            TextColumn('{task.completed} of {task.total}'),
            TimeElapsedColumn(),
            console=self._console,
            auto_refresh=False,
            transient=True,
        )
        self._task = self._progress.add_task(what, total=count)
        self._shown = -math.inf

    def __enter__(self) -> Batch:
        """Show the bar, where there is a terminal."""
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Take the bar away."""
        if self._console.is_terminal:
            self._progress.stop()

    def show(self, done: int) -> None:
        """Show how many are done."""
        if self._console.is_terminal and time.monotonic() - self._shown >= 0.1:
            self._shown = time.monotonic()
            self._progress.update(self._task, completed=done)
            self._progress.refresh()
