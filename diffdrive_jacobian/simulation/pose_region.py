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

"""The region that holds the position of a robot with a given probability, in exponential coordinates.

It is the projection of the ellipsoid `xi^T covariance^-1 xi <= level` onto the plane, with
`xi = log(pose^-1 q)` about the reported pose. Covariance and level are those of runs of the noise model
along the reported path, drawn with a fixed seed, of which 95 % are within.

Sources: doc/moments.md, "Odometry covariance"; Long, Wolfe, Mashner and Chirikjian, "The banana
distribution is Gaussian", 2012; Barfoot and Furgale, "Associating uncertainty with three-dimensional
poses for use in estimation problems", 2014.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics.se2 import compose, inverse, log
from diffdrive_jacobian.numerics.checks import array
from diffdrive_jacobian.simulation.odometry_noise import covariance_of_pose

Array = NDArray[np.float64]
PROBABILITY = 0.95
ELLIPSE_LEVEL = -2.0 * math.log(1.0 - PROBABILITY)
"""Level of the ellipse that holds 95 % of a Gaussian in the plane: a quantile of chi-squared."""
RUNS = 10_000
"""Number of runs that are drawn."""
_THINNEST = 1e-4
"""Least ratio of the standard deviations of the position at a given heading."""
_STEPS = 0.25
"""Step of the headings that are tried, in their standard deviations at a given position."""
_MOST_HEADINGS = 4001
_BLOCK = 1 << 16
"""Number of distances that are computed at once."""
_STRAIGHTEST = 1e-9
"""Least ratio of chord and arc, so that a full turn divides by no zero."""


class Region(NamedTuple):
    """A region of positions about a reported pose."""

    pose: Array
    """The reported pose, `[x, y, theta]`, shape (3,)."""
    covariance: Array
    """Second moment of `xi = [along, across, turn]`, shape (3, 3) (m, m, rad)."""
    level: float
    """Largest distance, as `region_distance` returns it, within the region."""


def sampled_errors(
    poses: ArrayLike, noise: ArrayLike, covariance: ArrayLike, *, seed: int = 0, count: int = RUNS
) -> Iterator[Array]:
    """Draw runs of the noise model along a reported path. Yield their errors at each of its poses.

    Args:
        poses: Reported poses, shape (n, 3).
        noise: Variances that the noise adds between the poses: those of the distance travelled, of
            distance and turn, and of the turn, shape (n - 1, 3) (m^2, m rad, rad^2).
        covariance: Covariance of the error of the first pose, which is Gaussian, shape (3, 3).
        seed: Seed of the random numbers.
        count: Number of runs.

    Yields:
        The errors `[x, y, theta]` relative to the reported pose, heading unwrapped, shape (count, 3).

    Raises:
        ValueError: A shape is wrong, an entry is not finite, or a variance is negative.
    """
    poses, noise = array('poses', poses, 3), array('noise', noise, 3)
    if poses.ndim != 2 or noise.shape != (len(poses) - 1, 3):
        raise ValueError(
            f'poses and noise must have shapes (n, 3) and (n - 1, 3), got {poses.shape}, {noise.shape}'
        )
    if np.any(noise[:, [0, 2]] < 0.0):
        raise ValueError('noise must have variances that are zero or positive')
    covariance = covariance_of_pose('covariance', covariance)
    rng = np.random.default_rng(seed)
    errors = rng.normal(size=(count, 3)) @ _root(covariance)
    yield errors
    x, y, turned = errors.T
    for (before, after), (vv, vw, ww) in zip(pairwise(poses), noise.tolist(), strict=True):
        along, across, turn = log(compose(inverse(before), after)).tolist()
        draws = rng.normal(size=(count, 2)) @ _root(np.array([[vv, vw], [vw, ww]]))
        bent = turn + draws[:, 1]
        # The arc of the disturbed twist from the true heading, in complex numbers.
        heading = np.exp(1j * (before[2] + turned + bent / 2.0)) * np.sinc(bent / (2.0 * np.pi))
        moved = (along + draws[:, 0] + 1j * across) * heading
        dx, dy = (after[:2] - before[:2]).tolist()
        x, y, turned = x + moved.real - dx, y + moved.imag - dy, turned + draws[:, 1]
        yield np.array([x, y, turned]).T


def region_of(pose: ArrayLike, errors: ArrayLike) -> Region:
    """Return the region that holds 95 % of the positions of some runs.

    Args:
        pose: The reported pose, shape (3,).
        errors: Errors of the runs relative to it, as `sampled_errors` yields them, shape (n, 3).

    Raises:
        ValueError: A shape is wrong, or an entry is not finite.
    """
    place, errors = array('pose', pose, 3), array('errors', errors, 3)
    if place.ndim != 1 or errors.ndim != 2 or not len(errors):
        raise ValueError(
            f'pose and errors must have shapes (3,) and (n, 3), got {place.shape} and {errors.shape}'
        )
    xi = log_about(place, errors)
    region = Region(place, xi.T @ xi / len(xi), ELLIPSE_LEVEL)
    distances = region_distance(region, place[:2] + errors[:, :2])
    level = float(np.quantile(distances, PROBABILITY))
    return region._replace(level=level if math.isfinite(level) and level > 0.0 else ELLIPSE_LEVEL)


def log_about(pose: ArrayLike, errors: ArrayLike) -> Array:
    """Return errors of x, y and heading (unwrapped) in exponential coordinates, shape (n, 3)."""
    theta = float(np.asarray(pose, dtype=np.float64)[2])
    x, y, turned = array('errors', errors, 3).T
    bend = np.exp(1j * (theta + turned / 2.0)) * np.sinc(turned / (2.0 * np.pi))
    rho = (x + 1j * y) / np.where(np.abs(bend) > _STRAIGHTEST, bend, _STRAIGHTEST)
    return np.column_stack([rho.real, rho.imag, turned])


def region_distance(region: Region, positions: ArrayLike) -> Array:
    """Compute the normalized squared distance of positions: at most the level within the region.

    It is the least `xi^T covariance^-1 xi` over all headings, found among a grid of headings.

    Args:
        region: The region.
        positions: `[x, y]`, shape (..., 2) (m).

    Returns:
        The squared distances, shape (...). They are exact near the region, and too large far from it.

    Raises:
        ValueError: The positions have another shape, or are not finite.
    """
    points = array('positions', positions, 2)
    covariance, (x, y, theta) = region.covariance, region.pose.tolist()
    offsets = (points[..., 0] - x + 1j * (points[..., 1] - y)) * complex(
        math.cos(theta), -math.sin(theta)
    )
    s = float(covariance[2, 2])
    line = covariance[:2, 2] / s if s > 0.0 else np.zeros(2)
    rest = covariance[:2, :2] - s * np.outer(line, line)
    values, vectors = np.linalg.eigh(rest)
    if not values[1] > 0.0:
        return np.where(offsets == 0.0, 0.0, np.inf)
    # Of a position at a given heading: `|whitening @ error|^2` is the squared distance.
    whitening = (vectors / np.sqrt(np.maximum(values, values[1] * _THINNEST**2))).T
    slope = whitening @ line
    reach = math.sqrt(2.0 * max(region.level, ELLIPSE_LEVEL) * s)
    precision = float(slope @ slope) + 1.0 / max(s, 1e-300)
    half = min(math.ceil(reach * math.sqrt(precision) / _STEPS), _MOST_HEADINGS // 2)
    turns = np.linspace(-reach, reach, 2 * half + 1) if half else np.zeros(1)
    bend = np.exp(0.5j * turns) * np.sinc(turns / (2.0 * np.pi))
    straightened = 1.0 / np.where(np.abs(bend) > _STRAIGHTEST, bend, _STRAIGHTEST)
    turned = turns * turns / s if s > 0.0 else turns
    flat = offsets.reshape(-1)
    least = np.empty(flat.shape)
    size = max(1, _BLOCK // len(turns))
    for begin in range(0, len(flat), size):
        block = slice(begin, begin + size)
        along, across = flat.real[block].copy(), flat.imag[block].copy()
        distance = np.repeat(turned[:, None], len(along), axis=1)
        for row, offset in zip(whitening.tolist(), slope.tolist(), strict=True):
            # The real part of a product is a linear form of x and y.
            weights = complex(row[0], -row[1]) * straightened
            error = weights.real[:, None] * along
            error -= weights.imag[:, None] * across
            error -= (offset * turns)[:, None]
            error *= error
            distance += error
        least[block] = _least(distance)
    distances: Array = np.maximum(least, 0.0).reshape(offsets.shape)
    return distances


def _least(values: Array) -> Array:
    """Return the least of each column, between three values that of a parabola, shape (n,)."""
    count, width = values.shape
    columns, place = np.arange(width), values.argmin(axis=0)
    least: Array = values[place, columns]
    if count < 3:
        return least
    middle = np.clip(place, 1, count - 2)
    before, after = values[middle - 1, columns], values[middle + 1, columns]
    with np.errstate(all='ignore'):
        bent = before - 2.0 * least + after
        lower = least - (after - before) ** 2 / (8.0 * bent)
    inside = (middle == place) & (bent > 0.0) & np.isfinite(lower)
    refined: Array = np.where(inside, lower, least)
    return refined


def _root(covariance: Array) -> Array:
    """Return a symmetric square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(covariance)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root
