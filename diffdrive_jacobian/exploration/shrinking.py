"""Which trials fail, for Hypothesis while it shrinks one."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diffdrive_jacobian.exploration.generation import StopShrinking
from diffdrive_jacobian.exploration.source import Source
from diffdrive_jacobian.exploration.trial import Outcome, Trial, Violation


class Fails:
    """Whether a trial fails, from the known outcomes or by running it."""

    def __init__(
        self,
        first: str,
        violation: Violation,
        known: Mapping[str, Outcome],
        execute: Callable[[Trial], Outcome],
        may_run: Callable[[int], bool],
    ) -> None:
        """Start with what is known.

        Args:
            first: Key of the first trial that failed.
            violation: What it violated.
            known: Outcomes by the keys of their trials.
            execute: Runs a trial.
            may_run: Receives how many were run, returns whether another one may be.
        """
        self._execute, self._may_run = execute, may_run
        self._key = violation.key
        self.violation = violation
        """The violation of the last trial that failed."""
        self.worlds = 0
        """Number of worlds that were run."""
        self.stopped = False
        """Whether a limit was reached."""
        self._begun = False
        self._first = first
        self._failing: dict[str, bool] = {
            key: outcome.of(self._key) is not None for key, outcome in known.items()
        }

    def __call__(self, trial: Trial) -> bool:
        """Return whether a trial fails.

        Raises:
            StopShrinking: It is not known, and a limit is reached.
        """
        key = key_of(trial)
        if not self._begun:
            # The trials before the first that failed. Others of them were run in an earlier block.
            self._begun = key == self._first
            return self._begun
        if key not in self._failing:
            if not self._may_run(self.worlds):
                self.stopped = True
                raise StopShrinking
            self.worlds += 1
            found = self._execute(trial).of(self._key)
            self._failing[key] = found is not None
            self.violation = found or self.violation
        return self._failing[key]


def key_of(trial: Trial) -> str:
    """Return what identifies a trial."""
    source = Source()
    return source.expression((trial.case, trial.faults, trial.seed))
