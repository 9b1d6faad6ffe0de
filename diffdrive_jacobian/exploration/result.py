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

"""The result of an exploration, and running a finding again."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from diffdrive_jacobian import __version__
from diffdrive_jacobian.exploration.processes import packed, run_worlds
from diffdrive_jacobian.exploration.scenario import ExplorationError, Source
from diffdrive_jacobian.exploration.trial import (
    DIED,
    MessageDigest,
    Setting,
    Trial,
    Violation,
    of_exception,
)
from diffdrive_jacobian.exploration.unseen import Unseen
from diffdrive_jacobian.lockstep._pause import ends_all
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.text import printable

LONGEST_KEY = 200
"""Length beyond which a property is cut where it is a title (characters)."""
NOTED = 10
"""Number of notes that are printed."""


def versions() -> dict[str, str]:
    """Return the versions and the processor on which the last bit of a run may depend.

    Elsewhere a run may differ by rounding: NumPy and the C library choose their code by the features of
    the processor.
    """
    rclpy = 'unknown'
    for name in ('rclpy', 'ros-rclpy'):
        with suppress(PackageNotFoundError):
            rclpy = version(name)
    return {
        'diffdrive_jacobian': __version__,
        'python': platform.python_version(),
        'numpy': np.__version__,
        'rclpy': rclpy,
        'libc': ' '.join(platform.libc_ver()),
        'machine': platform.machine(),
        'processor features': _processor(),
    }


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


def differences(here: dict[str, str], there: dict[str, str]) -> list[str]:
    """Return what differs between two results of `versions`, one line for each."""
    return [
        f'{name} {here.get(name, "unknown")} here, {there.get(name, "unknown")} there'
        for name in dict.fromkeys([*here, *there])
        if here.get(name) != there.get(name)
    ]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A violated property, or an exception, and the smallest case that shows it."""

    violation: Violation
    """What the smallest case violates, and when."""
    trial: Trial
    """The smallest case, with its faults."""
    setting: Setting
    """The scenario, the properties and the relations."""
    count: int
    """Number of worlds that violated it."""
    first_world: int
    """Number of the first one, from 0."""
    first_trial: Trial
    """Its case, before it was shrunk."""
    shrink_worlds: int = 0
    """Number of worlds that were run to shrink it."""
    complete: bool = True
    """Whether shrinking was finished, not stopped by a limit."""
    deterministic: bool = True
    """Whether a second run of the smallest case gave the same messages and the same violation."""
    digest: str = ''
    """Hash of all messages of the smallest case up to the violation."""
    versions: dict[str, str] = field(default_factory=versions)
    """The versions and the processor with which it was found."""
    directory: Path | None = None
    """Folder with the test, the bag and the picture, if they were written."""
    notes: tuple[str, ...] = ()
    """What could not be written, and why."""

    def __str__(self) -> str:
        """Return a description of a few lines."""
        source = Source()
        event = 'violated' if self.violation.index >= 0 else 'failed'
        lines = [
            printable(self.violation.key, LONGEST_KEY),
            f'  {self.count} world{"s" * (self.count != 1)}, the first is number {self.first_world}; '
            f'smallest case after {self.shrink_worlds} worlds'
            + ('' if self.complete else ' (not shrunk to the end)'),
            f'  {event} at {self.violation.seconds:g} s: {self.violation.headline}',
            f'  case:   {source.expression(self.trial.case)}',
            f'  faults: {source.expression(list(self.trial.faults))}'
            + (f', seed {self.trial.seed}' if self.trial.faults else ''),
        ]
        if not self.deterministic:
            lines.append(
                '  not deterministic: a second run of the same case gave other messages or another '
                'violation. Does the scenario use random numbers, wall time or threads?'
            )
        lines += [f'  {note}' for note in self.notes]
        if self.directory is not None:
            here = Path.cwd()
            within = self.directory.is_relative_to(here)
            shown = self.directory.relative_to(here) if within else self.directory
            lines.append(f'  {shown}')
        return '\n'.join(lines)


@dataclass(frozen=True, kw_only=True)
class Exploration:
    """What an exploration has done and found. `print` shows it as text."""

    seed: int
    worlds: int
    """Number of worlds that ran, without those for shrinking."""
    wanted: int
    """Number of worlds that were asked for."""
    findings: tuple[Finding, ...]
    """One for each violated property and each exception, in the order of their first world."""
    seconds: float
    """Wall time of these worlds (s)."""
    shrink_seconds: float
    """Wall time of shrinking and writing (s)."""
    simulated: float
    """Simulated time of these worlds (s)."""
    faults: int
    """Number of faults in these worlds."""
    checks: int
    """How often a property was checked."""
    compared: int = 0
    """Number of messages that were compared with their images."""
    stopped: str = ''
    """Why not all worlds ran; empty: they did."""
    unseen: Unseen = field(default_factory=Unseen)
    """What no world has touched."""
    notes: tuple[str, ...] = ()
    """What went wrong in worlds without being a finding."""

    @property
    def shrink_worlds(self) -> int:
        """Number of worlds that were run for shrinking."""
        return sum(finding.shrink_worlds for finding in self.findings)

    @property
    def rate(self) -> float:
        """Worlds per second of wall time."""
        return self.worlds / self.seconds if self.seconds > 0.0 else 0.0

    def replay(self, finding: Finding | None = None) -> Replay:
        """Run the smallest case of a finding again (default: the first finding), and compare.

        It runs in a process of its own if need be.

        Raises:
            ExplorationError: Nothing was found.
        """
        finding = finding or next(iter(self.findings), None)
        if finding is None:
            raise ExplorationError('there is nothing to replay: no property was violated')
        found = finding.violation
        data = packed(finding.setting, [finding.trial], only=found.index, digest=True)
        # A world that ends its process must not end this one.
        (outcome,) = run_worlds(data, afresh=found.name == DIED)
        return Replay.compared(
            outcome.of(found.key),
            outcome.digest,
            (found.key, found.seconds, finding.digest),
            finding.versions,
        )

    def __str__(self) -> str:
        """Return the statistics and the findings."""
        lines = [
            f'{self.worlds} worlds of {self.wanted} in {self.seconds:.1f} s '
            f'({self.rate:.1f} worlds/s), {self.simulated:.0f} s of simulated time, seed {self.seed}',
            f'{self.faults} faults injected, {self.checks} checks of properties, '
            + (f'{self.compared} messages compared with images, ' if self.compared else '')
            + f'{len(self.findings)} violated',
        ]
        if self.findings:
            lines.append(
                f'{self.shrink_worlds} more worlds to shrink them in {self.shrink_seconds:.1f} s'
            )
        if self.stopped:
            lines.append(f'stopped: {self.stopped}')
        lines += [f'note: {note}' for note in self.notes[:NOTED]]
        if len(self.notes) > NOTED:
            lines.append(f'note: and {len(self.notes) - NOTED} more notes')
        if unseen := str(self.unseen):
            lines.append(f'not seen in any world:\n{unseen}')
        return '\n\n'.join(['\n'.join(lines), *map(str, self.findings)])


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

    @classmethod
    def compared(
        cls,
        violation: Violation | None,
        digest: str,
        found: tuple[str, float, str],
        found_with: dict[str, str],
    ) -> Replay:
        """Compare violation and digest of a run with key, time and digest of what was found."""
        return cls(
            violation=violation,
            same_verdict=violation is not None and violation.key == found[0],
            same_bits=violation is not None and (violation.key, violation.seconds, digest) == found,
            differences=tuple(differences(versions(), found_with)),
        )

    def __str__(self) -> str:
        """Return a description of one line."""
        different = self.differences
        where = f'; {"; ".join(different)}' if different else ', with the same versions and processor'
        if self.same_bits:
            return f'the same as found, bit for bit{where}'
        if self.same_verdict:
            return f'violated as found, but not bit for bit{where}'
        return f'not violated as it was found{where}'


@contextmanager
def reproducing(world: Lockstep | None, case: Path) -> Iterator[None]:
    """Add to an exception that the body raises how it compares with what `explore` found.

    It is the same bit for bit with the same versions and the same features of the processor. Elsewhere
    the verdict is the same, but numbers may be rounded otherwise.

    Args:
        world: The world in which the body runs the case; None: it calls `check_relation`.
        case: The file counterexample.json.
    """
    fields = json.loads(case.read_text(encoding='utf-8'))
    found = fields['violation'], fields['seconds'], fields['digest']
    with nullcontext() if world is None else MessageDigest(world) as messages:
        try:
            yield
        except (Exception, SystemExit) as error:
            if ends_all(error):
                raise
            violation = of_exception(error, 0.0 if world is None else world.world_seconds)
            digest = getattr(error, 'digest', '') if messages is None else messages.value()
            compared = Replay.compared(violation, digest, found, fields['versions'])
            # As add_note of Python 3.11, whose types are those of one version alone.
            notes = [*getattr(error, '__notes__', []), str(compared)]
            setattr(error, '__notes__', notes)  # noqa: B010
            raise
