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

"""Grading of many hand-ins, each by pytest in a process of its own."""

from __future__ import annotations

import csv
import io
import json
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diffdrive_jacobian.errors import NotDoneError, UserError
from diffdrive_jacobian.text import printable

SECONDS = 120.0
"""Longest duration of the grading of one hand-in (s)."""
POLL = 0.1
"""Time between two looks at whether to stop (s)."""
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
    _check(exercise)
    names = _pictures(hand_ins, pictures)

    def one(number: int) -> Graded | None:
        if stopped():
            return None
        return _grade(exercise, hand_ins[number], seconds, names[number], stopped)

    found = []
    with ThreadPoolExecutor(jobs or os.cpu_count() or 1) as pool:
        for result in pool.map(one, range(len(hand_ins))):
            if result is not None:
                graded(result)
                found.append(result)
    return found


def _pictures(hand_ins: Sequence[Path], folder: Path | None) -> list[Path | None]:
    """Return the file of each picture. Hand-ins of the same name have that of their folder before it."""
    stems = [one.stem for one in hand_ins]
    names = [
        stem if stems.count(stem) == 1 else f'{number}_{one.resolve().parent.name}_{stem}'
        for number, (one, stem) in enumerate(zip(hand_ins, stems, strict=True), 1)
    ]
    return [None if folder is None else folder.resolve() / f'{name}.png' for name in names]


def _pytest(*arguments: str) -> list[str]:
    return [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', '-c', os.devnull, *arguments]


def _check(exercise: Path) -> None:
    """Raise GradingError if an exercise has no tests, whatever the hand-in."""
    with tempfile.TemporaryDirectory() as folder:
        command = _pytest('--rootdir', folder, '--collect-only', str(exercise))
        ended = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, errors='replace', check=False
        )
    if ended.returncode:
        lines = (ended.stdout + ended.stderr).strip().splitlines() or ['it printed nothing']
        why = [line for line in lines if line.startswith('E ')] or lines[-1:]
        raise GradingError(f'{exercise} grades nothing: {why[-1].removeprefix("E").strip()}')


def _grade(
    exercise: Path, hand_in: Path, seconds: float, picture: Path | None, stopped: Callable[[], bool]
) -> Graded | None:
    begin, word = time.monotonic(), f'{secrets.token_hex(16)} '
    with tempfile.TemporaryDirectory() as folder:
        command = _pytest('--rootdir', folder, '--hand-in', str(hand_in.resolve()), '--grades', word)
        if picture is not None:
            command += ['--picture', str(picture)]
        process = subprocess.Popen(
            [*command, str(exercise)],
            cwd=folder,
            # What is ended at once leaves its folders here. Who grades may own nothing else.
            env={**os.environ, 'TMPDIR': folder, 'ROS_LOG_DIR': folder},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors='replace',
            # What it leaves behind is in its group.
            start_new_session=True,
        )
        output, late = '', False
        while True:
            try:
                output = process.communicate(timeout=POLL)[0]
                break
            except subprocess.TimeoutExpired:
                late = time.monotonic() - begin > seconds
                if late or stopped():
                    _end_group(process)
        _end_group(process)
    if stopped() and not late and process.returncode not in (0, 1):
        return None
    grades: dict[str, dict[str, Any]] = {}
    for line in output.splitlines():
        if line.startswith(word):
            one = json.loads(line.removeprefix(word))
            grades[one['test']] = one
    error = ''
    if late:
        error = f'not graded to the end: it took longer than {seconds:g} s'
    elif process.returncode not in (0, 1) or not grades:
        error = f'not graded to the end: pytest ended with {process.returncode}'
    took = time.monotonic() - begin
    return Graded(hand_in=hand_in, grades=tuple(grades.values()), seconds=took, error=error)


def _end_group(process: subprocess.Popen[str]) -> None:
    """End a process and those that it has started."""
    if os.name == 'posix':
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()


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
