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

"""Hypothesis strategies of poses, goals and gains."""

from __future__ import annotations

import math

from diffdrive_jacobian.exploration.schedules import numbers, st

Pose = tuple[float, float, float]
Point = tuple[float, float]

ANGLES = (math.pi / 2, math.pi, -math.pi / 2, -math.pi, 3.14, -3.14, math.pi / 4, -math.pi / 4)
"""Angles that are tried besides those of the grid (rad)."""


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
