"""Generating trials and shrinking them, which Hypothesis does.

The trials of a block depend on its seed alone. Hypothesis would also try constants that it finds in the
modules of the running program, so that the same seed would give other trials in another program. This is
switched off here.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.exploration.errors import ExplorationError
from diffdrive_jacobian.exploration.trial import Trial

try:
    import hypothesis
    from hypothesis import HealthCheck, Phase, Verbosity, settings, strategies
    from hypothesis.errors import HypothesisDeprecationWarning, HypothesisException
except ModuleNotFoundError as missing:
    if missing.name != 'hypothesis':
        raise
    raise ExplorationError(
        "explore and its strategies need hypothesis: pip install 'diffdrive_jacobian[explore]'"
    ) from missing

st = strategies
MAX_SEED = 2**32 - 1


def trials(cases: st.SearchStrategy[Any], faults: st.SearchStrategy[Any]) -> st.SearchStrategy[Trial]:
    """Return a strategy of trials.

    The faults are drawn first, so that a smaller case has fewer of them, and then simpler ones.
    """

    @st.composite
    def draw_trial(draw: st.DrawFn) -> Trial:
        schedule = _schedule(draw(faults))
        case = draw(cases)
        # Without faults the seed has no effect.
        seed = draw(st.integers(0, MAX_SEED)) if schedule else 0
        return Trial(case=case, faults=schedule, seed=seed)

    return draw_trial()


def _schedule(drawn: Any) -> tuple[Any, ...]:
    if not isinstance(drawn, (list, tuple)):
        raise ExplorationError(f'faults must be a strategy of lists of faults; it gave {drawn!r}')
    return tuple(drawn)


def generate(strategy: st.SearchStrategy[Trial], seed: int, block: int, count: int) -> list[Trial]:
    """Return up to `count` different trials of a block.

    Raises:
        ExplorationError: Hypothesis cannot draw from the strategy.
    """
    found: list[Trial] = []
    _run(strategy, seed, block, count, [Phase.generate], found.append)
    return found


def shrink(
    strategy: st.SearchStrategy[Trial],
    seed: int,
    block: int,
    count: int,
    fails: Callable[[Trial], bool],
) -> Trial:
    """Return the smallest trial that fails among those that Hypothesis tries.

    Args:
        strategy: As for `generate`, as the next three, which gave a trial that fails.
        seed: Seed of the exploration.
        block: Number of the block.
        count: Size of the block.
        fails: Returns whether a trial fails. It must return the same for equal trials. It may raise
            StopShrinking. Other exceptions end the search, too, and are raised.

    Raises:
        ExplorationError: No trial of the block fails.
    """
    smallest: list[Trial] = []
    errors: list[Exception] = []

    def check(trial: Trial) -> None:
        try:
            failed = fails(trial)
        except Exception as error:
            # Hypothesis would take it for a failure, run the trial again, and report what differs.
            errors.append(error)
            raise StopShrinking from error
        if failed:
            smallest[:] = [trial]
            raise _TrialFailedError

    try:
        _run(strategy, seed, block, count, [Phase.generate, Phase.shrink], check)
    except (_TrialFailedError, StopShrinking):
        if errors:
            raise errors[0] from None
        # Hypothesis ends with the smallest one.
        if smallest:
            return smallest[0]
    raise ExplorationError(f'no trial of block {block} failed again')


class StopShrinking(BaseException):
    """Ends shrinking. Not an Exception, which Hypothesis would take for a failure."""


class _TrialFailedError(DiffdriveError):
    """A trial fails."""


def _run(
    strategy: st.SearchStrategy[Trial],
    seed: int,
    block: int,
    count: int,
    phases: list[Phase],
    use: Callable[[Trial], object],
) -> None:
    @hypothesis.seed(_number(seed, block))
    @settings(
        max_examples=count,
        phases=phases,
        database=None,
        deadline=None,
        derandomize=False,
        report_multiple_bugs=False,
        print_blob=False,
        verbosity=Verbosity.quiet,
        suppress_health_check=list(HealthCheck),
    )
    @hypothesis.given(strategy)
    def test(trial: Trial) -> None:
        use(trial)

    with warnings.catch_warnings(), _own_constants_only():
        # Hypothesis takes random numbers of other threads, as of Dask's, for such of the strategy.
        warnings.filterwarnings('ignore', 'Do not use the `random` module', HypothesisDeprecationWarning)
        try:
            test()
        except HypothesisException as error:
            raise ExplorationError(f'Hypothesis cannot generate worlds: {error}') from error


def _number(seed: int, block: int) -> int:
    """Return the seed of a block."""
    return int.from_bytes(hashlib.sha256(f'{seed} {block}'.encode()).digest()[:8], 'big')


@contextmanager
def _own_constants_only() -> Iterator[None]:
    """Stop Hypothesis from using constants of the running program. Versions before 6.131 do not."""
    try:
        from hypothesis.internal.conjecture import providers
    except ImportError:
        yield
        return
    internals: Any = providers
    collect = getattr(internals, '_get_local_constants', None)
    make = getattr(internals, 'Constants', None)
    cache = getattr(getattr(internals, 'CONSTANTS_CACHE', None), 'cache', None)
    if collect is None or make is None or cache is None:
        yield
        return
    none = make()
    internals._get_local_constants = lambda: none
    cache.clear()
    try:
        yield
    finally:
        internals._get_local_constants = collect
        cache.clear()
