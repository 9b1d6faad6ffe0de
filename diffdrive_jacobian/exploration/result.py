"""The result of an exploration."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from diffdrive_jacobian.exploration.scenario import Source
from diffdrive_jacobian.exploration.trial import Setting, Trial, Violation
from diffdrive_jacobian.exploration.versions import versions
from diffdrive_jacobian.text import printable

if TYPE_CHECKING:
    from diffdrive_jacobian.exploration.replay import Replay

LONGEST_KEY = 200
"""Length beyond which a property is cut where it is a title (characters)."""
NOTED = 10
"""Number of notes that are printed."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A violated property, or an exception, and the smallest case that shows it."""

    violation: Violation
    """What the smallest case violates, and when."""
    trial: Trial
    """The smallest case, with its faults."""
    setting: Setting
    """The scenario and the properties."""
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
            f'  {self.count} worlds, the first is number {self.first_world}; '
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
    stopped: str = ''
    """Why not all worlds ran; empty: they did."""
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

        Raises:
            ExplorationError: Nothing was found.
        """
        # Not above: it imports this module.
        from diffdrive_jacobian.exploration.replay import replay

        return replay(finding or next(iter(self.findings), None))

    def __str__(self) -> str:
        """Return the statistics and the findings."""
        lines = [
            f'{self.worlds} worlds of {self.wanted} in {self.seconds:.1f} s '
            f'({self.rate:.1f} worlds/s), {self.simulated:.0f} s of simulated time, seed {self.seed}',
            f'{self.faults} faults injected, {self.checks} checks of properties, '
            f'{len(self.findings)} violated',
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
        return '\n\n'.join(['\n'.join(lines), *map(str, self.findings)])
