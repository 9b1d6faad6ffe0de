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

"""Hypothesis strategies of fault schedules, and the trials that Hypothesis generates and shrinks.

The first kinds, topics and nodes are the simplest, so put the usual suspects first. A smaller schedule
has fewer faults. Then they become certain (probability 1), short and early, at whole seconds.

The trials of a block depend on its seed alone. Hypothesis would also try constants that it finds in the
modules of the running program, so that the same seed would give other trials in another program. This is
switched off here.
"""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from diffdrive_jacobian import faults
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.exploration import extensions
from diffdrive_jacobian.exploration.extensions import FAULT_KINDS
from diffdrive_jacobian.exploration.scenario import ExplorationError
from diffdrive_jacobian.exploration.trial import Trial
from diffdrive_jacobian.faults import Fault
from diffdrive_jacobian.numerics.checks import between, integer
from diffdrive_jacobian.numerics.checks import names as check_names

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
        schedule = draw(faults)
        if not isinstance(schedule, (list, tuple)):
            raise ExplorationError(f'faults must be a strategy of lists of faults; it gave {schedule!r}')
        case = draw(cases)
        # Without faults the seed has no effect.
        seed = draw(st.integers(0, MAX_SEED)) if schedule else 0
        return Trial(case=case, faults=tuple(schedule), seed=seed)

    return draw_trial()


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

    `generate` with the same arguments gave a trial that fails. `fails` must return the same for equal
    trials. It may raise StopShrinking. Other exceptions end the search, too, and are raised.

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
    number = hashlib.sha256(f'{seed} {block}'.encode()).digest()[:8]

    @hypothesis.seed(int.from_bytes(number, 'big'))
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


@contextmanager
def _own_constants_only() -> Iterator[None]:
    """Stop Hypothesis from using constants of the running program. Versions before 6.131 do not."""
    try:
        from hypothesis.internal.conjecture import providers

        internals: Any = providers
        collect, none = internals._get_local_constants, internals.Constants()
        cache = internals.CONSTANTS_CACHE.cache
    except (ImportError, AttributeError):
        yield
        return
    internals._get_local_constants = lambda: none
    cache.clear()
    try:
        yield
    finally:
        internals._get_local_constants = collect
        cache.clear()


STEP = 0.1
"""Grid of times (s)."""


def numbers(low: float, high: float, *, decimals: int = 1) -> st.SearchStrategy[float]:
    """Return a strategy of numbers on a decimal grid. They shrink to 0, or to the end next to it.

    Args:
        low: Smallest number.
        high: Largest number.
        decimals: Number of decimals, 0 to 3.

    Raises:
        ValueError: An argument is invalid, or no number of the grid is between `low` and `high`.
    """
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ValueError(f'low and high must be finite and low <= high, got {low!r} and {high!r}')
    integer('decimals', decimals, 0, 3)
    scale = 10**decimals
    first, last = math.ceil(low * scale - 1e-9), math.floor(high * scale + 1e-9)
    if first > last:
        raise ValueError(f'no number with {decimals} decimals is between {low!r} and {high!r}')
    # The part after the point is drawn first: 0 is simpler than a half, and that than the others.
    parts = sorted(range(scale), key=lambda part: (part != 0, part * 2 != scale, part))
    below, above = first // scale, last // scale

    def number(part: int, whole: int) -> float:
        return float(min(max(whole * scale + part, first), last) / scale)

    fraction = st.sampled_from(parts) if any(parts) and first < last else st.just(0)
    return st.builds(number, fraction, st.integers(below, above))


def times(last: float) -> st.SearchStrategy[float]:
    """Return a strategy of times from 0 to `last` (s), in steps of 0.1 s; whole seconds are simpler."""
    return numbers(0.0, last, decimals=1)


PROBABILITIES = (1.0, 0.5, *(round(0.05 * n, 2) for n in range(1, 20) if n != 10))
"""Probabilities in steps of 0.05. The simplest needs no random number."""


def probabilities() -> st.SearchStrategy[float]:
    """Return a strategy of probabilities in steps of 0.05; the simplest is 1, then 0.5."""
    return st.sampled_from(PROBABILITIES)


Fields = dict[str, st.SearchStrategy[Any]]
Kind = type[Fault] | st.SearchStrategy[Fault]

LONGEST = 2.0
"""Longest delay of a message or a response that is tried (s)."""
CHOICES = 3
"""Least number of choices of a fault besides start and duration: as many as `Loss` has.

Hypothesis prefers values of fewer choices, so otherwise a loss would shrink to a fault of another kind.
"""
SHORT = (0.1, 0.5, 0.2, 0.05, 0.02, 0.01)
"""Durations of callbacks and of jitter that are tried (s)."""
NUMBER_CHANGES = ('nan', 'inf', '-inf', 'negate', 'subnormal')
"""What happens to a number of a corrupted message."""
RATES = (1.0, 2.0, 5.0, 10.0, 20.0, 0.5)
"""Rates that are tried (Hz)."""


def _positive(longest: float) -> st.SearchStrategy[float]:
    return numbers(STEP, longest)


def _or_zero(longest: float) -> st.SearchStrategy[float]:
    return st.one_of(st.just(0.0), _positive(longest))


Kinds = dict[type[Fault], Callable[[], Fields]]

KINDS: dict[str, Kinds] = {
    'topic': {
        faults.Loss: lambda: {
            'probability': probabilities(),
            'burst': st.sampled_from((1, 2, 5, 10)),
        },
        faults.Delay: lambda: {
            'spread': _or_zero(1.0),
            'growth': st.sampled_from((0.0, 0.1, 0.5)),
            'seconds': _positive(LONGEST),
        },
        faults.Stale: dict,
        faults.Duplicate: lambda: {
            'probability': probabilities(),
            'copies': st.integers(1, 3),
            'seconds': _or_zero(LONGEST),
        },
        faults.Reorder: lambda: {'probability': probabilities(), 'seconds': _positive(LONGEST)},
        faults.RateLimit: lambda: {'rate': st.sampled_from(RATES)},
    },
    'node': {
        faults.Hang: dict,
        faults.Kill: dict,
        faults.Slow: lambda: {'seconds': st.sampled_from(SHORT)},
        faults.TimerJitter: lambda: {'seconds': st.sampled_from(SHORT)},
    },
    'service': {
        faults.LateService: lambda: {'seconds': st.one_of(_positive(5.0), st.just(math.inf))},
    },
    'clock': {
        faults.ClockPause: dict,
        faults.TimeJump: lambda: {'seconds': st.one_of(_positive(10.0), numbers(-10.0, -STEP))},
    },
}
"""By what they affect: the kinds of faults, and strategies of their fields besides the name of that,
start and duration."""


def fault_schedules(
    topics: Sequence[str] = (),
    nodes: Sequence[str] = (),
    kinds: Sequence[Kind] | None = None,
    max_faults: int = 3,
    duration: float = 10.0,
    *,
    services: Sequence[str] = (),
    fields: Mapping[str, Sequence[str]] | None = None,
    clock: bool = False,
    endless: bool = False,
    **others: Sequence[str],
) -> st.SearchStrategy[list[Fault]]:
    """Return a strategy of lists of faults, for `explore(faults=...)`.

    Args:
        topics: Topics whose messages may be lost, late, repeated, ...
        nodes: Names of nodes that may be killed, frozen, slow, ...
        kinds: Kinds of faults, such as `[faults.Loss, faults.Delay]`, and strategies of faults. None:
            all kinds of the given topics, nodes, services and others.
        max_faults: Largest number of faults.
        duration: Time at which all faults have ended (s). They begin and end in steps of 0.1 s.
        services: Services that may respond late or never.
        fields: Fields of messages that may be corrupted, by topic: `{'odom': ['pose.pose.position.x',
            'header.stamp', 'header.frame_id']}`. A number becomes NaN, infinite, ...,
            a stamp is shifted, a frame_id replaced. Other fields are taken for numbers.
        clock: Whether the clock may also jump and stand still, if `kinds` is None.
        endless: Whether faults may also last until the end of the run.
        others: Names of what other faults affect, for which an installed distribution has kinds
            (`exploration.extensions`): `robots=['virtual_robot']` for wheels, motors and encoders.

    Raises:
        ValueError: An argument is invalid; the message says which, and what is allowed.
    """
    if fields is not None and not isinstance(fields, Mapping):
        raise ValueError(
            "fields must be a dict of lists by topic, such as {'odom': ['pose.pose.position.x']}; "
            f'got {fields!r}'
        )
    own_kinds = dict(KINDS)
    names = {'topic': topics, 'node': nodes, 'service': services}
    for name, value in others.items():
        target = name.removesuffix('s')
        names[target], own_kinds[target] = value, _kinds_of_others(name)
    for target, value in names.items():
        check_names(f'{target}s', value)
    for topic, paths in (fields or {}).items():
        check_names(topic, paths)
    integer('max_faults', max_faults, 1)
    between(STEP, unit='s')('duration', duration)
    if kinds is None:
        affected = [*(target for target in names if names[target]), *(['clock'] if clock else [])]
        kinds = [kind for target in affected for kind in own_kinds[target]]
        if not kinds and not fields:
            raise ValueError(f'fault_schedules needs {", ".join(_arguments())}, fields or kinds')
    strategies = []
    for kind in kinds:
        if isinstance(kind, st.SearchStrategy):
            strategies.append(kind)
            continue
        target = next((target for target, known in own_kinds.items() if kind in known), '')
        if not target:
            raise ValueError(_no_kind(kind, own_kinds))
        own = {}
        if target in names:
            if not names[target]:
                raise ValueError(f'{kind.__name__} needs {target}s')
            own = {target: _one_of(names[target])}
        strategies.append(_of_kind(kind, {**own, **own_kinds[target][kind]()}, duration, endless))
    for topic, paths in (fields or {}).items():
        for path in paths:
            strategies.append(_of_kind(faults.Corrupt, _corruption(topic, path), duration, endless))
    fault = st.one_of(strategies)

    @st.composite
    def draw_schedule(draw: st.DrawFn) -> list[Fault]:
        # Hypothesis lowers a number that is drawn first, and removes any one of the faults with it. From
        # a list of `st.lists` it could not remove values of so many choices, except the last ones.
        return [draw(fault) for _ in range(draw(st.integers(0, max_faults)))]

    return draw_schedule()


def _arguments() -> list[str]:
    """Return the names of the arguments with names of what faults affect."""
    others = [one for one in extensions.names(FAULT_KINDS) if one not in KINDS]
    return [f'{one}s' for one in ('topic', 'node', 'service', *others)]


def _kinds_of_others(name: str) -> Kinds:
    """Return the kinds of faults that a distribution has for names given as an argument: 'robots'.

    Raises:
        ValueError: There is no such distribution.
    """
    if name not in _arguments():
        raise ValueError(
            f'fault_schedules has no argument {name!r}, and no installed distribution has faults for it '
            f'(entry points of the group {FAULT_KINDS}); there are {", ".join(_arguments())}'
        )
    target = name.removesuffix('s')
    kinds: Kinds = extensions.load(FAULT_KINDS, target)
    valid = isinstance(kinds, Mapping) and all(
        isinstance(kind, type) and issubclass(kind, Fault) and callable(fields)
        for kind, fields in kinds.items()
    )
    if not valid:
        raise ExplorationError(
            f'the entry point {target} of {FAULT_KINDS} must be a dict of classes of faults with '
            f'functions that return strategies of their fields, got {kinds!r:.200}'
        )
    return kinds


def _no_kind(kind: Any, own_kinds: Mapping[str, Kinds]) -> str:
    """Return why something is no kind of faults that can be drawn."""
    for target in extensions.names(FAULT_KINDS):
        with suppress(ExplorationError):
            if target not in own_kinds and kind in _kinds_of_others(f'{target}s'):
                return f'{kind.__name__} needs {target}s'
    known = ', '.join(one.__name__ for kinds in own_kinds.values() for one in kinds)
    got = getattr(kind, '__name__', repr(kind))
    return f'kinds must be among {known}, or strategies of faults; got {got}'


def _corruption(topic: str, path: str) -> Fields:
    """Return strategies of the fields of a `Corrupt` for the field of a message."""
    last = path.split('.')[-1]
    changes: Fields
    if last == 'stamp':
        seconds = st.one_of(numbers(-10.0, -STEP), numbers(STEP, 10.0))
        changes = {'change': st.just('offset'), 'amount': seconds}
    elif last.endswith('frame_id'):
        changes = {'change': st.just('set'), 'amount': st.sampled_from(('other_frame', ''))}
    else:
        changes = {'change': st.sampled_from(NUMBER_CHANGES)}
    given: Fields = {'topic': _one_of([topic]), 'field': st.just(path)}
    return {**given, 'probability': probabilities(), **changes}


def _one_of(names: Sequence[str]) -> st.SearchStrategy[str]:
    """Return a strategy of names that makes a choice also if there is only one."""
    return st.integers(0, len(names) - 1).map(list(names).__getitem__)


def _of_kind(
    kind: type[Fault], fields: Fields, duration: float, endless: bool
) -> st.SearchStrategy[Fault]:
    """Return a strategy of the faults of one kind that have ended at `duration` (s)."""
    last_start = round(duration - STEP, 1)
    starts, lasting = times(last_start), numbers(STEP, duration)
    if endless:
        lasting = st.one_of(lasting, st.just(math.inf))

    @st.composite
    def draw_fault(draw: st.DrawFn) -> Fault:
        # A fault that lasts less long is smaller than one that begins earlier.
        values = {name: draw(strategy) for name, strategy in fields.items()}
        for _ in range(CHOICES - len(fields)):
            draw(st.integers(0, 0))
        length, start = draw(lasting), draw(starts)
        if math.isfinite(length):
            length = round(min(length, duration - start), 1)
        return kind(**values, start=start, duration=length)

    return draw_fault()
