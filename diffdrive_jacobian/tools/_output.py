# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What several tools print: errors, waits, progress, and descriptions of bags."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from diffdrive_jacobian.errors import DiffdriveError, InterruptionError, NotDoneError, UserError
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools.entry_points import FAILED, INTERRUPTED, USER_ERROR

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.progress import TaskID

    from diffdrive_jacobian.bags.bag_writer import Summary

Main: TypeAlias = Callable[[Sequence[str], Signals], int]
"""What a tool does with its arguments; returns the exit code."""
NO_MATPLOTLIB = "matplotlib is not installed: pip install 'diffdrive_jacobian[plot]'"
PERIOD = 3.0
"""Time between two messages about a wait (s)."""
FIRST = 0.5
"""Time of waiting before the first message (s)."""
PAUSE = 0.5
"""Time between two calls of `Waiting.show` after which another wait starts (s)."""


def complain(program: str, message: object, code: int = USER_ERROR) -> int:
    """Print an error as argparse does, and return the exit code."""
    note(program, f'error: {message}')
    return code


def note(program: str, message: object) -> None:
    """Print a line to the standard error."""
    print(f'{program}: {printable(message, PATH_LIMIT)}', file=sys.stderr)


def tool(program: str) -> Callable[[Main], Main]:
    """Return a decorator of the `main` of a tool: what it raises becomes a message and an exit code."""

    def decorate(main: Main) -> Main:
        @wraps(main)
        def run(arguments: Sequence[str], signals: Signals) -> int:
            try:
                return main(arguments, signals)
            except InterruptionError as error:
                note(program, f'interrupted{f": {error}" if str(error) else ""}')
                return INTERRUPTED
            except NotDoneError as error:
                return complain(program, error, FAILED)
            except DiffdriveError as error:
                return complain(program, error)

        return run

    return decorate


def say(path: Path) -> None:
    """Print the path of a file that was written."""
    print(printable(path, PATH_LIMIT))


def check(signals: Signals, result: str = '') -> None:
    """Raise InterruptionError if a signal was caught, with what became of the files."""
    if signals.count:
        raise InterruptionError(result)


def drawn(
    program: str, signals: Signals, ending: str, make: Callable[[], Figure], hint: str = ''
) -> bytes:
    """Return the content of a file with a figure. A signal ends the process meanwhile.

    Raises:
        UserError: matplotlib is not installed; the hint is at the end of the message.
    """
    from diffdrive_jacobian.plots.rendering import render

    with explaining_no_matplotlib(hint), busy(program, 'drawing'), signals.ending_at_once():
        return render(make(), ending)


def write(path: Path, content: bytes, *, replace: bool) -> None:
    """Write a new file.

    Raises:
        NotDoneError: It cannot be written.
    """
    # Not above: nodes need none of it.
    from diffdrive_jacobian.plots.output_files import cannot_write, create

    try:
        create(path, content, replace=replace)
    except OSError as error:
        raise cannot_write(path, error) from error


@contextmanager
def explaining_no_matplotlib(hint: str = '') -> Iterator[None]:
    """Raise UserError, with a hint at its end, where matplotlib is imported and not installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or '').split('.')[0] != 'matplotlib':
            raise
        raise UserError(f'{NO_MATPLOTLIB}{hint}') from error


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 topic`, `2 topics`."""
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def where_on_path(distance: float, across: float, late: float, *, arrived: bool) -> str:
    """Return where a robot is on its path in words: before its end, or from it if it has arrived.

    Args:
        distance: What remains, or the distance from the end (m).
        across: Greatest distance from the path (m). NaN: not known.
        late: How much later than by its times it arrived (s). NaN: there are none.
        arrived: Whether it did.
    """
    text = f'{distance:.3f} m {"from" if arrived else "before"} the end of the path'
    if not math.isnan(across):
        off = f'{1e3 * across:.2f} mm' if across < 0.1 else f'{across:.3f} m'
        text += f', at most {off} from it'
    return text if math.isnan(late) else f'{text}, {late:.1f} s later than by its times'


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
    """Print on a terminal what the program does, if that takes longer than FIRST."""
    if not sys.stderr.isatty():
        yield
        return
    line = f'{program}: {printable(what, PATH_LIMIT)} ...'
    timer = threading.Timer(FIRST, print, [line], {'file': sys.stderr, 'flush': True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


class Bar:
    """A progress bar on a terminal. Elsewhere a line per second, or nothing."""

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
        # Slow to import.
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        console = Console()
        self._terminal = console.is_terminal
        self._shows, self._stays = self._terminal or lines, stays
        self._clock, self._period = (time.monotonic, 0.1) if self._terminal else (clock, 1.0)
        self._progress = Progress(
            TextColumn('{task.description}'),
            BarColumn(),
            TextColumn('{task.fields[state]}'),
            console=console,
            auto_refresh=False,
            transient=not stays,
        )
        self._task: TaskID | None = None
        self._shown = -math.inf

    def show(self, what: str, share: float, state: str) -> None:
        """Show the progress if it is due: what is done, the share (0 to 1), and the same in words."""
        now = self._clock()
        if not self._shows or now - self._shown < self._period:
            return
        self._shown = now
        if not self._terminal:
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


class GoalBar(Bar):
    """The progress of a drive to a goal, as the share of the largest distance that was covered."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Start without a goal. `clock` as for `Bar`."""
        super().__init__(lines=True, clock=clock)
        self._goal, self._farthest = '', 0.0

    def show_goal(self, goal: str, distance: float, wheels: tuple[float, float] | None = None) -> None:
        """Show the distance to a goal (m) and the speeds of the right and the left wheel (rad/s)."""
        if goal != self._goal:
            self._goal, self._farthest = goal, 0.0
        self._farthest = max(self._farthest, distance)
        state = f'{distance:7.3f} m to go'
        if wheels is not None:
            state += f', wheels left {wheels[1]:7.2f}, right {wheels[0]:7.2f} rad/s'
        self.show(goal, 1.0 - distance / self._farthest if self._farthest else 1.0, state)
