"""Maximum likelihood estimate of the multipliers from wheel angles and poses of a reference.

The model is that of doc/mathematics.md, "Calibration": the pose of the body is a random walk about the
motion that the wheels measure, and the reference observes it with white noise. All poses of the body and
all parameters are estimated together by Gauss-Newton steps. The poses form a block-tridiagonal system,
so that a step takes a time proportional to their number. The noise is estimated by restricted maximum
likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.estimate import (
    TIME_OFFSETS,
    Estimate,
    prior_deviations,
)
from diffdrive_jacobian.calibration.measurements import (
    Array,
    CalibrationError,
    Given,
    Noise,
    Segment,
)
from diffdrive_jacobian.calibration.motion import Geometry, composed, inverted
from diffdrive_jacobian.calibration.normal_equations import Group, linearized, solve_block_tridiagonal

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


@dataclass(frozen=True, kw_only=True, slots=True)
class _Prior:
    """Which parameters are free, the gradient of their prior, and that of the reading errors."""

    free: NDArray[np.bool_]
    pull: Array
    reading: Array
    """What reading errors of one standard deviation do at each pose, as of `linearized`."""

    @property
    def misread(self) -> NDArray[np.intp]:
        """Indices of the poses with reading errors."""
        return np.flatnonzero(self.reading.any(axis=(1, 2)))


@dataclass(frozen=True, kw_only=True, slots=True)
class _Solution:
    step: Array
    observed: Array
    """Step of the poses as the reference observes them, which differ by the reading errors."""
    change: Array
    information: Array
    logarithm: float
    """log det of the normal matrix."""


def fit(
    segments: Sequence[Segment],
    nominal: Geometry,
    start: Estimate,
    given: Given,
    anchor: Array | None = None,
) -> Estimate:
    """Return the most likely parameters.

    Args:
        segments: Continuous motions, each with at least two poses.
        nominal: Nominal dimensions of the robot.
        start: Approximate parameters and noise.
        given: What of the noise is known.
        anchor: Parameters about which the prior lies (default: those of `start`).

    Raises:
        CalibrationError: The estimate does not converge.
    """
    estimate = start
    if not estimate.states:
        sensor = inverted(estimate.sensor)
        estimate = replace(estimate, states=tuple(composed(one.poses, sensor) for one in segments))
    anchor = start.parameters if anchor is None else anchor
    scales = prior_deviations(len(anchor))
    window = np.inf
    tolerances = np.where(np.arange(len(anchor)) < TIME_OFFSETS, CONVERGED, TIME_CONVERGED)[start.free]
    for count in range(MAX_STEPS):
        groups, reading = linearized(segments, nominal, estimate, window)
        pull = (estimate.parameters - anchor) / scales**2
        prior = _Prior(free=estimate.free, pull=pull, reading=reading)
        noise, solution, settled = _with_noise(groups, estimate.noise, given, prior)
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
            states=_moved(estimate.states, shorten * solution.step),
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
        estimate = replace(estimate, information=_averaged(groups, noise, prior))
    return estimate


def information(segments: Sequence[Segment], nominal: Geometry, truth: Estimate) -> Array:
    """Return the Fisher information of the free parameters of an estimate, at its states and noise.

    Its inverse is the Cramer-Rao bound if these are the true ones.
    """
    groups, reading = linearized(segments, nominal, truth)
    prior = _Prior(free=truth.free, pull=np.zeros(len(truth.parameters)), reading=reading)
    return _solved(groups, _weights(truth.noise), prior).information


def score(
    segments: Sequence[Segment],
    nominal: Geometry,
    estimate: Estimate,
    columns: Sequence[NDArray[np.int_]],
    count: int,
) -> tuple[Array, Array]:
    """Return the information and the gradient of all parameters and of further ones that are 0.

    Args:
        segments: Motions with the poses `estimate.states`.
        nominal: Nominal dimensions.
        estimate: Parameters, poses and noise.
        columns: As of `linearized`.
        count: Number of all parameters.

    Returns:
        Fisher information, shape (count, count), and gradient, shape (count,), without the prior.
    """
    groups, reading = linearized(segments, nominal, estimate, columns=columns, count=count)
    prior = _Prior(free=np.ones(count, dtype=bool), pull=np.zeros(count), reading=reading)
    found = _solved(groups, _weights(estimate.noise), prior)
    damped = found.information + np.diag(prior_deviations(count) ** -2.0)
    return found.information, -damped @ found.change


def _moved(states: Sequence[Array], step: Array) -> tuple[Array, ...]:
    ends = np.cumsum([len(one) for one in states])[:-1]
    return tuple(composed(one, part) for one, part in zip(states, np.split(step, ends), strict=True))


def _weights(noise: Noise) -> Array:
    return 1.0 / np.array([noise.wheel, noise.position**2, noise.heading**2])


def _solved(groups: tuple[Group, Group, Group], weights: Array, prior: _Prior) -> _Solution:
    """Return the Gauss-Newton step for given weights of the groups."""
    free = prior.free

    def total(name: str, kinds: Sequence[int] = (0, 1, 2)) -> Array:
        return np.asarray(sum(weights[kind] * getattr(groups[kind], name) for kind in kinds))

    def right_side(kinds: Sequence[int] = (0, 1, 2)) -> Array:
        border, gradient = total('border', kinds)[:, :, free], total('gradient', kinds)
        return np.concatenate([border, gradient[:, :, None]], axis=2)

    diagonal, right = total('diagonal'), right_side()
    # The reading errors, with a prior of unit weight, act on the reference only. They are eliminated.
    at = prior.misread
    B, H, b = prior.reading[at], total('diagonal', (1, 2))[at], right_side((1, 2))[at]
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
    damped = information + np.diag(prior_deviations(len(free))[free] ** -2.0)
    change = -np.linalg.solve(
        damped, total('gradient_corner')[free] + prior.pull[free] - eliminated[:, -1]
    )
    step = -solved[:, :, -1] - solved[:, :, :-1] @ change
    observed = step.copy()
    observed[at] -= (G @ (H @ step[at, :, None] + b @ np.append(change, 1.0)[:, None]))[:, :, 0]
    if not (np.isfinite(change).all() and np.isfinite(step).all()):
        raise CalibrationError('the estimate diverges: the poses do not fit the motion of the wheels')
    return _Solution(
        step=step,
        observed=observed,
        change=np.asarray(change, dtype=np.float64),
        information=information,
        logarithm=logarithm + float(np.linalg.slogdet(inner)[1].sum() + np.linalg.slogdet(damped)[1]),
    )


def _with_noise(
    groups: tuple[Group, Group, Group], noise: Noise, given: Given, prior: _Prior
) -> tuple[Noise, _Solution, bool]:
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
    solution = _solved(groups, weights, prior)
    before: tuple[Array, Array] | None = None
    settled = not unknown.any()
    for _ in range(MAX_NOISE_STEPS if unknown.any() else 0):
        freedom, costs = _freedom_and_costs(groups, weights, prior, solution)
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
        solution = _solved(groups, weights, prior)
        settled = bool(np.abs(change).max() < NOISE_CONVERGED)
        if settled:
            break
    wheel, position, heading = (1.0 / weights).tolist()
    return Noise(wheel=wheel, position=position**0.5, heading=heading**0.5), solution, settled


def _averaged(groups: tuple[Group, Group, Group], noise: Noise, prior: _Prior) -> Array:
    """Return the information of which the inverse is the covariance for uncertain wheel noise.

    It is the mean over the posterior of the logarithm of the wheel travel variance, taken as Gaussian,
    by Gauss-Hermite quadrature with three points.
    """
    weights = _weights(noise)

    def at(shift: float) -> tuple[_Solution, Array]:
        shifted = weights * [np.exp(shift), 1.0, 1.0]
        return _solved(groups, shifted, prior), shifted

    def slope(shift: float) -> float:
        """Return twice the derivative of the log likelihood with respect to the log of the weight."""
        solution, shifted = at(shift)
        freedom, cost = _freedom_and_costs(groups, shifted, prior, solution)
        return float(freedom[0] - shifted[0] * cost[0])

    h = 0.3
    curvature = (slope(-h) - slope(h)) / (2.0 * h) / 2.0
    width = min(WIDEST, max(curvature, 1e-9) ** -0.5)
    scales = prior_deviations(len(prior.free))[prior.free] ** -2.0
    found = [at(sign * 3.0**0.5 * width)[0] for sign in (-1.0, 0.0, 1.0)]
    shares = np.array([1.0, 4.0, 1.0]) / 6.0
    changes = np.array([one.change for one in found])
    off = changes - shares @ changes
    covariance = sum(
        share * (np.linalg.inv(one.information + np.diag(scales)) + np.outer(change, change))
        for share, one, change in zip(shares, found, off, strict=True)
    )
    return np.asarray(np.linalg.inv(covariance) - np.diag(scales))


def _freedom_and_costs(
    groups: tuple[Group, Group, Group], weights: Array, prior: _Prior, solution: _Solution
) -> tuple[Array, Array]:
    """Return the degrees of freedom of the residuals of each group, and their sums of squares."""
    costs = np.array(_costs(groups, solution, prior.free))
    counts = np.array([one.count for one in groups])
    freedom = np.maximum(counts - _used(groups, weights, prior, solution), 1e-3 * counts)
    freedom[0] += PRIOR_FREEDOM
    costs[0] += PRIOR_FREEDOM * PRIOR_WHEEL_NOISE
    return freedom, costs


def _costs(
    groups: tuple[Group, Group, Group], solution: _Solution, free: NDArray[np.bool_]
) -> list[float]:
    change = np.zeros(len(free))
    change[free] = solution.change
    steps = (solution.step, solution.observed, solution.observed)
    return [one.cost_after(step, change) for one, step in zip(groups, steps, strict=True)]


def _used(
    groups: tuple[Group, Group, Group], weights: Array, prior: _Prior, solution: _Solution
) -> Array:
    """Return the degrees of freedom that the estimate takes from each group, shape (3,)."""
    h = 1e-3
    shifts = weights * np.exp(h * np.eye(3))
    logarithms = np.array([_solved(groups, shifted, prior).logarithm for shifted in shifts])
    return (logarithms - solution.logarithm) / h
