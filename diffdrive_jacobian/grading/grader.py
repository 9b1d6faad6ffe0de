"""Grading of many hand-ins, each by pytest in a process of its own."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diffdrive_jacobian.errors import NotDoneError, UserError
from diffdrive_jacobian.text import printable

SECONDS = 120.0
"""Longest duration of the grading of one hand-in (s)."""
FOLDER = Path(__file__).parents[1] / 'exercises'
"""The exercises of this package."""


class GradingError(NotDoneError):
    """An exercise cannot grade anything."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Graded:
    """The grade of one hand-in."""

    hand_in: Path
    grades: tuple[dict[str, Any], ...]
    """The `plugin.Grade` of each test, by its fields."""
    seconds: float
    """How long it took (s)."""
    error: str = ''
    """Why it was not graded to its end. Empty: it was."""

    @property
    def points(self) -> float:
        """What it was given."""
        return sum(float(one['points']) for one in self.grades)

    @property
    def of(self) -> float:
        """What it could be given."""
        return sum(float(one['of']) for one in self.grades)

    @property
    def reasons(self) -> list[str]:
        """Why it was given less, each with its tasks, unless it is the reason of all."""
        tasks: dict[str, list[str]] = {}
        for one in self.grades:
            if one['reason']:
                tasks.setdefault(one['reason'], []).append(one['task'])
        found = [
            reason if len(of) == len(self.grades) > 1 else f'{"; ".join(of)}: {reason}'
            for reason, of in tasks.items()
        ]
        return [*found, *[self.error] * bool(self.error)]


def exercises() -> list[str]:
    """Return the names of the exercises of this package."""
    return sorted(one.stem for one in FOLDER.glob('*.py') if not one.name.startswith('_'))


def find_exercise(text: str) -> Path:
    """Return the file of an exercise, of this package by its name.

    Raises:
        UserError: There is none.
    """
    path = Path(text)
    if path.suffix == '.py' or len(path.parts) > 1:
        if not path.is_file():
            raise UserError(f'there is no exercise {printable(text)}')
        return path.resolve()
    if text not in exercises():
        raise UserError(
            f'EXERCISE must be a file, or one of {", ".join(exercises())}, got {printable(text)}'
        )
    return FOLDER / f'{text}.py'


def grade(
    exercise: Path,
    hand_ins: Sequence[Path],
    *,
    seconds: float = SECONDS,
    pictures: Path | None = None,
    jobs: int | None = None,
    graded: Callable[[Graded], object] = lambda _: None,
    stopped: Callable[[], bool] = lambda: False,
) -> list[Graded]:
    """Grade hand-ins, several at a time.

    Args:
        exercise: File with the tests.
        hand_ins: Files of the students.
        seconds: Longest duration of each (s).
        pictures: Folder for pictures. None: none are drawn.
        jobs: How many at a time. None: as many as there are cores.
        graded: Receives each grade when it is known.
        stopped: Tells whether to stop; what has not begun is left out.

    Raises:
        GradingError: The exercise fails, whatever the hand-in.
    """
    failed = False

    def one(hand_in: Path) -> Graded | None:
        nonlocal failed
        if failed or stopped():
            return None
        try:
            found = _grade(exercise, hand_in, seconds, pictures)
        except GradingError:
            # An interruption ends pytest, too.
            if stopped():
                return None
            failed = True
            raise
        graded(found)
        return found

    with ThreadPoolExecutor(jobs or os.cpu_count() or 1) as pool:
        return [found for found in pool.map(one, hand_ins) if found is not None]


def _grade(exercise: Path, hand_in: Path, seconds: float, pictures: Path | None) -> Graded:
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, 'grades.json')
        command = [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', '--rootdir', folder]
        command += [*('-c', os.devnull, '--hand-in', str(hand_in.resolve()), '--grades', str(report))]
        if pictures is not None:
            command += ['--pictures', str(pictures.resolve())]
        error = ''
        try:
            ended = subprocess.run(
                [*command, str(exercise)],
                cwd=folder,
                capture_output=True,
                text=True,
                errors='replace',
                stdin=subprocess.DEVNULL,
                timeout=seconds,
                check=False,
            )
        except subprocess.TimeoutExpired:
            ended, error = None, f'not graded: it took longer than {seconds:g} s'
        grades = json.loads(report.read_text(encoding='utf-8')) if report.exists() else []
        if ended is not None and (ended.returncode not in (0, 1) or not grades):
            lines = (ended.stdout + ended.stderr).strip().splitlines() or ['it printed nothing']
            why = [line for line in lines if line.startswith('E ')] or lines[-1:]
            raise GradingError(f'{exercise} grades nothing: {why[-1].removeprefix("E").strip()}')
    return Graded(hand_in=hand_in, grades=tuple(grades), seconds=time.monotonic() - begin, error=error)


def table(found: Iterable[Graded]) -> str:
    """Return the grades as CSV: a row for each hand-in, a column for each test."""
    rows = list(found)
    tests = list(dict.fromkeys(one['test'] for row in rows for one in row.grades))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(['hand_in', 'points', 'of', 'seconds', *tests, 'reasons'])
    for row in rows:
        given = {one['test']: f'{one["points"]:g}' for one in row.grades}
        first = _harmless(str(row.hand_in)), f'{row.points:g}', f'{row.of:g}', f'{row.seconds:.1f}'
        points = (given.get(test, '') for test in tests)
        writer.writerow([*first, *points, _harmless('; '.join(row.reasons))])
    return text.getvalue()


def _harmless(text: str) -> str:
    """Return a text that no spreadsheet takes for a formula. Students choose names and messages."""
    return f"'{text}" if text.startswith(('=', '+', '-', '@', '\t', '\r')) else text
