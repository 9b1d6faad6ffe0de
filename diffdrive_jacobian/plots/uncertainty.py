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

"""The uncertainty of the odometry along a path: the region that holds the robot with 95 % probability.

The region is that of `simulation.pose_region`, in exponential coordinates of SE(2) to all orders. It
follows from the recorded covariances: the growth of that of the pose and the ratios in that of the twist
give the noise of the wheels. The ellipse of the published second moment is for comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.bags.timeline import Array, Indices, Timeline
from diffdrive_jacobian.messages.topics import OF_POSE
from diffdrive_jacobian.simulation.odometry_noise import covariance_of_pose
from diffdrive_jacobian.simulation.pose_region import (
    ELLIPSE_LEVEL,
    Region,
    region_distance,
    region_of,
    sampled_errors,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

PLACES = 6
"""Number of regions along a path."""
TURN, PIECES = 0.2, 120
"""Largest turn of one piece of the path that is sampled (rad), and least number of its pieces."""
GRID = 121
"""Number of points along each side of the grid on which the outline of a region is found."""
SMALLEST = 1e-4
"""Size below which a region is not drawn (m)."""
FILL, OUTLINE, ELLIPSE = '#c9b8ef', '#7a4fd0', '#7f7f7f'
REGION_LABEL = 'the robot truly is in here with 95 %'
SLIPPING = f'{REGION_LABEL}, if\nits wheels slip (wheel_travel_variance {{:g}} m)'
ELLIPSE_LABEL = 'what the covariance in odom says alone'
DIFFERENCE = 0.3
"""Least difference of an ellipse from the region, as a part of its size, for it to be drawn."""


class Uncertainty(NamedTuple):
    """The uncertainty at one odometry message."""

    region: Region
    extent: Array
    """Least and greatest x and y of the runs that were drawn, shape (2, 2) (m)."""
    second_moment: Array
    """Of x and y, as published, shape (2, 2) (m^2)."""


def uncertainties(one: Timeline, places: int = PLACES) -> list[Uncertainty]:
    """Return the uncertainty at evenly spaced places along a path, the last one at its end.

    There is none if the odometry has no covariance that grows by the noise of wheels.
    """
    run = one.run
    covariances, poses = run.odometry_covariances, run.odometry.values[:, :3]
    if len(covariances) != len(poses) or not _of_wheels(covariances, one.breaks):
        return []
    begins = [0, *one.breaks.tolist()]
    found = []
    travelled = one.travelled()
    wanted = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], places + 1)[1:])
    wanted = np.unique([*wanted.tolist(), len(poses) - 1])
    for begin, end in zip(begins, [*begins[1:], len(poses)], strict=True):
        here = wanted[(wanted >= begin) & (wanted < end)]
        if len(here):
            found += _along(poses, covariances, _knots(poses, begin, here), here)
    return found


def draw_uncertainty(plane: Axes, found: Sequence[Uncertainty]) -> bool:
    """Draw regions along a path, and those ellipses that differ from them; return whether one does."""
    drawn = False
    for uncertainty in found:
        (left, low), (right, high) = uncertainty.extent
        size = max(right - left, high - low)
        margin = 0.15 * size
        x, y = np.meshgrid(
            np.linspace(left - margin, right + margin, GRID),
            np.linspace(low - margin, high + margin, GRID),
        )
        # The square root is nearly linear across the outline.
        root = np.sqrt(region_distance(uncertainty.region, np.stack([x, y], axis=-1)))
        edge = float(np.sqrt(uncertainty.region.level))
        plane.contourf(x, y, root, [0.0, edge], colors=[FILL], alpha=0.5, zorder=1.2)
        plane.contour(x, y, root, [edge], colors=[OUTLINE], linewidths=0.9, zorder=1.3)
        ellipse = _ellipse(uncertainty)
        apart = np.sqrt(region_distance(uncertainty.region, ellipse)) / edge - 1.0
        if np.abs(apart).max() > DIFFERENCE:
            drawn = True
            plane.plot(*ellipse.T, color=ELLIPSE, lw=0.9, ls='--', zorder=1.4)
    return drawn


def uncertainty_marks(run: Run, *, ellipses: bool) -> list[Patch | Line2D]:
    """Return the legend of the regions and, if there are any, the ellipses."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    variance = run.number_of_node('virtual_robot', 'wheel_travel_variance', np.nan)
    label = REGION_LABEL if np.isnan(variance) else SLIPPING.format(variance)
    marks: list[Patch | Line2D] = [Patch(fc=FILL, ec=OUTLINE, alpha=0.7, label=label)]
    if ellipses:
        marks.append(Line2D([], [], color=ELLIPSE, lw=0.9, ls='--', label=ELLIPSE_LABEL))
    return marks


def _of_wheels(covariances: Array, breaks: Indices) -> bool:
    """Return whether covariances are valid and grow as those of wheels do."""
    if not np.isfinite(covariances).all():
        return False
    growth = np.diff(covariances[:, OF_POSE.index('tt')])
    growth[breaks - 1] = 0.0
    if not (np.all(growth >= 0.0) and np.any(growth > 0.0) and np.any(covariances[:, 8] > 0.0)):
        return False
    try:
        for row in covariances[[0, -1]]:
            covariance_of_pose('covariance', _matrix(row))
    except ValueError:
        return False
    return bool(np.all(covariances[:, 6] * covariances[:, 8] >= 0.99999 * covariances[:, 7] ** 2))


def _knots(poses: Array, begin: int, wanted: Indices) -> Indices:
    """Return the messages between which the path is sampled piece by piece."""
    end = int(wanted[-1])
    measure = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.unwrap(poses[begin : end + 1, 2]))))])
    measure = measure / TURN + np.linspace(0.0, PIECES, end - begin + 1)
    even = np.searchsorted(measure, np.arange(np.ceil(measure[-1])))
    return np.asarray(np.unique([begin, *(begin + even).tolist(), *wanted.tolist()]), dtype=np.int64)


def _along(poses: Array, covariances: Array, knots: Indices, wanted: Indices) -> list[Uncertainty]:
    """Return the uncertainty at some of the knots."""
    growth = np.diff(covariances[:, 5], prepend=covariances[0, 5])
    rates = covariances[:, 6:] / np.where(covariances[:, 8] > 0.0, covariances[:, 8], np.inf)[:, None]
    # A robot that has stopped since the message before moved as it did then.
    stopped = np.flatnonzero(covariances[1:, 8] <= 0.0) + 1
    rates[stopped] = rates[stopped - 1]
    rates[:, 2] = 1.0
    added = np.cumsum(growth[:, None] * rates, axis=0)
    noise = np.diff(added[knots], axis=0)
    noise[:, [0, 2]] = np.maximum(noise[:, [0, 2]], 0.0)
    errors = sampled_errors(poses[knots], noise, _matrix(covariances[knots[0]]))
    places = set(wanted.tolist())
    found = []
    for index, runs in zip(knots.tolist(), errors, strict=True):
        if index in places:
            points = poses[index, :2] + runs[:, :2]
            extent = np.stack([points.min(axis=0), points.max(axis=0)])
            if np.ptp(extent, axis=0).max() < SMALLEST:
                continue
            moment = _matrix(covariances[index])[:2, :2]
            found.append(Uncertainty(region_of(poses[index], runs), extent, moment))
    return found


def _matrix(row: Array) -> Array:
    """Return the covariance of the pose, shape (3, 3)."""
    return np.asarray(row)[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def _ellipse(uncertainty: Uncertainty) -> Array:
    """Return the outline of the 95 % ellipse, shape (n, 2)."""
    values, vectors = np.linalg.eigh(uncertainty.second_moment)
    angles = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    axes = vectors * np.sqrt(ELLIPSE_LEVEL * np.maximum(values, 0.0))
    outline: Array = uncertainty.region.pose[:2] + (axes @ circle).T
    return outline
