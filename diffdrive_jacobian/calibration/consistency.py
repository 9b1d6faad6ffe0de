"""Whether the multipliers are the same at all times, in each kind of motion, and in each recording.

A score test: windows of time and kinds of motion have multipliers of their own, as further parameters
of the model. Their information and gradient at the estimate show, for any set of windows or kinds, how
much a multiplier differs there from that in the rest. Source: doc/mathematics.md, "Calibration".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.fit import score
from diffdrive_jacobian.calibration.model import (
    MULTIPLIERS,
    TIME_OFFSETS,
    Array,
    Estimate,
    Segment,
    prior_information,
)
from diffdrive_jacobian.calibration.motion import Geometry
from diffdrive_jacobian.calibration.preparation import poses_apart

WINDOWS = 64
"""Number of windows of equal distances into which all drives are divided."""
FEWEST = 4
"""Fewest poses for each window of a motion."""
MOST_POSES = 2000
"""Number of poses that are used at most."""
APART = 20.0
"""Steps of the encoders by which the wheels turn at least between the poses that are used. Between
nearer ones much of their turns is reading error, which the score takes for motion that the reference
lacks."""
CHANCE = 3e-3
"""Bound of the probability of a misfit by chance, among all windows, all kinds, or all recordings. It is
less likely, because the sets overlap."""
SPREAD = 0.02
"""Standard deviation that is expected of a difference [-]. A difference that the data determine less
well counts less: where a robot hardly turns, its turns are those of the steps of the encoders."""
EXCESS = 1.25
"""Ratio of the squares in the median window to those of the model that may be chance."""
STEADY = 1.0
"""Time over which speeds are means to determine the kind of motion (s)."""
CURVED = 0.1
"""Ratio of the rotation to the translation of the wheels below which a motion is straight; above the
inverse it is a turn in place."""
WORDS = ('the left wheel travels', 'the right wheel travels', 'both wheels travel', 'the robot turns')
DIRECTIONS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
"""What may be more in one part than in another, as changes of the logarithms of the multipliers."""
_SHAPE, _FORWARDS, _LEFT = np.unravel_index(np.arange(12), (3, 2, 2))
KINDS = {
    'drives straight': _SHAPE == 0,
    'turns in place': _SHAPE == 1,
    'drives arcs': _SHAPE == 2,
    'turns left': (_SHAPE > 0) & (_LEFT == 1),
    'turns right': (_SHAPE > 0) & (_LEFT == 0),
    'drives backwards': (_SHAPE != 1) & (_FORWARDS == 0),
}
"""Kinds of motion, each as a set of 12 cells: straight, in place or arc; backwards or forwards; right or
left."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Window:
    """A part of a recording."""

    recording: int
    begin: float
    """By the clock of the reference (s)."""
    end: float
    share: float
    """Of the distance of all recordings."""
    whole: bool
    """Whether it is all of one of several recordings."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Misfit:
    """A part of the drives in which a multiplier is another one than in the rest."""

    window: Window | None
    """None: it is a kind of motion."""
    words: str
    """What is different and where, without the name of the recording."""
    difference: float
    """Of the logarithm of the multiplier."""
    deviations: float
    """The same in standard deviations."""
    shifts: Array
    """What must be added to the parameters for those of the rest, and of this part, shape (2, n)."""


def misfit(segments: Sequence[Segment], nominal: Geometry, estimate: Estimate) -> Misfit | None:
    """Return the most certain misfit at the most likely parameters; None: all may be chance."""
    segments, estimate = _thinned(segments, estimate)
    offsets = estimate.parameters[TIME_OFFSETS:]
    windows, members = _windows(segments, nominal, offsets)
    cells = [
        np.column_stack([inside, len(windows) + _kinds(one, offsets[one.recording])])
        for one, inside in zip(segments, members, strict=True)
    ]
    S, g, moves = _local(segments, nominal, estimate, cells, len(windows) + len(_SHAPE))
    sets, limits = _sets(windows, _excess(S, g, len(windows)))
    slopes = DIRECTIONS @ g.T @ sets.T
    along = np.einsum('ki,aibj,kj->kab', DIRECTIONS, S, DIRECTIONS)
    weights = np.sum((sets @ along) * sets, axis=2)
    deviations = np.abs(slopes) / np.sqrt(weights + SPREAD**-2.0)
    which, index = np.unravel_index(np.argmax(deviations / limits), deviations.shape)
    if deviations[which, index] < limits[index]:
        return None
    difference = float(-slopes[which, index] / weights[which, index])
    rest = moves @ DIRECTIONS[which] @ sets[index] * difference
    part = rest.copy()
    part[MULTIPLIERS] += DIRECTIONS[which] * difference
    window = _window(sets[index], windows)
    much = (
        f'{WORDS[which]} {100.0 * abs(difference):.2g} % {"more" if difference > 0.0 else "less"} than'
    )
    if window is None:
        words = f'where the robot {list(KINDS)[index]}, {much} elsewhere'
    elif window.whole:
        words = f'{much} in the other recordings'
    else:
        words = f'from {window.begin:.0f} to {window.end:.0f} s {much} in the rest'
    return Misfit(
        window=window,
        words=words,
        difference=difference,
        deviations=float(deviations[which, index]),
        shifts=np.stack([rest, part]),
    )


def _thinned(segments: Sequence[Segment], estimate: Estimate) -> tuple[list[Segment], Estimate]:
    """Return motions and estimate with at most about `MOST_POSES` poses, `APART` steps apart."""
    every = -(-sum(len(one.time) for one in segments) // MOST_POSES)
    kept = [
        slice(None, None, min(max(every, poses_apart(one, APART)), len(one.time) - 1))
        for one in segments
    ]
    states = tuple(one[here] for one, here in zip(estimate.states, kept, strict=True))
    thinned = [one.part(here) for one, here in zip(segments, kept, strict=True)]
    return thinned, replace(estimate, states=states)


def _local(
    segments: Sequence[Segment],
    nominal: Geometry,
    estimate: Estimate,
    cells: Sequence[NDArray[np.int_]],
    number: int,
) -> tuple[Array, Array, Array]:
    """Return what is known of changes of the logarithms of the multipliers in single cells.

    `cells` are those of each step of each motion, shape (n - 1, any), out of `number`.

    Returns:
        Their information, shape (n, 3, n, 3), their gradient, shape (n, 3), and the changes of the
        parameters with them, shape (number of parameters, n, 3).
    """
    count = len(estimate.parameters)
    columns = [count + 3 * one for one in cells]
    information, gradient = score(segments, nominal, estimate, columns, count + 3 * number)
    free = np.flatnonzero(estimate.free)
    known = information[np.ix_(free, free)] + prior_information(estimate.free)
    cross = information[free, count:]
    gain = np.linalg.solve(known, np.column_stack([cross, gradient[free]]))
    moves = np.zeros((count, number, 3))
    moves[free] = -gain[:, :-1].reshape(-1, number, 3)
    S = information[count:, count:] - cross.T @ gain[:, :-1]
    g = gradient[count:] - cross.T @ gain[:, -1]
    return S.reshape(number, 3, number, 3), g.reshape(number, 3), moves


def _windows(
    segments: Sequence[Segment], nominal: Geometry, offsets: Array
) -> tuple[list[Window], list[NDArray[np.int_]]]:
    """Return all windows in their order, and the window of each step of each motion."""
    paths = []
    for one in segments:
        steps = np.abs(np.diff(one.wheel_angles, axis=0)).sum(axis=1) * nominal.wheel_radius
        path = np.concatenate([[0.0], np.cumsum(steps)])
        paths.append(np.interp(one.time + offsets[one.recording], one.wheel_time, path))
    total = sum(float(path[-1] - path[0]) for path in paths)
    windows: list[Window] = []
    members = []
    for one, path in zip(segments, paths, strict=True):
        share = float(path[-1] - path[0]) / total
        count = max(1, min(round(WINDOWS * share), len(one.time) // FEWEST))
        bounds = np.linspace(path[0], path[-1], count + 1)
        inside = np.searchsorted(bounds[1:-1], (path[1:] + path[:-1]) / 2.0)
        members.append(len(windows) + inside)
        times = np.interp(bounds, path, one.time).tolist()
        windows += [
            Window(recording=one.recording, begin=begin, end=end, share=share / count, whole=False)
            for begin, end in pairwise(times)
        ]
    return windows, members


def _kinds(segment: Segment, offset: float) -> NDArray[np.int_]:
    """Return to which cell of `KINDS` each step belongs."""
    middle = (segment.time[1:] + segment.time[:-1]) / 2.0 + offset
    ends = np.stack([middle - STEADY / 2.0, middle + STEADY / 2.0])
    right, left = (
        np.diff(np.interp(ends, segment.wheel_time, segment.wheel_angles[:, side]), axis=0)[0]
        for side in (0, 1)
    )
    forwards, turning = right + left, right - left
    shape = np.where(np.abs(turning) < CURVED * np.abs(forwards), 0, 2)
    shape[np.abs(forwards) < CURVED * np.abs(turning)] = 1
    return np.asarray(np.ravel_multi_index((shape, forwards > 0.0, turning > 0.0), (3, 2, 2)))


def _excess(S: Array, g: Array, windows: int) -> float:
    """Return how much larger the squares in the median window are than in the model."""
    here = np.arange(windows)
    prior = np.eye(3) / SPREAD**2
    solved = np.linalg.solve(S[here, :, here] + prior, np.dstack([S[here, :, here], g[here, :, None]]))
    squares = np.einsum('ni,ni->n', g[here], solved[:, :, 3])
    freedom = np.trace(solved[:, :, :3], axis1=1, axis2=2)
    # The median of a chi-square distribution of two to three degrees of freedom is 0.75 of its mean.
    excess = float(np.median(squares) / max(np.median(freedom), 1e-9)) / 0.75
    return excess if excess > EXCESS else 1.0


def _sets(windows: Sequence[Window], excess: float) -> tuple[Array, Array]:
    """Return all sets that are compared with the rest: kinds, recordings, consecutive windows.

    Returns:
        Which cells are in each set, shape (n, cells), and the deviations beyond which it differs not by
        chance, shape (n,).
    """
    count = len(windows)
    recordings = np.array([one.recording for one in windows])
    first, last = np.triu_indices(count)
    here = recordings[first] == recordings[last]
    first, last = first[here, None], last[here, None]
    cells = np.arange(count + len(_SHAPE))
    parts = (cells >= first) & (cells <= last)
    kinds = np.pad(list(KINDS.values()), ((0, 0), (count, 0)))
    several = np.unique(recordings)[:, None]
    whole = np.pad(recordings == several, ((0, 0), (0, len(_SHAPE)))) if len(several) > 1 else kinds[:0]
    families = ((kinds, 1.0), (whole, 1.0), (parts, excess**0.5))
    limits = [np.full(len(one), factor * _limit(len(one))) for one, factor in families]
    return np.concatenate([kinds, whole, parts]).astype(np.float64), np.concatenate(limits)


def _window(inside: Array, windows: Sequence[Window]) -> Window | None:
    """Return the part of a recording that consists of some windows; None: there are none."""
    chosen = [one for one, here in zip(windows, inside.tolist(), strict=False) if here]
    if not chosen:
        return None
    every = sum(one.recording == chosen[0].recording for one in windows)
    return replace(
        chosen[0],
        end=chosen[-1].end,
        share=sum(one.share for one in chosen),
        whole=len(chosen) == every < len(windows),
    )


def _limit(tests: int) -> float:
    """Return the deviations that the largest of a number of tests exceeds with the chance `CHANCE`."""
    return NormalDist().inv_cdf(1.0 - CHANCE / (2.0 * len(DIRECTIONS) * max(1, tests)))
