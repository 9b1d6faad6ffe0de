"""The function `explore`, and the checks of its arguments."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from diffdrive_jacobian.exploration import child
from diffdrive_jacobian.exploration.executors import LocalExecutor
from diffdrive_jacobian.exploration.output import check_output, remove_others
from diffdrive_jacobian.exploration.result import Exploration
from diffdrive_jacobian.exploration.scenario import ExplorationError, Scenario, ScenarioName, Source
from diffdrive_jacobian.exploration.schedules import st, trials
from diffdrive_jacobian.exploration.search import Search
from diffdrive_jacobian.exploration.trial import Setting
from diffdrive_jacobian.numerics.checks import number, positive_or_infinite
from diffdrive_jacobian.numerics.fields import integer
from diffdrive_jacobian.properties import Property
from diffdrive_jacobian.signals import one_interrupt


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
    if child.serving:
        raise ExplorationError(
            'explore was called by the module of the scenario when a process imported it: call it under '
            "if __name__ == '__main__':"
        )
    setting = Setting(
        scenario=ScenarioName.of(scenario), properties=_checked_properties(properties), args=tuple(args)
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
    strategy = trials(_case_strategy(cases), _fault_strategy(faults))
    if executor is not None and not callable(getattr(executor, 'submit', None)):
        raise ExplorationError(
            f'executor must be an Executor of concurrent.futures, got {type(executor).__name__}'
        )
    used = LocalExecutor() if executor is None else executor
    complete = False
    with one_interrupt():
        try:
            search = Search(setting, strategy, seed, worlds, used, time_limit)
            result = search.run(stop_at_first, shrink_worlds, folder)
            complete = not result.stopped
            if folder is not None and result.stopped != 'interrupted':
                remove_others(folder, result.findings)
            return result
        finally:
            if executor is None:
                used.shutdown(wait=True, cancel_futures=not complete)


def _checked_properties(properties: Any) -> tuple[Property, ...]:
    if isinstance(properties, Property):
        raise ExplorationError(f'properties must be a list: [{properties!r}]')
    if not isinstance(properties, Iterable):
        raise ExplorationError(f'properties must be a list, got {properties!r}')
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
