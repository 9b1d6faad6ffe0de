"""What the bits of a run depend on besides its inputs: versions and features of the processor."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffdrive_jacobian import __version__
from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.exploration.digest import MessageDigest
from diffdrive_jacobian.exploration.result import Finding
from diffdrive_jacobian.exploration.scenario import ExplorationError
from diffdrive_jacobian.exploration.trial import DIED, Setting, Trial, Violation, of_exception, run
from diffdrive_jacobian.exploration.worker import packed, run_world_afresh, run_worlds
from diffdrive_jacobian.lockstep._errors import PropertyViolation
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.plots.fault_marks import ViolationMark
from diffdrive_jacobian.plots.run_figure import draw
from diffdrive_jacobian.recording.recorder import Recorder, Selection
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.text import printable_lines


def versions() -> dict[str, str]:
    """Return the versions and the processor on which the last bit of a run may depend.

    Elsewhere a run may differ by rounding: NumPy and the C library choose their code by the features of
    the processor.
    """
    return {
        'diffdrive_jacobian': __version__,
        'python': platform.python_version(),
        'numpy': np.__version__,
        'rclpy': _rclpy(),
        'libc': ' '.join(platform.libc_ver()),
        'machine': platform.machine(),
        'processor features': _processor(),
    }


def differences(here: dict[str, str], there: dict[str, str]) -> list[str]:
    """Return what differs between two results of `versions`, one line for each."""
    return [
        f'{name} {here.get(name, "unknown")} here, {there.get(name, "unknown")} there'
        for name in dict.fromkeys([*here, *there])
        if here.get(name) != there.get(name)
    ]


def _rclpy() -> str:
    for name in ('ros-rclpy', 'rclpy'):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return 'unknown'


def _processor() -> str:
    """Return a hash of the features of the processor, as Linux lists them."""
    try:
        lines = Path('/proc/cpuinfo').read_text(errors='replace').splitlines()
    except OSError:
        return 'unknown'
    flags = next(
        (line.partition(':')[2] for line in lines if line.startswith(('flags', 'Features'))), ''
    )
    return hashlib.sha256(' '.join(sorted(flags.split())).encode()).hexdigest()[:16]


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
