"""Exploring worlds: thousands of cases and fault schedules, of which the failing ones are shrunk.

Hypothesis generates the trials in this process, block by block. The executor runs them. So the worlds
depend on the seed alone, not on the number of cores. A violated property is shrunk by running its block
again in Hypothesis, with the outcomes that are known already, until its first failing trial.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from diffdrive_jacobian.exploration.executors import LocalExecutor, SerialExecutor
from diffdrive_jacobian.exploration.output import write_finding
from diffdrive_jacobian.exploration.result import Exploration, Finding
from diffdrive_jacobian.exploration.scenario import ExplorationError, Source
from diffdrive_jacobian.exploration.schedules import StopShrinking, generate, shrink, st
from diffdrive_jacobian.exploration.trial import Outcome, Setting, Trial, Violation
from diffdrive_jacobian.exploration.worker import (
    TaskNotEnded,
    packed,
    result_of,
    run_world_afresh,
    run_worlds,
)


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


BLOCK = 50
"""Number of trials that Hypothesis generates from one seed."""
TASK = 5
"""Number of worlds in one task of the executor."""
IN_FLIGHT = 64
"""Number of tasks that the executor has at a time. Worlds beyond a stop are run in vain."""
GRACE = 30.0
"""Wall time after the time limit for worlds that are running (s)."""


@dataclass(frozen=True, kw_only=True)
class Numbered:
    """A trial and where it comes from."""

    number: int
    """Number of its world, from 0."""
    block: int
    key: str
    trial: Trial


class Search:
    """One exploration."""

    def __init__(
        self,
        setting: Setting,
        strategy: st.SearchStrategy[Trial],
        seed: int,
        worlds: int,
        executor: Executor,
        time_limit: float | None,
    ) -> None:
        """Start with no world. The time limit (s) counts from now."""
        self._setting, self._strategy, self._seed = setting, strategy, seed
        self._wanted, self._executor = worlds, executor
        self._begin = time.monotonic()
        self._end = math.inf if time_limit is None else self._begin + time_limit
        self._limit = time_limit
        self._first: dict[str, tuple[Numbered, Violation]] = {}
        self._counts: Counter[str] = Counter()
        self._complaints: Counter[str] = Counter()
        self._known: dict[int, dict[str, Outcome]] = {}
        self._worlds = self._faults = self._checks = 0
        self._simulated = 0.0
        self._stopped = ''

    def run(self, stop_at_first: bool, shrink_worlds: int, output: Path | None) -> Exploration:
        """Run the worlds, then shrink and write what they violate."""
        findings: list[Finding] = []
        found_at = None
        try:
            self._explore(stop_at_first)
            found_at = time.monotonic()
            # What is written is written here, where the folder is.
            here = isinstance(self._executor, (LocalExecutor, SerialExecutor))
            with nullcontext(self._executor) if here else LocalExecutor(1) as recorder:
                for key in self._first:
                    finding = self._shrunk(key, shrink_worlds)
                    if output is not None:
                        finding = write_finding(
                            finding, output, findings, seed=self._seed, executor=recorder
                        )
                    findings.append(finding)
        except KeyboardInterrupt:
            self._stopped = 'interrupted'
            findings += self._not_shrunk(findings, output)
        except TaskNotEnded:
            self._stopped = (
                f'time limit of {self._limit:g} s; a world still ran {GRACE:g} s later: does its '
                'scenario end?'
            )
            findings += self._not_shrunk(findings, output)
        now = time.monotonic()
        return Exploration(
            seed=self._seed,
            worlds=self._worlds,
            wanted=self._wanted,
            findings=tuple(findings),
            seconds=(found_at or now) - self._begin,
            shrink_seconds=now - (found_at or now),
            simulated=self._simulated,
            faults=self._faults,
            checks=self._checks,
            stopped=self._stopped,
            notes=tuple(
                f'{text} ({count} of {self._worlds} worlds)'
                for text, count in self._complaints.most_common()
            ),
        )

    # --- Worlds

    def _explore(self, stop_at_first: bool) -> None:
        """Run the worlds of one block after the other."""
        waiting: deque[tuple[list[Numbered], Future[list[Outcome]]]] = deque()
        tasks = self._tasks()
        more = True
        try:
            while True:
                while more and len(waiting) < IN_FLIGHT and not (waiting and waiting[0][1].done()):
                    task = next(tasks, None)
                    if task is None:
                        more = False
                        break
                    data = packed(self._setting, [one.trial for one in task])
                    waiting.append((task, self._executor.submit(run_worlds, data)))
                if not waiting:
                    return
                task, future = waiting.popleft()
                for one, outcome in zip(task, self._result(future), strict=True):
                    if stop_at_first and self._first and one.block > self._block_of_first():
                        self._stopped = 'after the first block with a violation'
                        return
                    self._note(one, outcome)
                if self._over():
                    self._stopped = f'time limit of {self._limit:g} s'
                    return
        finally:
            for _, future in waiting:
                future.cancel()

    def _tasks(self) -> Iterator[list[Numbered]]:
        """Yield the trials in groups, without repetitions."""
        task: list[Numbered] = []
        for one in self._numbered():
            task.append(one)
            if len(task) == TASK:
                yield task
                task = []
        if task:
            yield task

    def _numbered(self) -> Iterator[Numbered]:
        seen: set[str] = set()
        block = number = 0
        while True:
            before = number
            for trial in generate(self._strategy, self._seed, block, BLOCK):
                key = key_of(trial)
                if key in seen:
                    continue
                seen.add(key)
                yield Numbered(number=number, block=block, key=key, trial=trial)
                number += 1
                if number == self._wanted:
                    return
            if number == before:
                self._stopped = f'there are no more than {number} different worlds'
                return
            block += 1

    def _note(self, one: Numbered, outcome: Outcome) -> None:
        """Count an outcome, and keep the first of each violation."""
        self._worlds += 1
        self._faults += len(one.trial.faults)
        self._checks += outcome.checks
        self._simulated += outcome.seconds
        if outcome.complaints and not one.trial.faults:
            raise ExplorationError(f'in a world without faults: {outcome.complaints[0]}')
        self._complaints.update(outcome.complaints)
        self._known.setdefault(one.block, {})[one.key] = outcome
        for violation in outcome.violations:
            self._counts[violation.key] += 1
            self._first.setdefault(violation.key, (one, violation))
        # Only the outcomes of blocks that will be run again are needed.
        kept = {one.block, *(first.block for first, _ in self._first.values())}
        for block in self._known.keys() - kept:
            del self._known[block]

    def _block_of_first(self) -> int:
        return min(one.block for one, _ in self._first.values())

    # --- Shrinking

    def _shrunk(self, key: str, shrink_worlds: int) -> Finding:
        """Return the finding with its smallest case."""
        first, violation = self._first[key]
        fails = Fails(
            first.key,
            violation,
            self._known.get(first.block, {}),
            lambda trial: self._run(trial, violation.index),
            lambda worlds: worlds < shrink_worlds and not self._over(),
        )
        smallest = shrink(self._strategy, self._seed, first.block, BLOCK, fails)
        again = [self._run(smallest, violation.index, digest=True, afresh=one) for one in (False, True)]
        violations = [outcome.of(key) for outcome in again]
        same = violations[0] is not None and (again[0].digest, violations[0]) == (
            again[1].digest,
            violations[1],
        )
        return replace(
            self._unshrunk(key),
            violation=violations[0] or violations[1] or fails.violation,
            trial=smallest,
            shrink_worlds=fails.worlds,
            complete=not fails.stopped,
            deterministic=same,
            digest=again[0].digest,
        )

    def _unshrunk(self, key: str) -> Finding:
        """Return the finding with the first case."""
        first, violation = self._first[key]
        return Finding(
            violation=violation,
            trial=first.trial,
            setting=self._setting,
            count=self._counts[key],
            first_world=first.number,
            first_trial=first.trial,
            complete=False,
        )

    def _over(self) -> bool:
        return time.monotonic() >= self._end

    def _run(self, trial: Trial, index: int, *, digest: bool = False, afresh: bool = False) -> Outcome:
        """Run a world, in a new process if `afresh`, unless worlds are to run in this thread."""
        data = packed(self._setting, [trial], only=index, digest=digest)
        afresh = afresh and not isinstance(self._executor, SerialExecutor)
        (outcome,) = self._result(
            self._executor.submit(run_world_afresh if afresh else run_worlds, data)
        )
        return outcome

    def _result(self, future: Future[list[Outcome]]) -> list[Outcome]:
        left = self._end - time.monotonic()
        return result_of(future, max(0.0, left) + GRACE if math.isfinite(left) else None)

    def _not_shrunk(self, findings: list[Finding], output: Path | None) -> list[Finding]:
        """Return what was found, but not shrunk before Ctrl-C."""
        done = {finding.violation.key for finding in findings}
        rest: list[Finding] = []
        for key in self._first:
            if key in done:
                continue
            finding = self._unshrunk(key)
            if output is not None:
                finding = write_finding(finding, output, [*findings, *rest], seed=self._seed)
            rest.append(finding)
        return rest
