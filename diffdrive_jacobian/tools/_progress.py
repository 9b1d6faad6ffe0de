"""Progress bars on a terminal. Not in `_messages`, because rich is slow to import."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn


class Bar:
    """A bar on a terminal; elsewhere a line per second, or nothing."""

    def __init__(
        self,
        *,
        stays: bool = False,
        lines: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create the bar, which appears with the first call of `show`.

        Args:
            stays: Whether the bar stays visible at the end.
            lines: Whether lines are printed if this is no terminal.
            clock: Returns the time by which the lines are printed (s).
        """
        self._console = Console()
        terminal = self._console.is_terminal
        self._shows, self._stays = terminal or lines, stays
        self._clock, self._period = (time.monotonic, 0.1) if terminal else (clock, 1.0)
        self._progress = Progress(
            TextColumn('{task.description}'),
            BarColumn(),
            TextColumn('{task.fields[state]}'),
            console=self._console,
            auto_refresh=False,
            transient=not stays,
        )
        self._task: TaskID | None = None
        self._shown = -math.inf

    def __enter__(self) -> Bar:
        """Return the bar."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar, or leave it visible if it stays."""
        self.close()

    def show(self, what: str, share: float, state: str) -> None:
        """Show the progress if it is due.

        Args:
            what: What is done.
            share: How much of it is done, from 0 to 1.
            state: The same in words.
        """
        now = self._clock()
        if not self._shows or now - self._shown < self._period:
            return
        self._shown = now
        if not self._console.is_terminal:
            print(f'{what} {state}', flush=True)
            return
        if self._task is None:
            self._progress.start()
            self._task = self._progress.add_task(what, total=1.0, state=state)
        self._progress.update(self._task, description=what, completed=share, state=state)
        self._progress.refresh()

    def close(self) -> None:
        """End the display."""
        if self._task is not None:
            if self._stays:
                self._progress.refresh()
            self._progress.stop()


class GoalBar:
    """The progress of a drive to a goal, as the share of the largest distance that was covered."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Start without a goal.

        Args:
            clock: Returns the time by which the lines are printed where there is no terminal (s).
        """
        self._bar = Bar(lines=True, clock=clock)
        self._what = ''
        self._farthest = 0.0

    def __enter__(self) -> GoalBar:
        """Return the bar."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar."""
        self._bar.close()

    def show(self, what: str, distance: float, wheels: tuple[float, float] | None = None) -> None:
        """Show the distance to the goal and the speeds of the wheels.

        Args:
            what: The goal. With another one the bar is restarted.
            distance: Distance to it (m).
            wheels: Speeds of the right and the left wheel (rad/s). None: they are not shown.
        """
        if what != self._what:
            self._what, self._farthest = what, 0.0
        self._farthest = max(self._farthest, distance)
        state = f'{distance:7.3f} m to go'
        if wheels is not None:
            state += f', wheels left {wheels[1]:7.2f}, right {wheels[0]:7.2f} rad/s'
        self._bar.show(what, 1.0 - distance / self._farthest if self._farthest else 1.0, state)
