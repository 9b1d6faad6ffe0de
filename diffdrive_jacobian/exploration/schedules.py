"""Hypothesis strategies of fault schedules.

The first kinds, topics and nodes are the simplest, so put the usual suspects first. A smaller schedule
has fewer faults. Then they become certain (probability 1), short and early, at whole seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from diffdrive_jacobian import faults
from diffdrive_jacobian.exploration.generation import st
from diffdrive_jacobian.exploration.strategies import STEP, numbers, probabilities, times
from diffdrive_jacobian.faults import Fault
from diffdrive_jacobian.numerics.fields import between, integer
from diffdrive_jacobian.numerics.fields import names as check_names

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
WHEELS = ('left', 'right')
NUMBER_CHANGES = ('nan', 'inf', '-inf', 'negate', 'subnormal')
"""What happens to a number of a corrupted message."""
RATES = (1.0, 2.0, 5.0, 10.0, 20.0, 0.5)
"""Rates that are tried (Hz)."""


def _positive(longest: float) -> st.SearchStrategy[float]:
    return numbers(STEP, longest)


def _or_zero(longest: float) -> st.SearchStrategy[float]:
    return st.one_of(st.just(0.0), _positive(longest))


TOPIC_KINDS: dict[type[Fault], Callable[[], Fields]] = {
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
}
"""Kinds of faults of topics, and strategies of their fields besides topic, start and duration."""
NODE_KINDS: dict[type[Fault], Callable[[], Fields]] = {
    faults.Hang: dict,
    faults.Kill: dict,
    faults.Slow: lambda: {'seconds': st.sampled_from(SHORT)},
    faults.TimerJitter: lambda: {'seconds': st.sampled_from(SHORT)},
}
"""Kinds of faults of nodes."""
SERVICE_KINDS: dict[type[Fault], Callable[[], Fields]] = {
    faults.LateService: lambda: {'seconds': st.one_of(_positive(5.0), st.just(math.inf))},
}
"""Kinds of faults of services."""
ROBOT_KINDS: dict[type[Fault], Callable[[], Fields]] = {
    faults.Push: lambda: {
        'noticed': st.booleans(),
        'dtheta': numbers(-3.0, 3.0),
        'dy': numbers(-1.0, 1.0),
        'dx': numbers(-1.0, 1.0),
    },
    faults.DeadWheel: lambda: {'wheel': st.sampled_from(WHEELS)},
    faults.SaturatedWheel: lambda: {
        'wheel': st.sampled_from(WHEELS),
        'max_velocity': numbers(0.1, 10.0),
    },
    faults.ActuatorLag: lambda: {'seconds': st.sampled_from(SHORT)},
    faults.EncoderSteps: lambda: {'per_revolution': st.sampled_from((16, 64, 256, 1024))},
    faults.Slip: dict,
    faults.WrongGeometry: lambda: dict.fromkeys(
        (
            'left_wheel_radius_multiplier',
            'right_wheel_radius_multiplier',
            'wheel_separation_multiplier',
        ),
        st.sampled_from((1.0, 1.1, 0.9, 1.5, 0.5)),
    ),
}
"""Kinds of faults of a `VirtualRobot`."""
WORLD_KINDS: dict[type[Fault], Callable[[], Fields]] = {
    faults.ClockPause: dict,
    faults.TimeJump: lambda: {'seconds': st.one_of(_positive(10.0), numbers(-10.0, -STEP))},
}
"""Kinds of faults of the clock."""


def fault_schedules(
    topics: Sequence[str] = (),
    nodes: Sequence[str] = (),
    kinds: Sequence[Kind] | None = None,
    max_faults: int = 3,
    duration: float = 10.0,
    *,
    services: Sequence[str] = (),
    robots: Sequence[str] = (),
    fields: Mapping[str, Sequence[str]] | None = None,
    clock: bool = False,
    endless: bool = False,
) -> st.SearchStrategy[list[Fault]]:
    """Return a strategy of lists of faults, for `explore(faults=...)`.

    Args:
        topics: Topics whose messages may be lost, late, repeated, ...
        nodes: Names of nodes that may be killed, frozen, slow, ...
        kinds: Kinds of faults, such as `[faults.Loss, faults.Delay]`, and strategies of faults. None:
            all kinds of the given topics, nodes, services and robots.
        max_faults: Largest number of faults.
        duration: Time at which all faults have ended (s). They begin and end in steps of 0.1 s.
        services: Services that may respond late or never.
        robots: Names of virtual robots whose wheels, motors and encoders may fail, such as
            `['virtual_robot']`.
        fields: Fields of messages that may be corrupted, by topic: `{'odom': ['pose.pose.position.x',
            'header.stamp', 'header.frame_id']}`. A number becomes NaN, infinite, ...,
            a stamp is shifted, a frame_id replaced. Other fields are taken for numbers.
        clock: Whether the clock may also jump and stand still, if `kinds` is None.
        endless: Whether faults may also last until the end of the run.

    Raises:
        ValueError: An argument is invalid; the message says which, and what is allowed.
    """
    if fields is not None and not isinstance(fields, Mapping):
        raise ValueError(
            "fields must be a dict of lists by topic, such as {'odom': ['pose.pose.position.x']}; "
            f'got {fields!r}'
        )
    for name, value in (
        ('topics', topics),
        ('nodes', nodes),
        ('services', services),
        ('robots', robots),
        *(fields or {}).items(),
    ):
        check_names(name, value)
    integer('max_faults', max_faults, 1)
    between(STEP, unit='s')('duration', duration)
    targets = (
        (TOPIC_KINDS, 'topic', topics),
        (NODE_KINDS, 'node', nodes),
        (SERVICE_KINDS, 'service', services),
        (ROBOT_KINDS, 'robot', robots),
        (WORLD_KINDS, '', ()),
    )
    if kinds is None:
        kinds = [kind for known, _, names in targets if names for kind in known]
        kinds += WORLD_KINDS if clock else ()
        if not kinds and not fields:
            raise ValueError('fault_schedules needs topics, nodes, services, robots, fields or kinds')
    strategies = []
    for kind in kinds:
        if isinstance(kind, st.SearchStrategy):
            strategies.append(kind)
            continue
        found = [(known[kind], field, names) for known, field, names in targets if kind in known]
        if not found:
            known_names = ', '.join(one.__name__ for known, _, _ in targets for one in known)
            got = getattr(kind, '__name__', repr(kind))
            raise ValueError(f'kinds must be among {known_names}, or strategies of faults; got {got}')
        own_fields, field, names = found[0]
        if field and not names:
            raise ValueError(f'{kind.__name__} needs {field}s')
        target: Fields = {field: _one_of(names)} if field else {}
        strategies.append(_of_kind(kind, {**target, **own_fields()}, duration, endless))
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
