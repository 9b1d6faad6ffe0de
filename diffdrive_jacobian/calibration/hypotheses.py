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

"""What may be different between parts of the drives: in kinds of motion, intervals, and recordings.

The drives are divided into cells: windows of time, and kinds of motion. A step between two poses is in
one window and in one kind. A hypothesis is a change of the multipliers in a part: a set of cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.model import Array, Segment
from diffdrive_jacobian.calibration.motion import Geometry

WINDOWS = 40
"""Number of windows of equal distances into which all drives are divided: 819 intervals."""
FEWEST = 4
"""Fewest poses for each window of a motion."""
STEADY = 0.4
"""Time over which speeds are means to determine the kind of motion (s): less than a turn in place takes,
and more than the periods of wheels and encoders."""
CURVED = 0.1
"""Ratio of the rotation to the translation of the wheels below which a motion is straight; above the
inverse it is a turn in place."""
RARE, LINES = 0.01, 0.1
"""Share of the distance below which a kind of motion is no part, and least share of straight lines in
drives that show slip: without these, a discrepancy of arcs is magnified to multipliers far off."""
SLIP, OTHER = 0.2, 0.1
"""Prior probability that a wheel slips in a kind of motion, and that there is a change since some time,
a different interval, and a different recording each. Assumed: one robot of five slips somewhere. With
half of it, a few more errors exceed four deviations without a note; without it, the deviations of robots
that do not slip would be smaller by a tenth or more."""
DIFFERENCE, CHANGE = 0.02, 0.005
"""Prior standard deviation of a difference, and of a change since some time [-]. Assumed: wheels slip by
percents; load, pressure and temperature change a radius by less."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Change:
    """What may be more or less."""

    words: str
    multipliers: Array
    """Change of the logarithms of the multipliers, shape (3,), or in each kind of motion, (12, 3)."""

    @property
    def own(self) -> Array:
        """The same of the multipliers of a part as a whole, shape (3,); 0: it has not one."""
        return self.multipliers if self.multipliers.ndim == 1 else np.zeros(3)


LEFT, RIGHT, BOTH = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 1.0, 0.0])
CHANGES = (
    Change(words='the left wheel travels', multipliers=LEFT),
    Change(words='the right wheel travels', multipliers=RIGHT),
    Change(words='both wheels travel', multipliers=BOTH),
    Change(words='the robot turns', multipliers=np.array([0.0, 0.0, -1.0])),
)

SHAPES = (3, 2, 2)
"""Kinds of motion: straight, in place or arc; backwards or forwards; right or left."""
SHAPE, FORWARDS, TO_LEFT = np.indices(SHAPES).reshape(3, -1)
IN_PLACE, ARCS, TURNS = 'turns in place', 'drives arcs', 'turns'
KINDS = {
    IN_PLACE: SHAPE == 1,
    ARCS: SHAPE == 2,
    TURNS: SHAPE > 0,
    'turns left': (SHAPE > 0) & (TO_LEFT == 1),
    'turns right': (SHAPE > 0) & (TO_LEFT == 0),
    'drives backwards': (SHAPE != 1) & (FORWARDS == 0),
}
"""Sets of kinds in which wheels may slip. None is the complement of another: in which of two complements
they slip is not in the data."""
OUTER = np.where((TO_LEFT == FORWARDS)[:, None], RIGHT, LEFT)
"""The faster wheel of an arc."""
CHANGES_OF_ARCS = (
    Change(words='the outer wheel travels', multipliers=OUTER),
    Change(words='the inner wheel travels', multipliers=BOTH - OUTER),
)
UNKNOWN = 'which is right is unknown. The estimate lies between, and its deviations include both'


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """A part of the drives: a kind of motion, or consecutive windows of a recording."""

    cells: NDArray[np.intp]
    share: float
    """Of the distance of all recordings."""
    kind: str = ''
    """Name of the kind; '': it consists of windows."""
    recording: int = 0
    begin: float = 0.0
    """By the clock of the reference (s)."""
    end: float = 0.0
    whole: bool = False
    """Whether it is all of one of several recordings."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Hypothesis:
    """That something is more or less in a part of the drives than in the rest."""

    part: Part
    change: Change
    prior: float
    """Prior probability."""
    spread: float
    """Prior standard deviation of the size of the change."""

    def direction(self, cells: int) -> Array:
        """Return the change of the multipliers in each of a number of cells, shape (3 * cells,)."""
        of_kinds = self.change.multipliers.ndim == 2
        here = KINDS[self.part.kind] if of_kinds else ...
        changed = np.zeros((cells, 3))
        changed[self.part.cells] = self.change.multipliers[here]
        return changed.ravel()

    def right(self, size: float) -> float:
        """Return the probability that the multipliers of the part are the right ones.

        That is its share of the distance. But wheels that travel less in a kind of motion slip there.
        """
        return 0.0 if self.part.kind and size < 0.0 else self.part.share

    def words(self, size: float) -> str:
        """Return the difference in words, without the name of the recording."""
        part = self.part
        much = f'{self.change.words} {100.0 * abs(size):.2g} % {"more" if size > 0.0 else "less"} than'
        if part.kind:
            slips = 'a wheel slips there, and the multipliers are those without slip'
            return f'where the robot {part.kind}, {much} elsewhere: {slips if size < 0.0 else UNKNOWN}'
        if part.whole:
            return f'{much} in the other recordings'
        return f'from {part.begin:.0f} to {part.end:.0f} s {much} in the rest'


@dataclass(frozen=True, kw_only=True, slots=True)
class Cells:
    """The drives, divided into windows and kinds of motion."""

    windows: tuple[Part, ...]
    of_steps: NDArray[np.intp]
    """Window and kind of the steps of all motions, shape (steps, 2). The cells of kinds follow those of
    the windows."""
    travelled: Array
    """Share of the distance in each kind, shape (12,)."""

    @property
    def count(self) -> int:
        """Number of cells."""
        return len(self.windows) + len(SHAPE)

    @property
    def lines(self) -> float:
        """Share of the distance on straight lines."""
        return float(self.travelled[SHAPE == 0].sum())


def divided(segments: Sequence[Segment], nominal: Geometry, parameters: Array) -> Cells:
    """Return the cells of the steps of motions. The step from one motion to the next is in any cell."""
    paths = []
    for one in segments:
        steps = np.abs(np.diff(one.wheel_angles, axis=0)).sum(axis=1) * nominal.wheel_radius
        path = np.concatenate([[0.0], np.cumsum(steps)])
        paths.append(np.interp(one.at(parameters), one.wheel_time, path))
    total = sum(float(path[-1] - path[0]) for path in paths)
    windows: list[Part] = []
    rows, travelled = [], np.zeros(len(SHAPE))
    for one, path in zip(segments, paths, strict=True):
        share = float(path[-1] - path[0]) / total
        count = max(1, min(round(WINDOWS * share), len(one.time) // FEWEST))
        bounds = np.linspace(path[0], path[-1], count + 1)
        inside = len(windows) + np.searchsorted(bounds[1:-1], (path[1:] + path[:-1]) / 2.0)
        kinds = _kinds(one, one.at(parameters))
        travelled += np.bincount(kinds, np.diff(path), len(SHAPE)) / total
        for begin, end in pairwise(np.interp(bounds, path, one.time).tolist()):
            cell = np.array([len(windows)])
            windows.append(
                Part(cells=cell, share=share / count, recording=one.recording, begin=begin, end=end)
            )
        rows.append(np.column_stack([np.append(inside, inside[-1]), np.append(kinds, kinds[-1])]))
    of_steps = np.concatenate(rows)[:-1] + np.array([0, len(windows)])
    return Cells(windows=tuple(windows), of_steps=of_steps, travelled=travelled)


def _kinds(segment: Segment, at: Array) -> NDArray[np.intp]:
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
    return np.asarray(np.ravel_multi_index((shape, forwards > 0.0, turning > 0.0), SHAPES))


def hypotheses(cells: Cells) -> list[Hypothesis]:
    """Return all hypotheses. Those of one sort are equally likely."""
    by_recording: dict[int, list[Part]] = {}
    for one in cells.windows:
        by_recording.setdefault(one.recording, []).append(one)
    recordings = list(by_recording.values())
    # Those since some time reach the end, and are changes. Other intervals may be anything.
    whole = [_joined(own, whole=True) for own in recordings if len(recordings) > 1]
    since = [_joined(own[first:]) for own in recordings for first in range(1, len(own))]
    intervals = [
        _joined(own[first:last])
        for own in recordings
        for last in range(1, len(own))
        for first in range(last)
    ]
    kinds = list(_parts_of_kinds(cells))
    arcs = [one for one in kinds if one.kind == ARCS]
    slips = [*product(kinds, CHANGES), *product(arcs, CHANGES_OF_ARCS)]
    sorts = (
        (slips, SLIP if cells.lines > LINES else 0.0, DIFFERENCE),
        (list(product(whole, CHANGES)), OTHER, DIFFERENCE),
        (list(product(since, CHANGES)), OTHER, CHANGE),
        (list(product(intervals, CHANGES)), OTHER, DIFFERENCE),
    )
    return [
        Hypothesis(part=part, change=change, prior=chance / len(pairs), spread=spread)
        for pairs, chance, spread in sorts
        for part, change in pairs
    ]


def _parts_of_kinds(cells: Cells) -> Iterator[Part]:
    shares = {kind: float(cells.travelled[inside].sum()) for kind, inside in KINDS.items()}
    if min(shares[IN_PLACE], shares[ARCS]) < RARE:
        # All turns are the same as those of the only shape.
        del shares[TURNS]
    for kind, share in shares.items():
        if RARE < share < 1.0 - RARE:
            here = len(cells.windows) + np.flatnonzero(KINDS[kind])
            yield Part(cells=here, share=share, kind=kind)


def _joined(windows: Sequence[Part], *, whole: bool = False) -> Part:
    """Return consecutive windows of a recording as one part."""
    return Part(
        cells=np.concatenate([one.cells for one in windows]),
        share=sum(one.share for one in windows),
        recording=windows[0].recording,
        begin=windows[0].begin,
        end=windows[-1].end,
        whole=whole,
    )
