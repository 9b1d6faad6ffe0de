"""Running a finding again."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.exploration.digest import MessageDigest
from diffdrive_jacobian.exploration.result import Finding
from diffdrive_jacobian.exploration.scenario import ExplorationError
from diffdrive_jacobian.exploration.trial import DIED, Setting, Trial, Violation, of_exception, run
from diffdrive_jacobian.exploration.versions import differences, versions
from diffdrive_jacobian.exploration.worker import packed, run_world_afresh, run_worlds
from diffdrive_jacobian.lockstep._errors import PropertyViolation
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.plots.run_figure import ViolationMark, draw
from diffdrive_jacobian.recording.recorder import Recorder, Selection
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.text import printable_lines

BAG, PICTURE = 'run', 'run.png'
"""Names of the bag and of the picture."""


def record(setting: Setting, trial: Trial, only: int, folder: str) -> list[str]:
    """Run a world, and write its bag and its picture into a folder.

    Returns:
        What could not be written, and why.
    """
    bag = Path(folder) / BAG

    @contextmanager
    def recording(world: Lockstep) -> Iterator[None]:
        writing = Recording(bag, 'mcap', lossless=True)
        recorder = Recorder(Selection(everything=True), writing)
        world.add(recorder, observer=True)
        world.on_new_topics(recorder.discover)
        recorder.discover()
        try:
            yield
        finally:
            ended.append(world.now)
            writing.finish()

    ended: list[int] = []
    try:
        outcome = run(setting, trial, only=only, during=recording)
    except (RecordingError, OSError) as error:
        return [f'no bag: {error}']
    # A violation ends the world.
    violations = [
        ViolationMark(ended[0], f'violated: {one.key}' if one.index >= 0 else one.key)
        for one in outcome.violations[:1]
    ]
    try:
        draw([read_run(bag)], Path(folder) / PICTURE, violations=violations)
    except (BagError, ModuleNotFoundError, OSError) as error:
        return [f'no picture: {error}']
    return []


@dataclass(frozen=True, kw_only=True)
class Replay:
    """The result of running the smallest case of a finding again."""

    violation: Violation | None
    """What it violates now; None: nothing."""
    same_verdict: bool
    """Whether the same property is violated."""
    same_bits: bool
    """Whether all messages are the same, bit for bit, and the violation comes at the same time."""
    differences: tuple[str, ...]
    """How versions and processor differ from those with which it was found."""

    def __str__(self) -> str:
        """Return a description of one line."""
        different = self.differences
        where = f'; {"; ".join(different)}' if different else ', with the same versions and processor'
        if self.same_bits:
            return f'the same as found, bit for bit{where}'
        if self.same_verdict:
            return f'violated as found, but not bit for bit{where}'
        return f'not violated as it was found{where}'


class _Shown(NamedTuple):
    """What a run has shown."""

    key: str
    """Key of its violation."""
    seconds: float
    """World time of the violation (s)."""
    digest: str
    """Hash of all messages up to it."""


def _compared(
    violation: Violation | None, digest: str, found: _Shown, found_with: Mapping[str, str]
) -> Replay:
    """Return how a run compares with what was found with other versions, or with the same ones."""
    now = None if violation is None else _Shown(violation.key, violation.seconds, digest)
    return Replay(
        violation=violation,
        same_verdict=now is not None and now.key == found.key,
        same_bits=now == found,
        differences=tuple(differences(versions(), dict(found_with))),
    )


def replay(finding: Finding | None) -> Replay:
    """Run the smallest case of a finding again, in a process of its own if need be, and compare.

    Raises:
        ExplorationError: There is no finding.
    """
    if finding is None:
        raise ExplorationError('there is nothing to replay: no property was violated')
    violation = finding.violation
    data = packed(finding.setting, [finding.trial], only=violation.index, digest=True)
    # A world that ends its process must not end this one.
    (outcome,) = (run_world_afresh if violation.name == DIED else run_worlds)(data)
    found = _Shown(violation.key, violation.seconds, finding.digest)
    return _compared(outcome.of(violation.key), outcome.digest, found, finding.versions)


@contextmanager
def reproducing(world: Lockstep, case: Path) -> Iterator[None]:
    """Add to an exception that the body raises how it compares with what `explore` found.

    It is the same bit for bit with the same versions and the same features of the processor. Elsewhere
    the verdict is the same, but numbers may be rounded otherwise.

    Args:
        world: The world in which the body runs the case.
        case: The file counterexample.json.
    """
    fields = json.loads(case.read_text(encoding='utf-8'))
    found = _Shown(fields['violation'], fields['seconds'], fields['digest'])
    with MessageDigest(world) as messages:
        try:
            yield
        except (Exception, SystemExit) as error:
            violation = of_exception(error, world)
            if isinstance(error, PropertyViolation):
                key = printable_lines(repr(error.property))
                violation = replace(violation, key=key)
            compared = _compared(violation, messages.value(), found, fields['versions'])
            # As add_note of Python 3.11.
            error.__notes__ = [*getattr(error, '__notes__', []), str(compared)]  # type: ignore[union-attr]
            raise
