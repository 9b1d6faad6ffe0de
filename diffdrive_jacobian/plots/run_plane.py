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

"""The plane of a figure of runs: paths, the robot to scale at start and end, goals and planned paths."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.bags.timeline import Array, Timeline, jumps, tolerance
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.run_lines import line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ARROWS = 12
"""Number of headings along a path."""
NUMBERED, MARKED = 12, 30
"""Numbers of goals beyond which they have no numbers, and of marks that are drawn at most."""
PLANNED, PLANNED_POINTS = '#c8b273', 2000
COLOR = '#222222'
"""Color of the ground truth of a single run. Of several each has that of its path."""
TRUTH: Any = {'ls': (0, (1, 1)), 'lw': 1.8}
"""Line of the ground truth."""
LEAST = 0.5
"""Least width and height of the plane (m): the noise of a robot at rest must not fill it."""
MARGIN = 0.06
"""Margin of the plane, as a part of its larger side."""
OF_DRIVE = 'drive'
"""Mark (gid) of what shows the whole drive, which a film shows little by little."""
VISIBLE = 0.12
"""Wheel separation from which on the robot is drawn to scale (inches)."""
_ARROW: Any = {
    'units': 'inches',
    'scale_units': 'inches',
    'width': 0.022,
    'headwidth': 5.0,
    'headlength': 5.0,
    'headaxislength': 4.5,
}


class Size(NamedTuple):
    """Size of a robot (m)."""

    radius: float
    separation: float


def size(run: Run) -> Size | None:
    """Return wheel radius and separation, if nodes of the run have them as parameters."""
    for values in run.parameters.values():
        found = values.get('wheel_radius'), values.get('wheel_separation')
        if all(isinstance(one, float) and 1e-4 < one < 1e3 for one in found):
            return Size(*found)  # type: ignore[arg-type]
    return None


def extent(timelines: Sequence[Timeline], uncertain: Sequence[Array]) -> Array:
    """Return what the plane shows, `[[left, low], [right, high]]`, shape (2, 2) (m).

    `uncertain` are the extents of regions of uncertainty, of the same shape.
    """
    places = [*uncertain]
    for one in timelines:
        run, robot = one.run, size(one.run)
        places.append(run.odometry.values[:, :2])
        places.append(run.ground_truth.values[:, :2])
        places += [path.poses[:, :2] for path in one.paths]
        reach = tolerance(run)
        goals = run.goals.values[one.goals, :2]
        places += [goals + reach, goals - reach]
        if robot is not None:
            corners = robot.separation * sketch.BODY
            places += [sketch.placed(corners, pose) for pose in run.odometry.values[[0, -1], :3]]
    everything = np.concatenate(places)
    low, high = np.nanmin(everything, axis=0), np.nanmax(everything, axis=0)
    middle = (low + high) / 2.0
    half = np.maximum(high - low, LEAST) / 2.0
    half = half + MARGIN * 2.0 * half.max()
    return np.stack([middle - half, middle + half])


class Plane:
    """The axes of the plane. `to_scale` says whether robots are drawn, else marks."""

    def __init__(self, axes: Axes, bounds: Array, inches: float, timelines: Sequence[Timeline]) -> None:
        """Take the axes with what they show (m), and the width of them (inches)."""
        self.axes, self._bounds = axes, bounds
        self._scale = inches / float(bounds[1, 0] - bounds[0, 0])
        sizes = [size(one.run) for one in timelines]
        self.to_scale = all(one and one.separation * self._scale >= VISIBLE for one in sizes)
        axes.set(xlim=bounds[:, 0], ylim=bounds[:, 1], aspect='equal', xlabel='x [m]', ylabel='y [m]')
        axes.set_autoscale_on(False)
        self.headings = False
        """Whether the heading of a goal was drawn, because it counts."""

    def path(self, one: Timeline, color: str, style: Any, *, alone: bool) -> None:
        """Draw the path with evenly spaced headings, and the robot at its start and its end.

        Of several runs the robots have outlines only, so that all can be seen.
        """
        axes, poses, travelled = self.axes, one.run.odometry.values[:, :3], one.travelled()
        axes.plot(*line(poses[:, :2], one.breaks).T, color=color, ls=style, lw=1.8, gid=OF_DRIVE)
        evenly = np.searchsorted(travelled, np.linspace(0.0, travelled[-1], ARROWS + 1)[1:-1])
        evenly = evenly if self.to_scale else np.append(evenly, len(travelled) - 1)
        x, y, theta = poses[np.unique(evenly)].T
        headings: Any = {**_ARROW, 'color': color, 'zorder': 3, 'scale': 5.0, 'gid': OF_DRIVE}
        axes.quiver(x, y, np.cos(theta), np.sin(theta), **headings)
        starts, robot = poses[[0, *one.breaks[:MARKED]]], size(one.run)
        if self.to_scale and robot is not None:
            for pose in starts:
                self._robot(pose, robot, ec=color, fc='white', alpha=0.6, zorder=1.0, ls='--')
            filled: Any = {'fc': color, 'alpha': 0.4} if alone else {'fc': 'none', 'lw': 1.8}
            self._robot(poses[-1], robot, ec=color, zorder=1.05, **filled, gid=OF_DRIVE)
            return
        axes.plot(*starts[:, :2].T, 'o', ms=9, mfc='white', mec=color, mew=1.8, zorder=2.5)
        axes.plot(*poses[-1, :2], 's', ms=7, mfc=color, mec='white', mew=0.8, zorder=5, gid=OF_DRIVE)

    def _robot(self, pose: Array, robot: Size, *, zorder: float, **style: Any) -> None:
        sketch.outline(
            self.axes, sketch.placed(robot.separation * sketch.BODY, pose), zorder=zorder, **style
        )
        gid = style.get('gid')
        sketch.wheels(self.axes, pose, *robot, zorder=zorder + 0.02, alpha=0.8, gid=gid)

    def ground_truth(self, run: Run, color: str) -> None:
        """Draw the true path with its end, if it was recorded."""
        if len(run.ground_truth):
            places = run.ground_truth.values[:, :2]
            self.axes.plot(
                *line(places, jumps(run.ground_truth)).T, color=color, zorder=2.2, gid=OF_DRIVE, **TRUTH
            )
            end: Any = {'ms': 6, 'mfc': 'white', 'mec': color, 'mew': 1.5, 'zorder': 5, 'gid': OF_DRIVE}
            self.axes.plot(*places[-1], 'D', **end)

    def planned_paths(self, one: Timeline) -> None:
        """Draw the paths that were sent, below the path that was driven."""
        for path in one.paths:
            places = path.poses_at(np.linspace(0.0, path.length, PLANNED_POINTS))[:, :2]
            # A closed path repeats its beginning, not its end.
            places[-1] = path.poses[-1, :2]
            self.axes.plot(*places.T, color=PLANNED, lw=5.0, alpha=0.6, zorder=1.2)

    def goals(self, timelines: Sequence[Timeline]) -> None:
        """Draw each goal once with its tolerance and, where it counts, its heading; number them."""
        from matplotlib.collections import PatchCollection
        from matplotlib.patches import Circle

        axes = self.axes
        goals: dict[tuple[float, float], float] = {}
        headings: dict[tuple[float, float], float] = {}
        for one in timelines:
            counts = np.unique(one.goal[np.isfinite(one.goal_heading_error)])
            for index in one.goals.tolist():
                x, y, theta = one.run.goals.values[index].tolist()
                place = round(x, 6), round(y, 6)
                goals[place] = tolerance(one.run)
                if index in counts:
                    headings[place] = theta
        if not goals:
            return
        cross, depth = (11, 6.0) if len(goals) <= MARKED else (4, 1.5)
        circles = [Circle(place, radius) for place, radius in goals.items()]
        axes.add_collection(PatchCollection(circles, fc='none', ec='black', lw=1.0, zorder=depth))
        places = np.array([*goals])
        axes.plot(*places.T, '+', ms=cross, mew=1.4, color='black', zorder=depth)
        occupied = [line(one.run.odometry.values[:, :2], one.breaks) for one in timelines]
        self.headings = bool(headings)
        if headings:
            theta = np.array([*headings.values()])
            towards = np.column_stack([np.cos(theta), np.sin(theta)])
            style = {**_ARROW, 'width': 0.03, 'scale': 2.2, 'color': 'black', 'zorder': 5.5}
            axes.quiver(*np.array([*headings]).T, *towards.T, **style)
            occupied.append(np.array([*headings]) + 0.4 / self._scale * towards)
        if len(goals) <= NUMBERED:
            names = [f'goal {number}' for number in range(1, len(goals) + 1)]
            self._label(['goal'] if len(goals) == 1 else names, places, np.concatenate(occupied))

    def _label(self, names: Sequence[str], places: Array, occupied: Array) -> None:
        """Write names beside places, where the fewest other points are, and apart from each other."""
        from matplotlib.patheffects import withStroke

        there: list[Array] = []
        low, high = self._scale * self._bounds
        # Of a label, and from its place (inches).
        width, height, gap = 0.075 * max(map(len, names)), 0.17, 0.09
        half = np.array([width, height]) / 2.0
        for name, place in zip(names, places, strict=True):
            best: tuple[float, Array] | None = None
            for far, right, up in product((gap, 3.0 * gap), (1, -1, 0), (1, -1, 0)):
                side = np.array([right, up])
                middle = self._scale * place + side * (far + half)
                apart = [(np.abs(middle - one) >= (width, height)).any() for one in there]
                if not side.any() or not all(apart):
                    continue
                with np.errstate(invalid='ignore'):
                    on_it = np.abs(self._scale * occupied - middle) < (0.6 * width, 0.8 * height)
                near = np.hypot(*(self._scale * places - middle).T) < 0.5 * width
                outside = (middle - half < low).any() or (middle + half > high).any()
                # Corners first: a label beside a goal is crossed by a path along an axis.
                cost = np.count_nonzero(on_it.all(axis=1)) + 50.0 * np.count_nonzero(near)
                cost += 0.5 * (not side.all()) + 9.0 * (far > gap) + 100.0 * outside
                if best is None or cost < best[0]:
                    best = cost, middle
            if best is not None:
                there.append(best[1])
                halo = [withStroke(linewidth=2.0, foreground='white')]
                x, y = best[1] / self._scale
                self.axes.text(x, y, name, ha='center', va='center', zorder=7, path_effects=halo)
