"""The region that holds the position of a robot with a given probability, in exponential coordinates.

After a long drive the positions that a robot may have form a banana, not an ellipse. In exponential
coordinates `xi = log(pose^-1 q)` of SE(2) about the reported pose, the distribution of the true pose q is
nearly Gaussian. Here it is taken for the Gaussian of mean zero whose second moments about the reported
pose are the given ones: exact to all orders of the exponential map, where the sources propagate to first
(Long et al.) and to fourth order (Barfoot and Furgale).

The region of positions is the projection of the ellipsoid `xi^T covariance^-1 xi <= quantile` onto the
plane, with the quantile of two degrees of freedom.

Sources: Long, Wolfe, Mashner and Chirikjian, "The banana distribution is Gaussian", 2012; Barfoot and
Furgale, "Associating uncertainty with three-dimensional poses for use in estimation problems", 2014.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._checks import array
from diffdrive_jacobian.simulation.odometry_noise import covariance_entries

Array = NDArray[np.float64]
QUANTILE = -2.0 * math.log(0.05)
"""95 % quantile of chi-squared with two degrees of freedom."""
_THINNEST = 1e-3
"""Least ratio of the axes of the position's spread at a given heading."""
_STEPS = 0.25
"""Step of the headings that are tried, in their standard deviations at a given position."""
_MOST_HEADINGS = 4001


class ExponentialGaussian(NamedTuple):
    """A Gaussian of poses in exponential coordinates about a reported pose."""

    pose: Array
    """`[x, y, theta]`, shape (3,)."""
    covariance: Array
    """Covariance of `xi = [along, across, turn]`, shape (3, 3) (m, m, rad)."""


def exponential_gaussian(pose: ArrayLike, second_moment: ArrayLike) -> ExponentialGaussian:
    """Find the Gaussian in exponential coordinates whose second moment about the pose is a given one.

    Args:
        pose: The reported pose, shape (3,).
        second_moment: `E[(q - pose) (q - pose)^T]` as published in odometry, shape (3, 3).

    Returns:
        The Gaussian. A covariance that no such Gaussian has is replaced by the nearest one.

    Raises:
        ValueError: A shape is wrong, an entry not finite, or the second moment is not symmetric and
            positive semidefinite.
    """
    place = array('pose', pose, 3)
    moment = array('second_moment', second_moment, 3, 3)
    if place.ndim != 1 or moment.ndim != 2:
        raise ValueError(
            f'pose and second_moment must have shapes (3,) and (3, 3), got {place.shape}, {moment.shape}'
        )
    xx, xy, xt, yy, yt, s = covariance_entries('second_moment', moment)
    back = complex(math.cos(place[2]), -math.sin(place[2]))
    mixed, pseudo = complex(xt, yt) * back, complex(xx - yy, 2.0 * xy) * back * back
    # With V = (exp(i t) - 1) / (i t) the position is V rho: rho = slope t + rest, the rest independent.
    decay = math.exp(-s / 2.0)
    slope = mixed / (s * decay) if s * decay > 0.0 else 0.0j
    size, square = _mean_squares(s)
    # E[|V t|^2] and E[(V t)^2].
    drop = math.expm1(-s / 2.0)
    turned, turned_2 = -2.0 * drop, -(math.expm1(-2.0 * s) - 2.0 * drop)
    trace = (xx + yy - abs(slope) ** 2 * turned) / size
    pseudo = (pseudo - slope * slope * turned_2) / square
    rest = np.array([[trace + pseudo.real, pseudo.imag], [pseudo.imag, trace - pseudo.real]]) / 2.0
    values, vectors = np.linalg.eigh(rest)
    floor = _THINNEST**2 * max(float(values[1]), _THINNEST**2 * (xx + yy))
    rest = vectors * np.maximum(values, floor) @ vectors.T
    covariance = np.empty((3, 3))
    line = np.array([slope.real, slope.imag])
    covariance[:2, :2] = rest + s * np.outer(line, line)
    covariance[:2, 2] = covariance[2, :2] = s * line
    covariance[2, 2] = s
    return ExponentialGaussian(place, covariance)


def region_distance(gaussian: ExponentialGaussian, positions: ArrayLike) -> Array:
    """Compute the squared distance of positions, normalized: at most `QUANTILE` within the 95 % region.

    It is the least `xi^T covariance^-1 xi` over all headings, found among a grid of headings.

    Args:
        gaussian: The distribution of poses.
        positions: `[x, y]`, shape (..., 2) (m).

    Returns:
        The squared distances, shape (...). They are exact near the region, and too large far from it.

    Raises:
        ValueError: The positions have another shape, or are not finite.
    """
    points = array('positions', positions, 2)
    covariance, (x, y, theta) = gaussian.covariance, gaussian.pose.tolist()
    offsets = (points[..., 0] - x + 1j * (points[..., 1] - y)) * complex(
        math.cos(theta), -math.sin(theta)
    )
    s = float(covariance[2, 2])
    line = covariance[:2, 2] / s if s > 0.0 else np.zeros(2)
    rest = covariance[:2, :2] - s * np.outer(line, line)
    determinant = rest[0, 0] * rest[1, 1] - rest[0, 1] ** 2
    if not determinant > 0.0:
        return np.where(offsets == 0.0, 0.0, np.inf)
    a, b, c = rest[1, 1] / determinant, -rest[0, 1] / determinant, rest[0, 0] / determinant
    reach = math.sqrt(1.5 * QUANTILE * s)
    precision = (a * line[0] ** 2 + 2.0 * b * line[0] * line[1] + c * line[1] ** 2) + 1.0 / max(s, 1e-300)
    half = min(math.ceil(reach * math.sqrt(precision) / _STEPS), _MOST_HEADINGS // 2)
    least = np.full(offsets.shape, np.inf)
    previous, before = least, least
    for turn in np.linspace(-reach, reach, 2 * half + 1).tolist() if half else [0.0]:
        bend = np.exp(0.5j * turn) * np.sinc(turn / (2.0 * np.pi))
        rho = offsets / bend if abs(bend) > 1e-9 else np.full_like(offsets, np.inf)
        along, across = rho.real - line[0] * turn, rho.imag - line[1] * turn
        distance = a * along**2 + 2.0 * b * along * across + c * across**2
        distance += turn * turn / s if s > 0.0 else 0.0
        np.minimum(least, distance, out=least)
        # Between three headings the least of a parabola.
        with np.errstate(all='ignore'):
            bent = before - 2.0 * previous + distance
            lower = previous - (distance - before) ** 2 / (8.0 * bent)
        inside = (previous <= before) & (previous <= distance) & (bent > 0.0) & np.isfinite(lower)
        np.minimum(least, np.where(inside, lower, np.inf), out=least)
        before, previous = previous, distance
    return np.maximum(least, 0.0)


def _mean_squares(s: float) -> tuple[float, float]:
    """Compute E[|V|^2] and E[V^2], `V = (exp(i t) - 1) / (i t)`, of a Gaussian t with variance s."""
    if s < 1e-8:
        return 1.0 - s / 12.0, 1.0 - 7.0 * s / 12.0
    root = math.sqrt(s / 2.0)

    def even(reach: float) -> float:
        return math.sqrt(math.pi) / (2.0 * root) * math.erf(reach * root)

    def odd(reach: float) -> float:
        return -math.expm1(-reach * reach * s / 2.0) / s

    return 2.0 * (even(1.0) - odd(1.0)), 2.0 * (odd(1.0) + even(2.0) - even(1.0)) - odd(2.0)
