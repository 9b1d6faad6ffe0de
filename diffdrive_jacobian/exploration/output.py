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

"""What is written about a finding: the case, a test that reproduces it, a bag and a picture."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from diffdrive_jacobian.exploration.extensions import draw
from diffdrive_jacobian.exploration.own_files import (
    BAG,
    CASE,
    MARK,
    MARK_TITLE,
    PICTURE,
    files_below,
    is_free,
    mark,
    path_of_test,
    remove,
)
from diffdrive_jacobian.exploration.processes import ChildDiedError, call_in_child, can_run_here
from diffdrive_jacobian.exploration.recorded_world import record_world
from diffdrive_jacobian.exploration.result import Finding
from diffdrive_jacobian.exploration.scenario import ExplorationError
from diffdrive_jacobian.exploration.trial import Setting, Trial, run
from diffdrive_jacobian.exploration.written_test import case_source, test_source
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.text import error_text
from diffdrive_jacobian.time_units import nanoseconds


def check_output(folder: Path) -> None:
    """Create the folder of the findings.

    Raises:
        ExplorationError: It cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExplorationError(f'output {folder} cannot be created: {error.strerror}') from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ExplorationError(f'output {folder} cannot be written to')


def write_finding(
    finding: Finding,
    output: Path,
    others: Sequence[Finding],
    *,
    seed: int,
    executor: Executor | None = None,
) -> Finding:
    """Write a finding into a folder of its own, in the place of one of an earlier exploration.

    Nothing else is overwritten: where it is in the way, the folder gets a number. What cannot be written
    is noted in the finding that is returned. `others` have a folder already. The executor runs the case
    again, to write the bag and the picture. Without one these are not written.
    """
    taken = {other.directory for other in others}
    stem = re.sub(r'\W+', '_', finding.violation.name)
    folders = (output / (stem if number == 1 else f'{stem}_{number}') for number in count(1))
    folder = next(one for one in folders if one not in taken and is_free(one))
    notes = list(finding.notes)
    try:
        remove(folder)
        folder.mkdir(exist_ok=True)
        case, test = folder / CASE, path_of_test(folder)
        for path, text in (
            (folder / MARK, MARK_TITLE.format(folder=folder.name) + '\n'),
            (case, case_source(finding, seed)),
            (test, test_source(finding, folder, test.stem.removeprefix('test_'), seed)),
        ):
            with path.open('x', encoding='utf-8') as file:
                file.write(text)
        mark(folder, [case, test])
        if executor is not None:
            notes += _record(finding, folder, executor)
    except OSError as error:
        notes.append(f'not written: {error}')
    return replace(finding, directory=folder, notes=tuple(notes))


def remove_others(output: Path, findings: Sequence[Finding]) -> None:
    """Remove what an earlier exploration has written, other than what was found again.

    A folder that was renamed or copied stays, and so does one in which a file was changed or renamed.
    Files that were added stay, too.
    """
    kept = {finding.directory.name for finding in findings if finding.directory is not None}
    for listed in output.glob(f'*/{MARK}'):
        if listed.parent.name not in kept:
            with suppress(OSError):
                remove(listed.parent)


def _record(finding: Finding, folder: Path, executor: Executor) -> list[str]:
    """Record the smallest case. Return notes on what could not be written."""
    # Apart until it is complete: after Ctrl-C the process of the recording goes on for a moment.
    with TemporaryDirectory(prefix='.recording_', dir=folder, ignore_cleanup_errors=True) as apart:
        arguments = finding.setting, finding.trial, finding.violation.index, apart
        try:
            notes = executor.submit(_record_in_process, *arguments).result()
        except ChildDiedError as error:
            notes = [f'not recorded: {error}']
        except Exception as error:
            # The finding must not be lost.
            notes = [f'not recorded: {type(error).__name__}: {error_text(error)}']
        for path in Path(apart).iterdir():
            new = path.rename(folder / path.name)
            mark(folder, files_below(new) if new.is_dir() else [new])
    return notes


def _record_in_process(*arguments: Any) -> list[str]:
    return list(record(*arguments) if can_run_here() else call_in_child(record, *arguments))


def record(setting: Setting, trial: Trial, only: int, folder: str) -> list[str]:
    """Run a world, write its bag and its picture into a folder, and return what could not be written."""
    bag = Path(folder) / BAG
    begin = 0

    @contextmanager
    def recording(world: Lockstep) -> Iterator[None]:
        nonlocal begin
        writing = Recording(bag, lossless=True)
        begin = record_world(world, writing)()
        try:
            yield
        finally:
            writing.finish()

    try:
        outcome = run(setting, trial, only=only, during=recording)
    except (RecordingError, OSError) as error:
        return [f'no bag: {error}']
    marks = [
        (begin + nanoseconds(one.seconds), f'violated: {one.key}' if one.index >= 0 else one.key)
        for one in outcome.violations[:1]
    ]
    why = draw(bag, Path(folder) / PICTURE, marks)
    return [f'no picture: {why}'] if why else []
