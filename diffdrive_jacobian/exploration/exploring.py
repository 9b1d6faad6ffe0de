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

"""Exploring worlds: thousands of cases and fault schedules, of which the failing ones are shrunk.

Hypothesis generates the trials in this process, block by block. The executor runs them. So the worlds
depend on the seed alone, not on the number of cores. A violated property is shrunk by running its block
again in Hypothesis, with the outcomes that are known already, until its first failing trial.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

from diffdrive_jacobian.exploration import processes
from diffdrive_jacobian.exploration.output import check_output, remove_others, write_finding
from diffdrive_jacobian.exploration.processes import (
    LocalExecutor,
    SerialExecutor,
    packed,
    run_worlds,
)
from diffdrive_jacobian.exploration.result import Exploration, Finding
from diffdrive_jacobian.exploration.scenario import ExplorationError, Scenario, ScenarioName, Source
from diffdrive_jacobian.exploration.schedules import StopShrinking, generate, shrink, st, trials
from diffdrive_jacobian.exploration.trial import Outcome, Setting, Trial, Violation
from diffdrive_jacobian.exploration.unseen import Summary
from diffdrive_jacobian.numerics.checks import integer, number, positive_or_infinite
from diffdrive_jacobian.properties.base import Property
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.signals import one_interrupt
from diffdrive_jacobian.text import error_text

BLOCK = 50
"""Number of trials that Hypothesis generates from one seed."""
TASK = 5
"""Number of worlds in one task of the executor."""
IN_FLIGHT = 64
"""Number of tasks that the executor has at a time. Worlds beyond a stop are run in vain."""
GRACE = 30.0
"""Wall time after the time limit for worlds that are running (s)."""


def explore(
    scenario: Scenario,
    properties: Sequence[Property] = (),
    *,
    relations: Sequence[Relation] = (),
    cases: Mapping[str, st.SearchStrategy[Any]] | st.SearchStrategy[Any] | None = None,
    faults: st.SearchStrategy[Any] | None = None,
    worlds: int = 1000,
    seed: int = 0,
    stop_at_first: bool = False,
    time_limit: float | None = None,
    shrink_worlds: int = 500,
    args: Sequence[str] = (),
    executor: Executor | None = None,
    output: str | Path | None = None,
) -> Exploration:
    """Run a scenario in many worlds, and return what was violated, each as the smallest case found.

    An exception is a finding, too, whether a node raises it or an `assert` of the scenario. The same
    arguments give the same worlds and the same findings, on any number of cores.

    Args:
        scenario: `scenario(world, case)` creates nodes in a `Lockstep` and advances its time. A function
            at the top level of a module. The faults are injected before, and the properties required.
        properties: What must hold, such as `[StopsAfterLostOdometry(1.0)]`.
        relations: How each world must compare with its image, such as `[Mirrored()]`. The image, and
            further worlds that show whether rounding matters, are run in addition.
        cases: Strategies by name, such as `{'start': poses(), 'goal': goals()}`. The case is then a dict
            with these keys. A single strategy: the case is its value. None: the case is None.
        faults: Strategy of lists of faults, such as `fault_schedules(['odom'])`; None: no faults.
        worlds: Number of worlds. Fewer run if there are not as many different ones.
        seed: Seed of everything that is random.
        stop_at_first: Whether to stop at the first block of worlds (50) with a violation.
        time_limit: Wall time after which no more worlds are started (s); None: no limit. The result then
            depends on the speed of the machine. Worlds that still run 30 s later are given up.
        shrink_worlds: Largest number of worlds that are run to shrink one violation.
        args: ROS arguments of all nodes, as for `Lockstep`.
        executor: Runs the worlds; None: all cores of this machine. Any Executor of `concurrent.futures`
            serves, also `Client.get_executor()` of Dask.
        output: Folder for what was found: for each violation the case, a test that reproduces it, a bag
            and a picture. What an earlier exploration has written there is removed, except after Ctrl-C.
            None: nothing is written.

    Returns:
        The result. After Ctrl-C it has what was found so far.

    Raises:
        ExplorationError: The exploration cannot be done, for example because the scenario cannot be
            imported by other processes, or one of the properties is none.
    """
    if processes.serving:
        raise ExplorationError(
            'explore was called by the module of the scenario when a process imported it: call it under '
            "if __name__ == '__main__':"
        )
    setting = Setting(
        scenario=ScenarioName.of(scenario),
        properties=_checked('properties', Property, properties),
        relations=_checked('relations', Relation, relations),
        args=tuple(args),
    )
    try:
        integer('worlds', worlds, 1)
        integer('shrink_worlds', shrink_worlds, 0)
        integer('seed', seed, 0)
        if time_limit is not None:
            number('time_limit', time_limit, positive_or_infinite)
    except ValueError as error:
        raise ExplorationError(str(error)) from None
    # A scenario may change the working directory.
    folder = None if output is None else Path(output).absolute()
    if folder is not None:
        check_output(folder)
    if isinstance(cases, Mapping) and all(isinstance(one, st.SearchStrategy) for one in cases.values()):
        cases = st.fixed_dictionaries(dict(cases))
    if not isinstance(cases, st.SearchStrategy | None):
        raise ExplorationError(
            'cases must be strategies of Hypothesis by name, such as '
            f"{{'start': poses()}}, or one strategy; got {cases!r}"
        )
    if not isinstance(faults, st.SearchStrategy | None):
        raise ExplorationError(
            "faults must be a strategy of lists of faults, such as fault_schedules(['odom']); "
            f'got {faults!r}'
        )
    strategy = trials(st.none() if cases is None else cases, st.just(()) if faults is None else faults)
    if executor is not None and not callable(getattr(executor, 'submit', None)):
        raise ExplorationError(
            f'executor must be an Executor of concurrent.futures, got {type(executor).__name__}'
        )
    used = LocalExecutor() if executor is None else executor
    complete = False
    with one_interrupt():
        try:
            search = Search(
                setting=setting,
                strategy=strategy,
                seed=seed,
                wanted=worlds,
                executor=used,
                time_limit=math.inf if time_limit is None else time_limit,
            )
            result = search.run(stop_at_first, shrink_worlds, folder)
            complete = not result.stopped
            if folder is not None and result.stopped != 'interrupted':
                remove_others(folder, result.findings)
            return result
        finally:
            if executor is None:
                used.shutdown(wait=True, cancel_futures=not complete)


def _checked(name: str, kind: Any, values: Any) -> tuple[Any, ...]:
    """Return the properties or the relations that were given."""
    if isinstance(values, kind):
        raise ExplorationError(f'{name} must be a list: [{values!r}]')
    if not isinstance(values, Iterable):
        raise ExplorationError(f'{name} must be a list, got {values!r}')
    checked = tuple(values)
    for one in checked:
        if not isinstance(one, kind):
            hint = '; create one: ' + one.__name__ + '(...)' if isinstance(one, type) else ''
            raise ExplorationError(f'{name} must be instances of {kind.__name__}, got {one!r}{hint}')
    keys = Counter(map(repr, checked))
    if twice := [key for key, count in keys.items() if count > 1]:
        raise ExplorationError(f'{name}: each can be given once, got {twice[0]} again')
    for one in checked:
        # A test will contain it.
        Source().expression(one)
    return checked


def _key_of(trial: Trial) -> str:
    """Return what identifies a trial."""
    return Source().expression((trial.case, trial.faults, trial.seed))


class TaskNotEnded(BaseException):
    """A task still runs. Not an Exception, which Hypothesis would take for a failure."""


@dataclass(frozen=True, kw_only=True)
class Numbered:
    """A trial and where it comes from."""

    number: int
    """Number of its world, from 0."""
    block: int
    key: str
    trial: Trial


@dataclass(kw_only=True, eq=False)
class Search:
    """One exploration."""

    setting: Setting
    strategy: st.SearchStrategy[Trial]
    seed: int
    wanted: int
    executor: Executor
    time_limit: float
    """Wall time from now on (s)."""
    begin: float = field(default_factory=time.monotonic)
    first: dict[str, tuple[Numbered, Violation]] = field(default_factory=dict)
    """The first world of each violation."""
    counts: Counter[str] = field(default_factory=Counter)
    complaints: Counter[str] = field(default_factory=Counter)
    known: dict[int, dict[str, Outcome]] = field(default_factory=dict)
    """Outcomes of blocks that will be run again, by the keys of their trials."""
    worlds: int = 0
    faults: int = 0
    summary: Summary = field(default_factory=Summary)
    checks: int = 0
    compared: Counter[str] = field(default_factory=Counter)
    """By relation."""
    simulated: float = 0.0
    stopped: str = ''

    def run(self, stop_at_first: bool, shrink_worlds: int, output: Path | None) -> Exploration:
        """Run the worlds, then shrink and write what they violate."""
        findings: list[Finding] = []
        found_at = None
        try:
            self._explore(stop_at_first)
            found_at = time.monotonic()
            # What is written is written here, where the folder is.
            here = isinstance(self.executor, (LocalExecutor, SerialExecutor))
            with nullcontext(self.executor) if here else LocalExecutor(1) as recorder:
                for key in self.first:
                    finding = self._shrunk(key, shrink_worlds)
                    if output is not None:
                        finding = write_finding(
                            finding, output, findings, seed=self.seed, executor=recorder
                        )
                    findings.append(finding)
        except (KeyboardInterrupt, TaskNotEnded) as error:
            self.stopped = 'interrupted'
            if isinstance(error, TaskNotEnded):
                self.stopped = (
                    f'time limit of {self.time_limit:g} s; a world still ran {GRACE:g} s later: does '
                    'its scenario end?'
                )
            done = {finding.violation.key for finding in findings}
            for key in [key for key in self.first if key not in done]:
                finding = self._unshrunk(key)
                if output is not None:
                    finding = write_finding(finding, output, findings, seed=self.seed)
                findings.append(finding)
        now = time.monotonic()
        return Exploration(
            seed=self.seed,
            worlds=self.worlds,
            wanted=self.wanted,
            findings=tuple(findings),
            seconds=(found_at or now) - self.begin,
            shrink_seconds=now - (found_at or now),
            simulated=self.simulated,
            faults=self.faults,
            checks=self.checks,
            compared=self.compared.total(),
            stopped=self.stopped,
            unseen=self.summary.unseen(self.worlds, self.faults),
            notes=(
                *(
                    f'{one}: nothing was compared, or heard otherwise'
                    for one, count in self.compared.items()
                    if not count
                ),
                *(
                    f'{text} ({count} of {self.worlds} worlds)'
                    for text, count in self.complaints.most_common()
                ),
            ),
        )

    # --- Worlds

    def _explore(self, stop_at_first: bool) -> None:
        """Run the worlds of one block after the other."""
        waiting: deque[tuple[list[Numbered], Future[list[Outcome]]]] = deque()
        numbered = self._numbered()
        try:
            while True:
                while len(waiting) < IN_FLIGHT and not (waiting and waiting[0][1].done()):
                    task = list(islice(numbered, TASK))
                    if not task:
                        break
                    data = packed(self.setting, [one.trial for one in task])
                    waiting.append((task, self.executor.submit(run_worlds, data)))
                if not waiting:
                    return
                task, future = waiting.popleft()
                for one, outcome in zip(task, self._result(future), strict=True):
                    if stop_at_first and self.first:
                        first = min(numbered.block for numbered, _ in self.first.values())
                        if one.block > first:
                            self.stopped = 'after the first block with a violation'
                            return
                    self._note(one, outcome)
                if self.time_left() <= 0.0:
                    self.stopped = f'time limit of {self.time_limit:g} s'
                    return
        finally:
            for _, future in waiting:
                future.cancel()

    def _numbered(self) -> Iterator[Numbered]:
        """Yield the trials, without repetitions."""
        seen: set[str] = set()
        block = number = 0
        while True:
            before = number
            for trial in generate(self.strategy, self.seed, block, BLOCK):
                key = _key_of(trial)
                if key in seen:
                    continue
                seen.add(key)
                yield Numbered(number=number, block=block, key=key, trial=trial)
                number += 1
                if number == self.wanted:
                    return
            if number == before:
                self.stopped = f'there are no more than {number} different worlds'
                return
            block += 1

    def _note(self, one: Numbered, outcome: Outcome) -> None:
        """Count an outcome, and keep the first of each violation."""
        self.worlds += 1
        self.faults += len(one.trial.faults)
        self.checks += outcome.checks
        self.summary.add(outcome.seen, outcome.compared_topics)
        self.compared.update(outcome.compared)
        self.simulated += outcome.seconds
        if outcome.complaints and not one.trial.faults:
            raise ExplorationError(f'in a world without faults: {outcome.complaints[0]}')
        self.complaints.update([*outcome.complaints, *outcome.notes])
        self.known.setdefault(one.block, {})[one.key] = outcome
        for violation in outcome.violations:
            self.counts[violation.key] += 1
            self.first.setdefault(violation.key, (one, violation))
        kept = {one.block, *(first.block for first, _ in self.first.values())}
        for block in self.known.keys() - kept:
            del self.known[block]

    # --- Shrinking

    def _shrunk(self, key: str, shrink_worlds: int) -> Finding:
        """Return the finding with its smallest case."""
        first, violation = self.first[key]
        fails = _Fails(self, key, shrink_worlds)
        smallest = shrink(self.strategy, self.seed, first.block, BLOCK, fails)
        again = [
            self.run_trial(smallest, violation.index, digest=True, afresh=afresh)
            for afresh in (False, True)
        ]
        one, two = ((outcome.of(key), outcome.digest) for outcome in again)
        return replace(
            self._unshrunk(key),
            violation=one[0] or two[0] or fails.violation,
            trial=smallest,
            shrink_worlds=fails.worlds,
            complete=not fails.stopped,
            deterministic=one[0] is not None and one == two,
            digest=again[0].digest,
        )

    def _unshrunk(self, key: str) -> Finding:
        """Return the finding with the first case."""
        first, violation = self.first[key]
        return Finding(
            violation=violation,
            trial=first.trial,
            setting=self.setting,
            count=self.counts[key],
            first_world=first.number,
            first_trial=first.trial,
            complete=False,
        )

    def run_trial(
        self, trial: Trial, index: int, *, digest: bool = False, afresh: bool = False
    ) -> Outcome:
        """Run a world, in a new process if `afresh`, unless worlds are to run in this thread."""
        data = packed(self.setting, [trial], only=index, digest=digest)
        afresh = afresh and not isinstance(self.executor, SerialExecutor)
        (outcome,) = self._result(self.executor.submit(run_worlds, data, afresh=afresh))
        return outcome

    def time_left(self) -> float:
        """Return the wall time until the time limit (s)."""
        return self.begin + self.time_limit - time.monotonic()

    def _result(self, future: Future[list[Outcome]]) -> list[Outcome]:
        left = self.time_left()
        return result_of(future, max(0.0, left) + GRACE if math.isfinite(left) else None)


class _Fails:
    """Whether a trial shows a violation, known from its first block or by running it."""

    def __init__(self, search: Search, key: str, most_worlds: int) -> None:
        """Start with what is known of the block."""
        first, self.violation = search.first[key]
        """The violation of the last trial that failed."""
        self.worlds = 0
        """Number of worlds that were run."""
        self.stopped = False
        """Whether a limit was reached."""
        self._search, self._first, self._most_worlds = search, first.key, most_worlds
        self._begun = False
        known = search.known.get(first.block, {})
        self._failing = {one: outcome.of(key) is not None for one, outcome in known.items()}

    def __call__(self, trial: Trial) -> bool:
        """Return whether a trial fails.

        Raises:
            StopShrinking: It is not known, and a limit is reached.
        """
        key = _key_of(trial)
        if not self._begun:
            # The trials before the first that failed. Others of them were run in an earlier block.
            self._begun = key == self._first
            return self._begun
        if key not in self._failing:
            if self.worlds >= self._most_worlds or self._search.time_left() <= 0.0:
                self.stopped = True
                raise StopShrinking
            self.worlds += 1
            outcome = self._search.run_trial(trial, self.violation.index)
            found = outcome.of(self.violation.key)
            self._failing[key] = found is not None
            self.violation = found or self.violation
        return self._failing[key]


def result_of(future: Future[list[Outcome]], timeout: float | None) -> list[Outcome]:
    """Return the result of a task, for which to wait for a wall time (s); None: no limit.

    Raises:
        ExplorationError: The executor failed, or a fault or a property is invalid.
        TaskNotEnded: The task still runs after `timeout`.
    """
    try:
        return future.result(timeout)
    except ExplorationError:
        raise
    except Exception as error:
        if isinstance(error, FutureTimeoutError) and not future.done():
            raise TaskNotEnded from None
        raise ExplorationError(
            f'a world could not be run: {type(error).__name__}: {error_text(error)}'
        ) from error
