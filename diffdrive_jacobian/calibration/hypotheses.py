"""What may be different between parts of the drives: in kinds of motion, intervals, and recordings.

The drives are divided into cells: windows of time, and kinds of motion. A step between two poses is in
one window and in one kind. A hypothesis is a change of the multipliers in a set of cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.model import Array, Segment
from diffdrive_jacobian.calibration.motion import Geometry

WINDOWS = 40
"""Number of windows of equal distances into which all drives are divided."""
FEWEST = 4
"""Fewest poses for each window of a motion."""
STEADY = 0.4
"""Time over which speeds are means to determine the kind of motion (s)."""
CURVED = 0.1
"""Ratio of the rotation to the translation of the wheels below which a motion is straight; above the
inverse it is a turn in place."""
SLIP, OTHER = 0.2, 0.1
"""Prior probability that a wheel slips in a kind of motion, and that something changes at some time, is
different in an interval, and in a recording each."""
DIFFERENCE, CHANGE = 0.02, 0.005
"""Prior standard deviation of a difference, and of that since some time: wheels slip by percents, and
change with load and pressure by less [-]."""
RARE = 0.01
"""Share of the distance below which a kind of motion is not looked at, nor its complement."""

LEFT, RIGHT, BOTH = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 1.0, 0.0])
TURN = np.array([0.0, 0.0, -1.0])
DIRECTIONS = {
    'the left wheel travels': LEFT,
    'the right wheel travels': RIGHT,
    'both wheels travel': BOTH,
    'the robot turns': TURN,
}
"""What may be more or less in a part, as changes of the logarithms of the multipliers."""
SHAPE, FORWARDS, TO_LEFT = np.unravel_index(np.arange(12), (3, 2, 2))
"""Of the cells of the kinds: straight, in place or arc; backwards or forwards; right or left."""
IN_PLACE, ARCS = 'turns in place', 'drives arcs'
KINDS = {
    IN_PLACE: SHAPE == 1,
    ARCS: SHAPE == 2,
    'turns': SHAPE > 0,
    'turns left': (SHAPE > 0) & (TO_LEFT == 1),
    'turns right': (SHAPE > 0) & (TO_LEFT == 0),
    'drives backwards': (SHAPE != 1) & (FORWARDS == 0),
}
OUTER = np.where((TO_LEFT == FORWARDS)[:, None], RIGHT, LEFT)
"""The faster wheel of an arc in each cell."""


UNKNOWN = 'which is right is unknown. The estimate lies between, and its deviations include both'


@dataclass(frozen=True, kw_only=True, slots=True)
class Interval:
    """A part of a recording."""

    recording: int
    begin: float
    """By the clock of the reference (s)."""
    end: float
    share: float
    """Of the distance of all recordings."""
    whole: bool = False
    """Whether it is all of one of several recordings."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Hypothesis:
    """That something is different in a part of the drives."""

    where: str | Interval
    """A kind of motion, or an interval."""
    what: str
    """What travels or turns."""
    direction: Array
    """Change of the logarithms of the multipliers in each cell, shape (3 * cells,)."""
    own: Array
    """The same of the multipliers themselves, if those of the part are right, shape (3,)."""
    share: float
    """Of the part in the distance of all recordings."""
    spread: float = DIFFERENCE
    """Prior standard deviation of the size of the change."""
    prior: float = 0.0
    """Prior probability."""

    @property
    def of_kind(self) -> bool:
        """Whether it is about a kind of motion."""
        return isinstance(self.where, str)

    def right(self, size: float) -> float:
        """Return the probability that the multipliers of the part are the right ones.

        That is its share of the distance. But wheels that travel less in a kind of motion slip there.
        """
        return 0.0 if self.of_kind and size < 0.0 else self.share

    def words(self, size: float) -> str:
        """Return the difference in words, without the name of the recording."""
        much = f'{self.what} {100.0 * abs(size):.2g} % {"more" if size > 0.0 else "less"} than'
        if isinstance(self.where, str):
            why = 'a wheel slips there, and the multipliers are those without slip'
            return f'where the robot {self.where}, {much} elsewhere: {why if size < 0.0 else UNKNOWN}'
        if self.where.whole:
            return f'{much} in the other recordings'
        return f'from {self.where.begin:.0f} to {self.where.end:.0f} s {much} in the rest'


@dataclass(frozen=True, kw_only=True, slots=True)
class Cells:
    """The drives, divided into windows and kinds of motion."""

    windows: tuple[Interval, ...]
    of_steps: NDArray[np.int_]
    """Window and kind of the steps of all motions, shape (steps, 2). The cells of kinds follow those of
    the windows."""
    travelled: Array
    """Share of the distance in each kind, shape (12,)."""

    @property
    def count(self) -> int:
        """Number of cells."""
        return len(self.windows) + len(SHAPE)


def divided(segments: Sequence[Segment], nominal: Geometry, parameters: Array) -> Cells:
    """Return the cells of the steps of motions. Between two motions there is a step of any cell."""
    paths = []
    for one in segments:
        steps = np.abs(np.diff(one.wheel_angles, axis=0)).sum(axis=1) * nominal.wheel_radius
        path = np.concatenate([[0.0], np.cumsum(steps)])
        paths.append(np.interp(one.at(parameters), one.wheel_time, path))
    total = sum(float(path[-1] - path[0]) for path in paths)
    windows: list[Interval] = []
    rows, travelled = [], np.zeros(len(SHAPE))
    for one, path in zip(segments, paths, strict=True):
        share = float(path[-1] - path[0]) / total
        count = max(1, min(round(WINDOWS * share), len(one.time) // FEWEST))
        bounds = np.linspace(path[0], path[-1], count + 1)
        inside = len(windows) + np.searchsorted(bounds[1:-1], (path[1:] + path[:-1]) / 2.0)
        kinds = _kinds(one, one.at(parameters))
        travelled += np.bincount(kinds, np.diff(path), len(SHAPE)) / total
        windows += [
            Interval(recording=one.recording, begin=begin, end=end, share=share / count)
            for begin, end in pairwise(np.interp(bounds, path, one.time).tolist())
        ]
        rows.append(np.column_stack([np.append(inside, inside[-1]), np.append(kinds, kinds[-1])]))
    of_steps = np.concatenate(rows)[:-1] + np.array([0, len(windows)])
    return Cells(windows=tuple(windows), of_steps=of_steps, travelled=travelled)


def _kinds(segment: Segment, at: Array) -> NDArray[np.int_]:
    """Return the kind of each step, as an index of `SHAPE`."""
    middle = (at[1:] + at[:-1]) / 2.0
    ends = np.stack([middle - STEADY / 2.0, middle + STEADY / 2.0])
    right, left = (
        np.diff(np.interp(ends, segment.wheel_time, segment.wheel_angles[:, side]), axis=0)[0]
        for side in (0, 1)
    )
    forwards, turning = right + left, right - left
    shape = np.where(np.abs(turning) < CURVED * np.abs(forwards), 0, 2)
    shape[np.abs(forwards) < CURVED * np.abs(turning)] = 1
    return np.asarray(np.ravel_multi_index((shape, forwards > 0.0, turning > 0.0), (3, 2, 2)))


def hypotheses(cells: Cells) -> list[Hypothesis]:
    """Return all hypotheses. Those of one sort are equally likely."""
    sorts = (
        (_of_kinds(cells), SLIP),
        (_of_changes(cells), OTHER),
        (_of_intervals(cells), OTHER),
        (_of_recordings(cells), OTHER),
    )
    each = [(list(found), chance) for found, chance in sorts]
    return [replace(one, prior=chance / len(found)) for found, chance in each for one in found]


def _of_kinds(cells: Cells) -> Iterator[Hypothesis]:
    shares = {kind: float(cells.travelled[inside].sum()) for kind, inside in KINDS.items()}
    several = min(shares[IN_PLACE], shares[ARCS]) > RARE
    for kind, share in shares.items():
        if not RARE < share < 1.0 - RARE or (kind == 'turns' and not several):
            continue
        here = len(cells.windows) + np.flatnonzero(KINDS[kind])
        for what, direction in DIRECTIONS.items():
            yield _hypothesis(cells, here, direction, kind, what, direction, share)
        if kind in (ARCS, 'turns'):
            # Where it travels more in arcs, which is right is not a question of one wheel.
            for what, wheels in (('outer', OUTER), ('inner', BOTH - OUTER)):
                outer = wheels[KINDS[kind]]
                yield _hypothesis(
                    cells, here, outer, kind, f'the {what} wheel travels', 0.0 * LEFT, share
                )


def _of_recordings(cells: Cells) -> Iterator[Hypothesis]:
    recordings = np.array([one.recording for one in cells.windows])
    several = np.unique(recordings).tolist()
    for recording in several if len(several) > 1 else []:
        yield from _of_windows(cells, np.flatnonzero(recordings == recording), whole=True)


def _of_changes(cells: Cells) -> Iterator[Hypothesis]:
    """Yield those since some time, until the end of a recording."""
    recordings = np.array([one.recording for one in cells.windows])
    for recording in np.unique(recordings).tolist():
        own = np.flatnonzero(recordings == recording)
        for first in range(1, len(own)):
            for one in _of_windows(cells, own[first:]):
                yield replace(one, spread=CHANGE)


def _of_intervals(cells: Cells) -> Iterator[Hypothesis]:
    """Yield those from the begin of a recording or later to before its end."""
    recordings = np.array([one.recording for one in cells.windows])
    for recording in np.unique(recordings).tolist():
        own = np.flatnonzero(recordings == recording)
        for last in range(1, len(own)):
            for first in range(last):
                yield from _of_windows(cells, own[first:last])


def _of_windows(cells: Cells, here: NDArray[np.intp], *, whole: bool = False) -> Iterator[Hypothesis]:
    chosen = [cells.windows[index] for index in here.tolist()]
    share = sum(one.share for one in chosen)
    interval = replace(chosen[0], end=chosen[-1].end, share=share, whole=whole)
    for what, direction in DIRECTIONS.items():
        yield _hypothesis(cells, here, direction, interval, what, direction, share)


def _hypothesis(
    cells: Cells,
    here: NDArray[np.intp],
    direction: Array,
    where: str | Interval,
    what: str,
    own: Array,
    share: float,
) -> Hypothesis:
    """Return the hypothesis of a change in some cells."""
    changed = np.zeros((cells.count, 3))
    changed[here] = direction
    return Hypothesis(where=where, what=what, direction=changed.ravel(), own=own, share=share, prior=0.0)
