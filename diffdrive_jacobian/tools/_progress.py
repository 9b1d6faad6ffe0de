"""Progress bars on a terminal. Not in `_cli`, because rich is slow to import."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


class Drive:
    """The progress of a drive: a bar on a terminal, a line per second elsewhere."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Start without a goal.

        Args:
            clock: Returns the time by which the lines are printed (s).
        """
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
        """Return the progress. The bar appears with the first call of `show`."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        if self._console.is_terminal:
            self._progress.stop()

    def show(self, what: str, distance: float, wheels: tuple[float, float] | None = None) -> None:
        """Show the distance to the goal and the speeds of the wheels.

        Args:
            what: The goal.
            distance: Distance to it (m).
            wheels: Speeds of the right and the left wheel (rad/s). None: they are not shown.
        """
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
            self._progress.start()
            self._task = self._progress.add_task(what, total=1.0, state=state)
        done = 1.0 - distance / self._farthest if self._farthest else 1.0
        self._progress.update(self._task, description=what, completed=done, state=state)
        self._progress.refresh()

    def next(self) -> None:
        """Restart the bar for another goal."""
        self._farthest = 0.0


class Playing:
    """The progress of a replay: a bar on a terminal, nothing elsewhere."""

    def __init__(self, seconds: float) -> None:
        """Start a bar for a length (s)."""
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
        """Show the bar on a terminal."""
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the bar and leave it visible."""
        if self._console.is_terminal:
            self._progress.refresh()
            self._progress.stop()

    def show(self, seconds: float, *, paused: bool) -> None:
        """Show the position (s)."""
        if self._console.is_terminal and time.monotonic() - self._shown >= 0.1:
            self._shown = time.monotonic()
            what = 'paused (Enter)' if paused else 'playing'
            self._progress.update(self._task, completed=seconds, description=what)
            self._progress.refresh()


class Batch:
    """The progress of a batch: a bar on a terminal, nothing elsewhere."""

    def __init__(self, what: str, count: int) -> None:
        """Start a bar.

        Args:
            what: What is done.
            count: Number of items.
        """
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
        """Show the bar on a terminal."""
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        if self._console.is_terminal:
            self._progress.stop()

    def show(self, done: int) -> None:
        """Show the number of items that are done."""
        if self._console.is_terminal and time.monotonic() - self._shown >= 0.1:
            self._shown = time.monotonic()
            self._progress.update(self._task, completed=done)
            self._progress.refresh()
