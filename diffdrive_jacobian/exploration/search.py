"""Exploring worlds: thousands of cases and fault schedules, of which the failing ones are shrunk.

Hypothesis generates the trials in this process, block by block. The executor runs them. So the worlds
depend on the seed alone, not on the number of cores. A violated property is shrunk by running its block
again in Hypothesis, with the outcomes that are known already, until its first failing trial.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diffdrive_jacobian.exploration import child
from diffdrive_jacobian.exploration.errors import ExplorationError
from diffdrive_jacobian.exploration.executors import LocalExecutor
from diffdrive_jacobian.exploration.generation import StopShrinking, generate, shrink, st, trials
from diffdrive_jacobian.exploration.output import check_output, write_finding
from diffdrive_jacobian.exploration.result import Exploration, Finding
from diffdrive_jacobian.exploration.scenario import Scenario, ScenarioName
from diffdrive_jacobian.exploration.source import Source
from diffdrive_jacobian.exploration.trial import Outcome, Setting, Trial, Violation
from diffdrive_jacobian.exploration.worker import packed, run_worlds
from diffdrive_jacobian.properties import Property

BLOCK = 50
"""Number of trials that Hypothesis generates from one seed."""
TASK = 5
"""Number of worlds in one task of the executor."""
IN_FLIGHT = 64
"""Number of tasks that the executor has at a time. Worlds beyond a stop are run in vain."""


def explore(
    scenario: Scenario,
    properties: Sequence[Property] = (),
    *,
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
        cases: Strategies by name, such as `{'start': poses(), 'goal': goals()}`. The case is then a dict
            with these keys. A single strategy: the case is its value. None: the case is None.
        faults: Strategy of lists of faults, such as `fault_schedules(['odom'])`; None: no faults.
        worlds: Number of worlds. Fewer run if there are not as many different ones.
        seed: Seed of everything that is random.
        stop_at_first: Whether to stop at the first block of worlds (50) with a violation.
        time_limit: Wall time after which no more worlds are started (s); None: no limit. The result then
            depends on the speed of the machine.
        shrink_worlds: Largest number of worlds that are run to shrink one violation.
        args: ROS arguments of all nodes, as for `Lockstep`.
        executor: Runs the worlds; None: all cores of this machine. Any Executor of `concurrent.futures`
            serves, also `Client.get_executor()` of Dask.
        output: Folder for what was found: for each violation the case, a test that reproduces it, a bag
            and a picture. None: nothing is written.

    Returns:
        The result. After Ctrl-C it has what was found so far.

    Raises:
        ExplorationError: The exploration cannot be done, for example because the scenario cannot be
            imported by other processes, or one of the properties is none.
    """
    if child.serving:
        raise ExplorationError(
            'explore was called by the module of the scenario when a process imported it: call it under '
            "if __name__ == '__main__':"
        )
    setting = Setting(
        scenario=ScenarioName.of(scenario), properties=_checked_properties(properties), args=tuple(args)
    )
    _check_number('worlds', worlds, 1)
    _check_number('shrink_worlds', shrink_worlds, 0)
    _check_number('seed', seed, 0)
    if time_limit is not None and not time_limit > 0.0:
        raise ExplorationError(f'time_limit must be positive, got {time_limit!r}')
    if output is not None:
        check_output(Path(output))
    strategy = trials(_case_strategy(cases), _fault_strategy(faults))
    if executor is not None and not callable(getattr(executor, 'submit', None)):
        raise ExplorationError(
            f'executor must be an Executor of concurrent.futures, got {type(executor).__name__}'
        )
    used = LocalExecutor() if executor is None else executor
    complete = False
    try:
        search = _Search(setting, strategy, seed, worlds, used, time_limit)
        result = search.run(stop_at_first, shrink_worlds, None if output is None else Path(output))
        complete = not result.stopped
        return result
    finally:
        if executor is None:
            used.shutdown(wait=True, cancel_futures=not complete)


@dataclass(frozen=True, kw_only=True)
class _Numbered:
    """A trial and where it comes from."""

    number: int
    """Number of its world, from 0."""
    block: int
    key: str
    trial: Trial


class _Search:
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
        self._setting, self._strategy, self._seed = setting, strategy, seed
        self._wanted, self._executor = worlds, executor
        self._begin = time.monotonic()
        self._end = math.inf if time_limit is None else self._begin + time_limit
        self._limit = time_limit
        self._first: dict[str, tuple[_Numbered, Violation]] = {}
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
            for key in self._first:
                finding = self._shrunk(key, shrink_worlds)
                if output is not None:
                    finding = write_finding(finding, output, findings, seed=self._seed)
                findings.append(finding)
        except KeyboardInterrupt:
            self._stopped = 'interrupted'
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
            notes=tuple(f'in {count} worlds: {text}' for text, count in self._complaints.items()),
        )

    # --- Worlds

    def _explore(self, stop_at_first: bool) -> None:
        """Run the worlds of one block after the other."""
        waiting: deque[tuple[list[_Numbered], Future[list[Outcome]]]] = deque()
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
                for one, outcome in zip(task, _result(future), strict=True):
                    if stop_at_first and self._first and one.block > self._block_of_first():
                        self._stopped = 'after the first block with a violation'
                        return
                    self._note(one, outcome)
                if self.over():
                    self._stopped = f'time limit of {self._limit:g} s'
                    return
        finally:
            for _, future in waiting:
                future.cancel()

    def _tasks(self) -> Iterator[list[_Numbered]]:
        """Yield the trials in groups, without repetitions."""
        task: list[_Numbered] = []
        for one in self._numbered():
            task.append(one)
            if len(task) == TASK:
                yield task
                task = []
        if task:
            yield task

    def _numbered(self) -> Iterator[_Numbered]:
        seen: set[str] = set()
        block = number = 0
        while True:
            before = number
            for trial in generate(self._strategy, self._seed, block, BLOCK):
                key = key_of(trial)
                if key in seen:
                    continue
                seen.add(key)
                yield _Numbered(number=number, block=block, key=key, trial=trial)
                number += 1
                if number == self._wanted:
                    return
            if number == before:
                self._stopped = f'there are no more than {number} different worlds'
                return
            block += 1

    def _note(self, one: _Numbered, outcome: Outcome) -> None:
        """Count an outcome, and keep the first of each violation."""
        self._worlds += 1
        self._faults += len(one.trial.faults)
        self._checks += outcome.checks
        self._simulated += outcome.seconds
        if outcome.complaint:
            if not one.trial.faults:
                raise ExplorationError(f'in a world without faults: {outcome.complaint}')
            self._complaints[outcome.complaint] += 1
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
        fails = _Fails(self, first, violation, shrink_worlds)
        smallest = shrink(self._strategy, self._seed, first.block, BLOCK, fails)
        again = [self._run(smallest, violation.index, digest=True) for _ in range(2)]
        violations = [outcome.of(key) for outcome in again]
        same = violations[0] is not None and (again[0].digest, violations[0]) == (
            again[1].digest,
            violations[1],
        )
        return Finding(
            violation=violations[0] or violations[1] or fails.violation,
            trial=smallest,
            setting=self._setting,
            count=self._counts[key],
            first_world=first.number,
            first_trial=first.trial,
            shrink_worlds=fails.worlds,
            complete=not fails.stopped,
            deterministic=same,
            digest=again[0].digest,
        )

    def known(self, block: int) -> dict[str, Outcome]:
        """Return the outcomes of a block."""
        return self._known.get(block, {})

    def over(self) -> bool:
        """Return whether the time limit is reached."""
        return time.monotonic() >= self._end

    def _run(self, trial: Trial, index: int, *, digest: bool = False) -> Outcome:
        data = packed(self._setting, [trial], only=index, digest=digest)
        (outcome,) = _result(self._executor.submit(run_worlds, data))
        return outcome

    def run_one(self, trial: Trial, index: int) -> Outcome:
        """Run a world with one property."""
        return self._run(trial, index)

    def _not_shrunk(self, findings: list[Finding], output: Path | None) -> list[Finding]:
        """Return what was found, but not shrunk before Ctrl-C."""
        done = {finding.violation.key for finding in findings}
        rest: list[Finding] = []
        for key, (first, violation) in self._first.items():
            if key in done:
                continue
            finding = Finding(
                violation=violation,
                trial=first.trial,
                setting=self._setting,
                count=self._counts[key],
                first_world=first.number,
                first_trial=first.trial,
                complete=False,
            )
            if output is not None:
                finding = write_finding(
                    finding, output, [*findings, *rest], seed=self._seed, record_it=False
                )
            rest.append(finding)
        return rest


class _Fails:
    """Whether a trial fails, from the known outcomes or by running it."""

    def __init__(self, search: _Search, first: _Numbered, violation: Violation, worlds: int) -> None:
        self._search, self._limit = search, worlds
        self._index, self._key = violation.index, violation.key
        self.violation = violation
        """The violation of the last trial that failed."""
        self.worlds = 0
        """Number of worlds that were run."""
        self.stopped = False
        """Whether a limit was reached."""
        self._begun = False
        self._first = first.key
        self._failing: dict[str, bool] = {
            key: self._of(outcome) is not None for key, outcome in search.known(first.block).items()
        }

    def _of(self, outcome: Outcome) -> Violation | None:
        return outcome.of(self._key)

    def __call__(self, trial: Trial) -> bool:
        key = key_of(trial)
        if not self._begun:
            # The trials before the first that failed. Others of them were run in an earlier block.
            self._begun = key == self._first
            return self._begun
        if key not in self._failing:
            if self.worlds >= self._limit or self._search.over():
                self.stopped = True
                raise StopShrinking
            self.worlds += 1
            outcome = self._search.run_one(trial, self._index)
            found = self._of(outcome)
            self._failing[key] = found is not None
            self.violation = found or self.violation
        return self._failing[key]


def key_of(trial: Trial) -> str:
    """Return what identifies a trial."""
    source = Source()
    return source.expression((trial.case, trial.faults, trial.seed))


def _result(future: Future[list[Outcome]]) -> list[Outcome]:
    """Return the result of a task.

    Raises:
        ExplorationError: The executor failed, or a fault or a property is invalid.
    """
    try:
        return future.result()
    except ExplorationError:
        raise
    except Exception as error:
        raise ExplorationError(f'a world could not be run: {type(error).__name__}: {error}') from error


def _checked_properties(properties: Any) -> tuple[Property, ...]:
    if isinstance(properties, Property):
        raise ExplorationError(f'properties must be a list: [{properties!r}]')
    for one in properties:
        if not isinstance(one, Property):
            hint = '; create one: ' + one.__name__ + '(...)' if isinstance(one, type) else ''
            raise ExplorationError(f'properties must be instances of Property, got {one!r}{hint}')
    keys = Counter(map(repr, properties))
    if twice := [key for key, count in keys.items() if count > 1]:
        raise ExplorationError(f'each property can be given once, got {twice[0]} again')
    for one in properties:
        # A test will contain it.
        Source().expression(one)
    return tuple(properties)


def _check_number(name: str, value: object, least: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ExplorationError(f'{name} must be an integer of at least {least}, got {value!r}')


def _case_strategy(
    cases: Mapping[str, st.SearchStrategy[Any]] | st.SearchStrategy[Any] | None,
) -> st.SearchStrategy[Any]:
    if cases is None:
        return st.none()
    if isinstance(cases, st.SearchStrategy):
        return cases
    if isinstance(cases, Mapping) and all(isinstance(one, st.SearchStrategy) for one in cases.values()):
        return st.fixed_dictionaries(dict(cases))
    raise ExplorationError(
        'cases must be strategies of Hypothesis by name, such as '
        f"{{'start': poses()}}, or one strategy; got {cases!r}"
    )


def _fault_strategy(faults: st.SearchStrategy[Any] | None) -> st.SearchStrategy[Any]:
    if faults is None:
        return st.just(())
    if isinstance(faults, st.SearchStrategy):
        return faults
    raise ExplorationError(
        "faults must be a strategy of lists of faults, such as fault_schedules(['odom']); "
        f'got {faults!r}'
    )
