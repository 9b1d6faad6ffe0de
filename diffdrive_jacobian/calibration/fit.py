"""Maximum likelihood estimate of the multipliers from wheel angles and poses of a reference.

The model is that of doc/mathematics.md, "Calibration": the pose of the body is a random walk about the
motion that the wheels measure, and the reference observes it with white noise. All poses of the body and
all parameters are estimated together by Gauss-Newton steps. The poses form a block-tridiagonal system,
which cyclic reduction solves in a time proportional to their number: each level eliminates every other
block, all of them at once as NumPy arrays. The noise is estimated by restricted maximum likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.model import (
    LEVER_ARM,
    MULTIPLIERS,
    TIME_OFFSETS,
    YAW_OFFSET,
    Array,
    CalibrationError,
    Estimate,
    Given,
    Noise,
    Segment,
    prior_deviations,
    prior_information,
)
from diffdrive_jacobian.calibration.motion import (
    Geometry,
    Increments,
    composed,
    increments,
    inverted,
    relative,
)
from diffdrive_jacobian.kinematics.se2 import adjoint
from diffdrive_jacobian.numerics.elementary import wrap

MAX_STEPS = 40
FULL_STEPS = 5
"""Steps after which they are shortened, more with each: the time offset may alternate about a kink of
the wheels."""
WINDOW = 4.0
"""Half of the time over which wheel speeds are means, in units of the last change of the time offset:
the interpolated motion of the wheels has kinks at its samples, which long steps must overlook."""
MAX_NOISE_STEPS = 5
"""For one step of the parameters."""
NOISE_CONVERGED = 2e-3
"""Largest relative change of a variance in the last step."""
CONVERGED = 0.02
"""Largest change of a parameter in the last step, relative to its standard deviation."""
TIME_CONVERGED = 0.25
"""The same of a time offset. It may alternate between both sides of a kink, without effect on the
others."""
NEGLIGIBLE = 1e-7
"""Change of a parameter that is negligible in any case (-, m, rad, s)."""
SMALLEST = Noise(wheel=1e-9, position=1e-5, heading=1e-5)
"""Smallest noise that is estimated: with less, rounding errors dominate."""
PRIOR_WHEEL_NOISE, PRIOR_FREEDOM = 1e-5, 1.0
"""Wheel travel variance that is assumed in advance (m), and how many squares it counts as. In
short drives with a coarse reference the likelihood alone is largest at zero, where the stated covariance
would be far too small."""
WIDEST = 1.5
"""Largest standard deviation of the logarithm of the wheel travel variance."""
LARGEST = Noise(wheel=1.0, position=1e3, heading=1e2)


def solve_block_tridiagonal(diagonal: Array, upper: Array, right: Array) -> tuple[Array, float]:
    """Return the solution x of `A x = b` and log det A, infinite or NaN where A is singular.

    The blocks A[i, i] are `diagonal`, shape (n, 3, 3), the blocks A[i, i + 1] are `upper`, and b and x
    have shape (n, 3, m); m may be 0.
    """
    levels = []
    logarithm = 0.0
    while len(diagonal) > 1:
        count = len(diagonal)
        if count % 2 == 0:
            # An uncoupled block at the end, which is dropped below, gives each odd block two neighbours.
            diagonal = np.concatenate([diagonal, np.eye(3)[None]])
            upper = np.concatenate([upper, np.zeros((1, 3, 3))])
            right = np.concatenate([right, np.zeros((1, *right.shape[1:]))])
        before, after = np.swapaxes(upper[0::2], 1, 2), upper[1::2]
        odd = diagonal[1::2]
        logarithm += float(np.linalg.slogdet(odd)[1].sum())
        inverse = np.linalg.inv(odd)
        to_before, to_after = inverse @ before, inverse @ after
        value = inverse @ right[1::2]
        levels.append((count, to_before, to_after, value))
        next_diagonal, next_right = diagonal[0::2].copy(), right[0::2].copy()
        before_t, after_t = upper[0::2], np.swapaxes(after, 1, 2)
        next_diagonal[:-1] -= before_t @ to_before
        next_diagonal[1:] -= after_t @ to_after
        next_right[:-1] -= before_t @ value
        next_right[1:] -= after_t @ value
        kept = (count + 1) // 2
        upper = (-before_t @ to_after)[: kept - 1]
        diagonal, right = next_diagonal[:kept], next_right[:kept]
    logarithm += float(np.linalg.slogdet(diagonal[0])[1])
    solution = np.linalg.inv(diagonal) @ right
    for count, to_before, to_after, value in reversed(levels):
        whole = np.zeros((2 * len(value) + 1, *solution.shape[1:]))
        whole[0 : 2 * len(solution) : 2] = solution
        whole[1::2] = value - to_before @ whole[0:-1:2] - to_after @ whole[2::2]
        solution = whole[:count]
    return solution, logarithm


@dataclass(frozen=True, kw_only=True, slots=True)
class Group:
    """Residuals of one kind with their Jacobians, as normal equations for unit weight."""

    count: float
    diagonal: Array
    upper: Array
    border: Array
    """Blocks between the poses and the parameters, shape (n, 3, p)."""
    corner: Array
    gradient: Array
    """With respect to the poses, shape (n, 3)."""
    gradient_corner: Array
    cost: float

    def cost_after(self, step: Array, change: Array) -> float:
        """Return the sum of the squared residuals after a step, to second order."""
        linear = 2.0 * float(np.sum(self.gradient * step) + self.gradient_corner @ change)
        along = np.einsum('nij,nj->ni', self.diagonal, step) + 2.0 * np.einsum(
            'nip,p->ni', self.border, change
        )
        square = float(np.sum(step * along) + change @ self.corner @ change)
        square += 2.0 * float(np.einsum('ni,nij,nj->', step[:-1], self.upper, step[1:]))
        return max(0.0, self.cost + linear + square)


@dataclass(frozen=True, kw_only=True, slots=True)
class Solution:
    """A Gauss-Newton step."""

    step: Array
    observed: Array
    """Step of the poses as the reference observes them, which differ by the reading errors."""
    change: Array
    """Of the free parameters."""
    information: Array
    logarithm: float
    """log det of the normal matrix."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Equations:
    """The normal equations of all residuals, and of the prior of the parameters."""

    groups: tuple[Group, Group, Group]
    """Of the motion, the positions and the headings."""
    reading: Array
    """How far the reading errors of both wheels, each of one standard deviation, seem to move the body
    at each pose: twists in its frame, shape (n, 3, 2)."""
    free: NDArray[np.bool_]
    """Which of the parameters are estimated."""
    pull: Array
    """Gradient of the prior of all parameters."""

    def solved(self, weights: Array) -> Solution:
        """Return the Gauss-Newton step for given weights of the groups."""
        free = self.free

        def total(name: str, kinds: Sequence[int] = (0, 1, 2)) -> Array:
            return np.asarray(sum(weights[kind] * getattr(self.groups[kind], name) for kind in kinds))

        def right_side(kinds: Sequence[int] = (0, 1, 2)) -> Array:
            border, gradient = total('border', kinds)[:, :, free], total('gradient', kinds)
            return np.concatenate([border, gradient[:, :, None]], axis=2)

        diagonal, right = total('diagonal'), right_side()
        # Reading errors, with a prior of unit weight, act on the reference only. They are eliminated.
        at = np.flatnonzero(self.reading.any(axis=(1, 2)))
        B, H, b = self.reading[at], total('diagonal', (1, 2))[at], right_side((1, 2))[at]
        back = np.swapaxes(B, 1, 2)
        inner = np.eye(2) + back @ H @ B
        G = B @ np.linalg.solve(inner, back)
        diagonal[at] -= H @ G @ H
        right[at] -= H @ G @ b
        solved, logarithm = solve_block_tridiagonal(diagonal, total('upper'), right)
        eliminated = np.tensordot(right[:, :, :-1], solved, ((0, 1), (0, 1)))
        eliminated += np.tensordot(b[:, :, :-1], G @ b, ((0, 1), (0, 1)))
        information = total('corner')[np.ix_(free, free)] - eliminated[:, :-1]
        information = (information + information.T) / 2.0
        damped = information + prior_information(free)
        change = -np.linalg.solve(
            damped, total('gradient_corner')[free] + self.pull[free] - eliminated[:, -1]
        )
        step = -solved[:, :, -1] - solved[:, :, :-1] @ change
        observed = step.copy()
        observed[at] -= (G @ (H @ step[at, :, None] + b @ np.append(change, 1.0)[:, None]))[:, :, 0]
        if not (np.isfinite(change).all() and np.isfinite(step).all()):
            raise CalibrationError(
                'the estimate diverges: the poses do not fit the motion of the wheels'
            )
        return Solution(
            step=step,
            observed=observed,
            change=np.asarray(change, dtype=np.float64),
            information=information,
            logarithm=logarithm
            + float(np.linalg.slogdet(inner)[1].sum() + np.linalg.slogdet(damped)[1]),
        )

    def freedom_and_costs(self, weights: Array, solution: Solution) -> tuple[Array, Array]:
        """Return the degrees of freedom of the residuals of each group, and their sums of squares."""
        change = np.zeros(len(self.free))
        change[self.free] = solution.change
        steps = (solution.step, solution.observed, solution.observed)
        costs = np.array(
            [one.cost_after(step, change) for one, step in zip(self.groups, steps, strict=True)]
        )
        counts = np.array([one.count for one in self.groups])
        # The estimate takes from each group what log det of the normal matrix changes with its weight.
        h = 1e-3
        shifts = weights * np.exp(h * np.eye(3))
        logarithms = np.array([self.solved(shifted).logarithm for shifted in shifts])
        used = (logarithms - solution.logarithm) / h
        freedom = np.maximum(counts - used, 1e-3 * counts)
        freedom[0] += PRIOR_FREEDOM
        costs[0] += PRIOR_FREEDOM * PRIOR_WHEEL_NOISE
        return freedom, costs


def linearized(
    segments: Sequence[Segment],
    nominal: Geometry,
    estimate: Estimate,
    free: NDArray[np.bool_],
    pull: Array,
    window: float = np.inf,
    columns: Sequence[NDArray[np.int_]] | None = None,
) -> Equations:
    """Return the normal equations at an estimate, with rates over a window as of `increments`.

    `columns` are where, among all parameters, changes of the logarithms of the multipliers begin that
    are those of single steps, shape (n - 1, any) for each motion (default: there are none).
    """
    count = len(free)
    if columns is None:
        columns = [np.empty((len(one.time) - 1, 0), dtype=int) for one in segments]
    geometry, sensor = estimate.geometry(nominal), estimate.sensor
    parts: tuple[list[Group], ...] = ([], [], [])
    readings = []
    right, left = geometry.radii
    L = geometry.separation
    by_reading = np.array([[right / 2.0, left / 2.0], [0.0, 0.0], [right / L, -left / L]])
    for segment, states, further in zip(segments, estimate.states, columns, strict=True):
        offset = TIME_OFFSETS + segment.recording
        at = segment.time + estimate.parameters[offset]
        moved = increments(segment.wheel_time, segment.wheel_angles, at, geometry, window)
        parts[0].append(_motion(moved, states, offset, count, further))
        for kind, part in enumerate(_observation(segment, states, sensor, count), 1):
            parts[kind].append(part)
        errors = [np.interp(at, segment.wheel_time, one) for one in segment.wheel_errors.T]
        readings.append(by_reading * np.column_stack(errors)[:, None])
    motion, position, heading = (_joined(part) for part in parts)
    groups = motion, position, heading
    return Equations(groups=groups, reading=np.concatenate(readings), free=free, pull=pull)


def _motion(
    moved: Increments, states: Array, offset: int, count: int, columns: NDArray[np.int_]
) -> Group:
    """Return the normal equations of the motion, for the wheel travel variance 1 m."""
    between = relative(states[:-1], states[1:])
    residual = relative(moved.steps, between)
    residual[:, 2] = wrap(residual[:, 2])
    weight = np.linalg.inv(moved.covariance)
    back = -adjoint(inverted(between))
    change = np.zeros((len(residual), 3, count))
    change[:, :, MULTIPLIERS] = -moved.jacobian
    for begins in columns.T:
        for which in range(3):
            change[np.arange(len(begins)), :, begins + which] = -moved.jacobian[:, :, which]
    # The time offset moves both ends of a step.
    change[:, :, offset] = -(moved.rates[1:] + np.einsum('nij,nj->ni', back, moved.rates[:-1]))
    n = len(states)
    diagonal, border, gradient = np.zeros((n, 3, 3)), np.zeros((n, 3, count)), np.zeros((n, 3))
    weighted_back = np.swapaxes(back, 1, 2) @ weight
    weighted_change, weighted = weight @ change, np.einsum('nij,nj->ni', weight, residual)
    diagonal[1:] += weight
    diagonal[:-1] += weighted_back @ back
    border[1:] += weighted_change
    border[:-1] += weighted_back @ change
    gradient[1:] += weighted
    gradient[:-1] += np.einsum('nij,nj->ni', weighted_back, residual)
    return Group(
        count=3.0 * (n - 1),
        diagonal=diagonal,
        upper=weighted_back,
        border=border,
        corner=np.asarray(np.tensordot(change, weighted_change, ((0, 1), (0, 1))), dtype=np.float64),
        gradient=gradient,
        gradient_corner=np.einsum('nip,ni->p', change, weighted),
        cost=float(np.sum(residual * weighted)),
    )


def _observation(segment: Segment, states: Array, sensor: Array, count: int) -> tuple[Group, Group]:
    """Return the normal equations of the positions and of the headings."""
    residual = relative(composed(states, sensor), segment.poses)
    # In the frame of the body, as the derivatives.
    c, s = np.cos(sensor[2]), np.sin(sensor[2])
    x, y = residual[:, 0].copy(), residual[:, 1].copy()
    residual[:, 0], residual[:, 1] = c * x - s * y, s * x + c * y
    residual[:, 2] = wrap(residual[:, 2])
    by_pose = -np.array([[1.0, 0.0, -sensor[1]], [0.0, 1.0, sensor[0]], [0.0, 0.0, 1.0]])
    by_parameters = np.zeros((3, count))
    by_parameters[:2, LEVER_ARM] = -np.eye(2)
    by_parameters[2, YAW_OFFSET] = -1.0
    groups = []
    for rows in (slice(0, 2), slice(2, 3)):
        J, M, e, w = by_pose[rows], by_parameters[rows], residual[:, rows], segment.weights
        groups.append(
            Group(
                count=float(e.size),
                diagonal=w[:, None, None] * (J.T @ J),
                upper=np.zeros((len(w) - 1, 3, 3)),
                border=w[:, None, None] * (J.T @ M),
                corner=w.sum() * (M.T @ M),
                gradient=w[:, None] * (e @ J),
                gradient_corner=(w @ e) @ M,
                cost=float(np.sum(w[:, None] * e**2)),
            )
        )
    return groups[0], groups[1]


def _joined(parts: Sequence[Group]) -> Group:
    """Return the equations of several segments, between which nothing is coupled."""
    uncoupled = np.zeros((1, 3, 3))
    uppers = [block for one in parts for block in (one.upper, uncoupled)][:-1]
    return Group(
        count=sum(one.count for one in parts),
        diagonal=np.concatenate([one.diagonal for one in parts]),
        upper=np.concatenate(uppers),
        border=np.concatenate([one.border for one in parts]),
        corner=np.sum([one.corner for one in parts], axis=0),
        gradient=np.concatenate([one.gradient for one in parts]),
        gradient_corner=np.sum([one.gradient_corner for one in parts], axis=0),
        cost=sum(one.cost for one in parts),
    )


def fit(
    segments: Sequence[Segment],
    nominal: Geometry,
    start: Estimate,
    given: Given,
    anchor: Array | None = None,
) -> Estimate:
    """Return the most likely parameters of continuous motions of at least two poses each.

    The prior lies about `anchor` (default: the parameters of `start`).
    """
    sensor = inverted(start.sensor)
    estimate = replace(start, states=tuple(composed(one.poses, sensor) for one in segments))
    ends = np.cumsum([len(one) for one in estimate.states])[:-1]
    anchor = start.parameters if anchor is None else anchor
    scales = prior_deviations(len(anchor))
    window = np.inf
    tolerances = np.where(np.arange(len(anchor)) < TIME_OFFSETS, CONVERGED, TIME_CONVERGED)[start.free]
    for count in range(MAX_STEPS):
        pull = (estimate.parameters - anchor) / scales**2
        equations = linearized(segments, nominal, estimate, estimate.free, pull, window)
        noise, solution, settled = _with_noise(equations, estimate.noise, given)
        size = np.abs(solution.change)
        window = WINDOW * float(size[np.count_nonzero(estimate.free[:TIME_OFFSETS]) :].max(initial=0.0))
        limit = scales[estimate.free]
        shorten = float(min(1.0, np.min(limit / np.maximum(size, 1e-12), initial=1.0)))
        shorten *= min(1.0, FULL_STEPS / (count + 1.0))
        parameters = estimate.parameters.copy()
        parameters[estimate.free] += shorten * solution.change
        estimate = replace(
            estimate,
            parameters=parameters,
            noise=noise,
            states=tuple(map(composed, estimate.states, np.split(shorten * solution.step, ends))),
            information=solution.information,
        )
        deviation = np.sqrt(np.diag(estimate.covariance())[estimate.free])
        if settled and (shorten * size <= np.maximum(tolerances * deviation, NEGLIGIBLE)).all():
            break
    else:
        if (size[:3] > deviation[:3] / 5.0).any():
            raise CalibrationError(
                f'the estimate does not converge within {MAX_STEPS} steps: the poses of the reference '
                'do not fit the motion of the wheels'
            )
    if given.wheel_noise is None:
        estimate = replace(estimate, information=_averaged(equations, noise))
    return estimate


def score(
    segments: Sequence[Segment],
    nominal: Geometry,
    estimate: Estimate,
    columns: Sequence[NDArray[np.int_]] | None = None,
    count: int | None = None,
) -> tuple[Array, Array]:
    """Return the Fisher information and the gradient of all `count` parameters, without the prior.

    Those of `columns` are 0, see `linearized`. If poses, noise and parameters are the true ones, the
    inverse of the information is the Cramer-Rao bound.
    """
    count = count or len(estimate.parameters)
    free, pull = np.ones(count, dtype=bool), np.zeros(count)
    equations = linearized(segments, nominal, estimate, free, pull, columns=columns)
    found = equations.solved(_weights(estimate.noise))
    damped = found.information + prior_information(free)
    return found.information, -damped @ found.change


def _weights(noise: Noise) -> Array:
    return 1.0 / np.array([noise.wheel, noise.position**2, noise.heading**2])


def _with_noise(equations: Equations, noise: Noise, given: Given) -> tuple[Noise, Solution, bool]:
    """Return more likely noise at a linearization, the step for it, and whether it is the most likely.

    At the maximum of the restricted likelihood the weighted squares of each group equal its degrees of
    freedom, which follow from the derivative of the log det of the normal matrix.
    """
    values = (given.wheel_noise, given.position_noise, given.heading_noise)
    unknown = np.array([value is None for value in values])
    weights = _weights(
        Noise(
            wheel=given.wheel_noise or noise.wheel,
            position=given.position_noise or noise.position,
            heading=given.heading_noise or noise.heading,
        )
    )
    least, most = _weights(LARGEST), _weights(SMALLEST)
    solution = equations.solved(weights)
    before: tuple[Array, Array] | None = None
    settled = not unknown.any()
    for _ in range(MAX_NOISE_STEPS if unknown.any() else 0):
        freedom, costs = equations.freedom_and_costs(weights, solution)
        proposed = np.clip(freedom / np.maximum(costs, 1e-300), least, most)
        now, change = np.log(weights), np.where(unknown, np.log(proposed / weights), 0.0)
        target = now + change
        if before is not None:
            # Anderson acceleration with one step of memory: alone, the steps shrink slowly.
            slope = change - before[1]
            share = float(np.clip(slope @ change / max(float(slope @ slope), 1e-300), -5.0, 0.5))
            target = target - share * (target - before[0] - before[1])
        before = now, change
        weights = np.clip(np.exp(target), least, most)
        solution = equations.solved(weights)
        settled = bool(np.abs(change).max() < NOISE_CONVERGED)
        if settled:
            break
    wheel, position, heading = (1.0 / weights).tolist()
    return Noise(wheel=wheel, position=position**0.5, heading=heading**0.5), solution, settled


def _averaged(equations: Equations, noise: Noise) -> Array:
    """Return the information of which the inverse is the covariance for uncertain wheel noise.

    It is the mean over the posterior of the logarithm of the wheel travel variance, taken as Gaussian,
    by Gauss-Hermite quadrature with three points.
    """
    weights = _weights(noise)

    def at(shift: float) -> tuple[Solution, Array]:
        shifted = weights * [np.exp(shift), 1.0, 1.0]
        return equations.solved(shifted), shifted

    def slope(shift: float) -> float:
        """Return twice the derivative of the log likelihood with respect to the log of the weight."""
        solution, shifted = at(shift)
        freedom, cost = equations.freedom_and_costs(shifted, solution)
        return float(freedom[0] - shifted[0] * cost[0])

    h = 0.3
    curvature = (slope(-h) - slope(h)) / (2.0 * h) / 2.0
    width = min(WIDEST, max(curvature, 1e-9) ** -0.5)
    prior = prior_information(equations.free)
    found = [at(sign * 3.0**0.5 * width)[0] for sign in (-1.0, 0.0, 1.0)]
    shares = np.array([1.0, 4.0, 1.0]) / 6.0
    changes = np.array([one.change for one in found])
    off = changes - shares @ changes
    covariance = sum(
        share * (np.linalg.inv(one.information + prior) + np.outer(change, change))
        for share, one, change in zip(shares, found, off, strict=True)
    )
    return np.asarray(np.linalg.inv(covariance) - prior)
