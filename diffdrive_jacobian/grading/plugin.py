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

"""The plugin of pytest: the hand-in as a fixture, and points of tests."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pytest

if TYPE_CHECKING:
    from diffdrive_jacobian.grading.hand_in import HandIn

REPORT = pytest.StashKey['Report']()
BROKEN = pytest.StashKey[Exception]()
"""Why the hand-in cannot be run."""


class SavePicture(Protocol):
    """What the fixture `save_picture` is."""

    def __call__(self, draw: Callable[[], Any]) -> None:
        """Call what draws a figure of matplotlib, and save it where --picture says."""


LATE = 'not graded in time'
"""Why a test gave nothing that did not come to its end."""


@dataclass
class Grade:
    """What one test has given."""

    test: str
    """Its name without `test_`."""
    task: str
    """First line of its docstring."""
    points: float
    """What it gave."""
    of: float
    """What it can give. 0: it was not graded."""
    reason: str
    """Why it gave less, or was not graded. Empty: it gave all."""


class Report:
    """The grades of one hand-in."""

    def __init__(self) -> None:
        """Start without grades."""
        self.grades: list[Grade] = []

    @property
    def points(self) -> tuple[float, float]:
        """What was given, and what could be."""
        return sum(one.points for one in self.grades), sum(one.of for one in self.grades)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup('grading', 'diffdrive_jacobian.grading')
    group.addoption('--hand-in', type=Path, metavar='FILE', help='hand-in that the exercise grades')
    group.addoption('--grades', metavar='WORD', help='print points as JSON in lines that begin so')
    group.addoption('--picture', type=Path, metavar='FILE', help='where to save a picture of the drive')


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    text = 'points(number): what a test of an exercise gives if it passes (default: 1)'
    config.addinivalue_line('markers', text)
    config.stash[REPORT] = Report()


@pytest.fixture
def hand_in(request: pytest.FixtureRequest) -> Iterator[HandIn]:
    """The hand-in of the option --hand-in, in a process of its own for each test."""
    from diffdrive_jacobian.grading.hand_in import HandIn, HandInError

    path = request.config.getoption('--hand-in')
    if path is None:
        pytest.fail('an exercise grades a hand-in: give it by --hand-in FILE', pytrace=False)
    broken = request.config.stash.get(BROKEN, None)
    if broken is not None:
        raise broken
    try:
        found = HandIn(path)
    except HandInError as error:
        # Not again for each test: it may have taken long.
        request.config.stash[BROKEN] = error
        raise
    yield found
    found.close()


@pytest.fixture
def save_picture(request: pytest.FixtureRequest) -> SavePicture:
    """A function that draws a figure and saves it as --picture says; without that it does nothing."""

    def save(draw: Callable[[], Any]) -> None:
        file = request.config.getoption('--picture')
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            draw().savefig(file)

    return save


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Note what a test gave."""
    outcome = yield
    report = outcome.get_result()  # type: ignore[attr-defined]
    if 'hand_in' not in getattr(item, 'fixturenames', ()):
        return
    if report.when != 'call' and report.passed:
        return
    of = _points(item)
    reason = ''
    if report.skipped:
        of, reason = 0.0, f'not graded: {call.excinfo.value if call.excinfo else "skipped"}'
    elif call.excinfo is not None:
        error = call.excinfo.value
        text = str(error).strip().partition('\n')[0]
        own = isinstance(error, (AssertionError, pytest.fail.Exception))
        reason = text if own else f'{type(error).__name__}: {text}'
    given = of if report.passed else 0.0
    grade = Grade(*_named(item), given, of, reason)
    item.config.stash[REPORT].grades.append(grade)
    _print_grade(item.config, asdict(grade))


def _points(item: pytest.Item) -> float:
    marker = item.get_closest_marker('points')
    return float(marker.args[0]) if marker is not None and marker.args else 1.0


def _named(item: pytest.Item) -> tuple[str, str]:
    """Return the name and the task of a test."""
    doc = getattr(getattr(item, 'function', None), '__doc__', None) or item.name
    return item.name.removeprefix('test_'), doc.strip().partition('\n')[0].rstrip('.')


def _print_grade(config: pytest.Config, grade: dict[str, Any]) -> None:
    """Print a grade for `grade_hand_ins`, on the standard output: a hand-in cannot write to that."""
    word = config.getoption('--grades')
    if word is not None:
        config.get_terminal_writer().line(f'\n{word}{json.dumps(grade)}')


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Print what can be given, before a hand-in takes too long."""
    for item in items:
        if 'hand_in' in getattr(item, 'fixturenames', ()):
            name, task = _named(item)
            _print_grade(config, asdict(Grade(name, task, 0.0, _points(item), LATE)))


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the points of the hand-in, in a student's words."""
    report = config.stash[REPORT]
    if not report.grades:
        return
    points, of = report.points
    terminalreporter.section(f'{config.getoption("--hand-in")}: {points:g} of {of:g} points')
    for one in report.grades:
        reason = f': {one.reason}' if one.reason else ''
        terminalreporter.line(f'{one.points:g}/{one.of:g}  {one.task}{reason}')
