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

"""Whether the same multipliers hold in each kind of motion, at all times, and in each recording.

How likely each of the hypotheses is, and what the parameters are then, follows from the gradient and
the information of its change at the estimate. The result is the mean of all. Source:
doc/moments.md, "Consistency".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.determined import UNDETERMINED
from diffdrive_jacobian.calibration.hypotheses import (
    ARCS,
    DIFFERENCE,
    IN_PLACE,
    LINES,
    Cells,
    Hypothesis,
    Part,
    divided,
    hypotheses,
)
from diffdrive_jacobian.calibration.linear_model import linearized
from diffdrive_jacobian.calibration.model import (
    MULTIPLIERS,
    Array,
    Estimate,
    Segment,
    prior_information,
)
from diffdrive_jacobian.calibration.motion import Geometry

MOST_POSES = 2000
"""Number of poses that are used at most."""
EXCESS = 2.0
"""Ratio of the squares in the median window to those of the model that may be chance. Without a fault it
is 1.0 with a deviation of 0.28 for 12 windows, and of 0.16 for 40."""
LIKELY, SURE = 0.5, 0.9
"""Probability of a change that is named, and of one that is acted on: slip becomes one of the
parameters, and an interval is left out."""
NOTICED = 4.0
"""Deviations of slip up to which it may go unnoticed: there, the odds for it are from even, where it is
well determined, to 10 to 1."""
HARMFUL = 4.0
"""Deviations of a multiplier by which slip that goes unnoticed may falsify it without a note."""
TO_SEE_SLIP = {IN_PLACE: 'drive more arcs', ARCS: 'turn in place, too'}
"""Kinds of motion in which wheels are known to slip, and what shows it."""
UNEXPECTED = ('the robot turns', 'the inner wheel travels')
"""What is no slip of a wheel, and a wheel that slips less than the other."""
NAMES = ('left radius', 'right radius', 'separation')


@dataclass(frozen=True, kw_only=True, slots=True)
class LocalChanges:
    """What is known of changes of the logarithms of the multipliers in single cells."""

    S: Array
    """Their information, shape (3 * cells, 3 * cells)."""
    g: Array
    """Their gradient, shape (3 * cells,)."""
    moves: Array
    """Changes of the parameters with them, shape (parameters, 3 * cells)."""

    def information(self, directions: Array) -> Array:
        """Return the information of changes in some directions, shape (n, 3 * cells)."""
        return np.asarray(np.sum((directions @ self.S) * directions, axis=1))

    def sizes(self, directions: Array, spreads: Array) -> tuple[Array, Array]:
        """Return the most likely size of each change, and its variance, shapes (n,).

        `spreads` are their prior standard deviations, shape (n,).
        """
        variances = 1.0 / (self.information(directions) + spreads**-2.0)
        return -variances * (directions @ self.g), variances

    def given(self, direction: Array, size: float, variance: float, moved: Array) -> LocalChanges:
        """Return the same, once a change is one of the parameters that are estimated.

        `moved` is how it moves the others, shape (parameters,).
        """
        along = self.S @ direction
        return LocalChanges(
            S=self.S - variance * np.outer(along, along),
            g=self.g + along * size,
            moves=self.moves - variance * np.outer(moved, along),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Verdict:
    """What differs, and the parameters in view of all that may differ."""

    slips: tuple[str, ...] = ()
    """Where wheels slip, and other differences of kinds of motion."""
    part: Part | None = None
    """An interval or a recording that is different; None: all of it may be chance."""
    words: str = ''
    """How it is different."""
    sure: bool = False
    """Whether that is more than likely."""
    unnoticed: tuple[str, ...] = ()
    """Slip that the drives may not show."""
    estimate: Estimate


@dataclass(frozen=True, kw_only=True, slots=True)
class Weighing:
    """The probabilities of n hypotheses, of which one at most is true, and what they would change."""

    sizes: Array
    """Most likely sizes of the changes, shape (n,)."""
    variances: Array
    """Their variances."""
    probabilities: Array
    """Shape (n,). Their sum is less than 1 by that of no change."""
    right: Array
    """Probabilities that the multipliers of the part are right, and not those of the rest."""
    by_rest: Array
    """What a change of 1 adds to the parameters if the rest is right, shape (n, parameters)."""
    by_part: Array
    """What it adds if the part is."""

    @classmethod
    def of(
        cls, every: Sequence[Hypothesis], directions: Array, local: LocalChanges, excess: float
    ) -> Weighing:
        """Weigh hypotheses with their directions, shape (n, 3 * cells)."""
        spreads = np.array([one.spread for one in every])
        sizes, variances = local.sizes(directions, spreads)
        bayes = (sizes**2 / variances / excess + np.log(variances / spreads**2)) / 2.0
        by_rest = directions @ local.moves.T
        # What the drives do not determine, or no longer, is no reason to doubt the rest, nor is that
        # given which they do not determine the multipliers.
        errors = np.abs(by_rest[:, MULTIPLIERS]) * np.sqrt(variances)[:, None]
        known = local.information(directions) > spreads**-2.0
        known &= (errors < UNDETERMINED).all(axis=1)
        prior = np.where(known, [one.prior for one in every], 0.0)
        largest = bayes.max(initial=0.0)
        weights = prior * np.exp(bayes - largest)
        nothing = (1.0 - prior.sum()) * np.exp(-largest)
        by_part = by_rest.copy()
        by_part[:, MULTIPLIERS] += [one.change.own for one in every]
        return cls(
            sizes=sizes,
            variances=variances,
            probabilities=weights / (weights.sum() + nothing),
            right=np.array([one.right(size) for one, size in zip(every, sizes.tolist(), strict=True)]),
            by_rest=by_rest,
            by_part=by_part,
        )

    def likeliest(self, which: NDArray[np.bool_]) -> tuple[float, int]:
        """Return the probability that any of some hypotheses is true, and the likeliest one."""
        likeliest = int(np.argmax(np.where(which, self.probabilities, -1.0)))
        return float(self.probabilities[which].sum()), likeliest

    def averaged(self, estimate: Estimate) -> Estimate:
        """Return the mean of an estimate without a change and of those with one, and its covariance."""
        of_part = self.probabilities * self.right
        shares = np.concatenate([self.probabilities - of_part, of_part])
        units = np.concatenate([self.by_rest, self.by_part])
        sizes, variances = np.tile(self.sizes, 2), np.tile(self.variances, 2)
        mean = (shares * sizes) @ units
        squares = (units.T * (shares * (sizes**2 + variances))) @ units
        free = np.ix_(estimate.free, estimate.free)
        return replace(
            estimate,
            parameters=estimate.parameters + mean,
            covariance=estimate.covariance + estimate.of_free((squares - np.outer(mean, mean))[free]),
        )


def judged(segments: Sequence[Segment], nominal: Geometry, estimate: Estimate) -> Verdict:
    """Return what differs between parts of the drives, at the most likely parameters."""
    thinned, at = _thinned(segments, estimate)
    cells = divided(thinned, nominal, at.parameters)
    every = hypotheses(cells)
    if not every:
        return Verdict(estimate=estimate)
    local = local_changes(thinned, nominal, at, cells)
    slips, found, estimate = _with_sure_slips(every, cells, local, estimate)
    estimate = found.averaged(estimate)
    of_kind = np.array([one.part.kind != '' for one in every])
    probability, likeliest = found.likeliest(of_kind)
    if probability > LIKELY:
        slips.append(every[likeliest].words(float(found.sizes[likeliest])))
    unnoticed = () if slips else _unnoticed(cells, every, found, estimate)
    probability, likeliest = found.likeliest(~of_kind)
    if probability < LIKELY:
        return Verdict(slips=tuple(slips), unnoticed=unnoticed, estimate=estimate)
    return Verdict(
        slips=tuple(slips),
        part=every[likeliest].part,
        words=every[likeliest].words(float(found.sizes[likeliest])),
        sure=probability > SURE,
        unnoticed=unnoticed,
        estimate=estimate,
    )


def _with_sure_slips(
    every: Sequence[Hypothesis], cells: Cells, local: LocalChanges, estimate: Estimate
) -> tuple[list[str], Weighing, Estimate]:
    """Return descriptions of slip that is sure, all else in view of it, and the estimate with it."""
    directions = np.stack([one.direction(cells.count) for one in every])
    excess = _excess(local, len(cells.windows))
    slips: list[str] = []
    # It ends: what is one of the parameters is known no better from the rest, and not weighed again.
    while True:
        found = Weighing.of(every, directions, local, excess)
        slipping = np.array([one.part.kind != '' for one in every]) & (found.sizes < 0.0)
        slip = int(np.argmax(np.where(slipping, found.probabilities, 0.0)))
        if not slipping[slip] or found.probabilities[slip] < SURE:
            return slips, found, estimate
        size, variance = float(found.sizes[slip]), float(found.variances[slip])
        slips.append(every[slip].words(size))
        estimate = estimate.moved(size, variance, found.by_rest[slip])
        local = local.given(directions[slip], size, variance, found.by_rest[slip])


def _unnoticed(
    cells: Cells, every: Sequence[Hypothesis], found: Weighing, estimate: Estimate
) -> tuple[str, ...]:
    """Return the slip that may go unnoticed, and falsify a multiplier by more than stated.

    That is so where a kind of motion has most of what is known of a multiplier.
    """
    if cells.lines < LINES:
        return ('without straight lines, slip in turns would go unnoticed: drive lines, too',)
    least = NOTICED * np.sqrt(found.variances)
    errors = np.abs(found.by_rest[:, MULTIPLIERS]) * least[:, None]
    ratios = errors / np.sqrt(np.diag(estimate.covariance)[MULTIPLIERS])
    expected = [one.part.kind in TO_SEE_SLIP and one.change.words not in UNEXPECTED for one in every]
    ratios = np.where(np.array(expected)[:, None], ratios, 0.0)
    worst, which = divmod(int(np.argmax(ratios)), 3)
    if ratios[worst, which] < HARMFUL:
        return ()
    kind = every[worst].part.kind
    return (
        f'where the robot {kind}, it may go unnoticed that {every[worst].change.words} up to '
        f'{100.0 * least[worst]:.2g} % less: the {NAMES[which]} multiplier would be wrong by up to '
        f'{100.0 * errors[worst, which]:.2g} %. To see slip, {TO_SEE_SLIP[kind]}',
    )


def _thinned(segments: Sequence[Segment], estimate: Estimate) -> tuple[list[Segment], Estimate]:
    """Return motions and estimate with at most about `MOST_POSES` poses."""
    every = -(-sum(len(one.time) for one in segments) // MOST_POSES)
    kept = [slice(None, None, min(every, len(one.time) - 1)) for one in segments]
    states = tuple(one[here] for one, here in zip(estimate.states, kept, strict=True))
    thinned = [one.part(here) for one, here in zip(segments, kept, strict=True)]
    return thinned, replace(estimate, states=states)


def local_changes(
    segments: Sequence[Segment], nominal: Geometry, estimate: Estimate, cells: Cells
) -> LocalChanges:
    """Return what is known of changes in the cells: further parameters of the linear model."""
    model = linearized(segments, nominal, estimate)
    count, steps = len(estimate.parameters), np.arange(len(model.e))
    in_cells = np.zeros((len(steps), 3, cells.count, 3))
    for cell in cells.of_steps.T:
        in_cells[steps, :, cell] = model.D[:, :, MULTIPLIERS]
    added = 3 * cells.count
    model = replace(
        model,
        D=np.concatenate([model.D, in_cells.reshape(len(steps), 3, added)], axis=2),
        M=np.pad(model.M, ((0, 0), (0, added))),
        free=np.append(estimate.free, np.ones(added, dtype=bool)),
        to_prior=np.append(model.to_prior, np.zeros(added)),
    )
    free = np.flatnonzero(estimate.free)
    reduced = model.reduced(estimate.noise.variances)
    own, local = slice(0, len(free)), slice(len(free), None)
    known = reduced.information[own, own] + prior_information(estimate.free)
    cross = reduced.information[own, local]
    gain = np.linalg.solve(known, np.column_stack([cross, reduced.gradient[own]]))
    moves = np.zeros((count, added))
    moves[free] = -gain[:, :-1]
    return LocalChanges(
        S=reduced.information[local, local] - cross.T @ gain[:, :-1],
        g=reduced.gradient[local] - cross.T @ gain[:, -1],
        moves=moves,
    )


def _excess(local: LocalChanges, windows: int) -> float:
    """Return how much larger the squares in the median window are than in the model."""
    here = np.arange(windows)
    S = local.S.reshape(len(local.g) // 3, 3, -1, 3)[here, :, here]
    g = local.g.reshape(-1, 3)[here]
    solved = np.linalg.solve(S + np.eye(3) / DIFFERENCE**2, np.dstack([S, g[:, :, None]]))
    squares = np.einsum('ni,ni->n', g, solved[:, :, 3])
    freedom = np.trace(solved[:, :, :3], axis1=1, axis2=2)
    # The median of a chi-square distribution of two to three degrees of freedom is 0.75 of its mean.
    excess = float(np.median(squares) / max(np.median(freedom), 1e-9)) / 0.75
    return excess if excess > EXCESS else 1.0
