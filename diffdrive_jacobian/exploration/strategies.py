"""Hypothesis strategies of poses, goals, waypoints, gains and fault schedules.

Their values are on decimal grids, and become simpler as they shrink: zero, then integers, then tenths.
The finest digit is drawn first, because Hypothesis minimizes what is drawn first. Values are plain
tuples and numbers, so that a test can contain them.
"""

from __future__ import annotations

import math

from diffdrive_jacobian.exploration.generation import st
from diffdrive_jacobian.numerics.fields import integer

Pose = tuple[float, float, float]
Point = tuple[float, float]

STEP = 0.1
"""Grid of times (s)."""
ANGLES = (math.pi / 2, math.pi, -math.pi / 2, -math.pi, 3.14, -3.14, math.pi / 4, -math.pi / 4)
"""Angles that are tried besides those of the grid (rad)."""


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


def angles() -> st.SearchStrategy[float]:
    """Return a strategy of angles from -pi to pi (rad), in steps of 0.1, and the ends."""
    return st.one_of(numbers(-3.1, 3.1), st.sampled_from(ANGLES))


def points(extent: float = 5.0) -> st.SearchStrategy[Point]:
    """Return a strategy of positions `(x, y)` with coordinates up to `extent` (m), in steps of 0.1."""
    return st.tuples(numbers(-extent, extent), numbers(-extent, extent))


def poses(extent: float = 5.0) -> st.SearchStrategy[Pose]:
    """Return a strategy of poses `(x, y, theta)` (m, m, rad) with coordinates up to `extent`."""
    return st.tuples(numbers(-extent, extent), numbers(-extent, extent), angles())


def goals(extent: float = 5.0) -> st.SearchStrategy[Pose]:
    """Return a strategy of goals `(x, y, theta)` (m, m, rad); the simplest is one metre ahead."""
    return st.one_of(st.just((1.0, 0.0, 0.0)), poses(extent))


def waypoints(
    extent: float = 5.0, *, min_size: int = 1, max_size: int = 5
) -> st.SearchStrategy[list[Pose]]:
    """Return a strategy of lists of goals."""
    return st.lists(goals(extent), min_size=min_size, max_size=max_size)


def gains(low: float = 0.2, high: float = 5.0) -> st.SearchStrategy[float]:
    """Return a strategy of positive gains: 1, 2, 5, 10, 0.5, ... and tenths in between.

    Raises:
        ValueError: `low` and `high` are not positive, or enclose no such gain.
    """
    if not 0.0 < low <= high < math.inf:
        raise ValueError(f'low and high must be positive and low <= high, got {low!r} and {high!r}')
    series = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
    simple = [gain for gain in series if low <= gain <= high]
    options = [st.sampled_from(simple)] if simple else []
    if math.ceil(low * 10.0 - 1e-9) <= math.floor(high * 10.0 + 1e-9):
        options.append(numbers(low, high))
    if not options:
        raise ValueError(f'no gain of 1, 2, 5, 10, ... or of tenths is between {low!r} and {high!r}')
    return st.one_of(options)


PROBABILITIES = (1.0, 0.5, *(round(0.05 * n, 2) for n in range(1, 20) if n != 10))
"""Probabilities in steps of 0.05. The simplest needs no random number."""


def probabilities() -> st.SearchStrategy[float]:
    """Return a strategy of probabilities in steps of 0.05; the simplest is 1, then 0.5."""
    return st.sampled_from(PROBABILITIES)
