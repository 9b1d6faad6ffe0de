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

"""Elements of drawings to scale: vectors, frames, angles, dimensions, and the robot from above.

Coordinates are those of the drawing (m). Labels are TeX in the style of matplotlib. They are moved from
where they belong by an offset (points), so that they keep clear of lines at every scale. `style` has
properties of the line, arrow or text.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_jacobian.kinematics import se2

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

INK, GREY, FILL = '#000000', '#777777', '#eeeeee'
BLUE, RED, GREEN = '#0072B2', '#D55E00', '#009E73'
"""Colors of Okabe and Ito. What they tell apart differs in its label or its line style as well."""
DASHED: Any = (0, (4, 3))
LABEL = 11.0
"""Size of labels (points)."""
BODY = np.array([[-0.35, -0.42], [0.55, -0.42], [0.8, -0.2], [0.8, 0.2], [0.55, 0.42], [-0.35, 0.42]])
"""Outline of the body of a robot, in wheel separations."""
TYRE = 0.1
"""Width of a wheel, in wheel separations."""


def canvas(width: float, x: tuple[float, float], y: tuple[float, float]) -> tuple[Figure, Axes]:
    """Return a figure of a width (inches) from end to end along x and y, without visible axes."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(width, width * (y[1] - y[0]) / (x[1] - x[0])))
    axes = drawing.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=x, ylim=y, aspect='equal')
    axes.set_axis_off()
    return drawing, axes


def label(
    axes: Axes, text: str, at: ArrayLike, offset: tuple[float, float] = (0.0, 0.0), **style: Any
) -> None:
    """Write a text with its middle at a place, moved by an offset (points)."""
    x, y = np.asarray(at, dtype=np.float64)
    style = {'ha': 'center', 'va': 'center', 'fontsize': LABEL, **style}
    axes.annotate(text, (x, y), offset, textcoords='offset points', **style)


def point(
    axes: Axes, at: ArrayLike, text: str = '', offset: tuple[float, float] = (0.0, 0.0), **style: Any
) -> None:
    """Draw a point with a label."""
    x, y = np.asarray(at, dtype=np.float64)
    color = style.get('color', INK)
    axes.plot([x], [y], 'o', ms=5.0, color=color, zorder=4)
    label(axes, text, at, offset, **style)


def line(axes: Axes, *points: ArrayLike, **style: Any) -> None:
    """Draw a line through points."""
    x, y = np.array([np.asarray(one, dtype=np.float64) for one in points]).T
    axes.plot(x, y, **{'color': INK, 'lw': 1.0, **style})


def arrow(
    axes: Axes,
    start: ArrayLike,
    vector: ArrayLike,
    text: str = '',
    offset: tuple[float, float] = (0.0, 0.0),
    **style: Any,
) -> None:
    """Draw a vector from a start, with a label at its tip, moved by an offset (points)."""
    x, y = np.asarray(start, dtype=np.float64)
    dx, dy = np.asarray(vector, dtype=np.float64)
    style = {'arrowstyle': '-|>', 'mutation_scale': 12.0, 'lw': 1.6, 'color': INK, **style}
    style |= {'shrinkA': 0.0, 'shrinkB': 0.0}
    axes.annotate('', (x + dx, y + dy), (x, y), arrowprops=style)
    label(axes, text, [x + dx, y + dy], offset, color=style['color'])


def frame(axes: Axes, pose: ArrayLike, length: float, x: str, y: str, **style: Any) -> None:
    """Draw the axes of a frame at a pose, with the labels x and y at their tips."""
    origin, apart = placed([0.0, 0.0], pose), 11.0
    for direction, text in (([length, 0.0], x), ([0.0, length], y)):
        tip = placed(direction, pose)
        along = apart * (tip - origin) / length
        arrow(axes, origin, tip - origin, text, (along[0], along[1]), **{'lw': 1.2, **style})


def angle(
    axes: Axes, centre: ArrayLike, radius: float, start: float, end: float, text: str, **style: Any
) -> None:
    """Draw an angle (rad) as an arc with an arrow, and its label in the middle, outside the arc."""
    middle, over = np.asarray(centre, dtype=np.float64), (start + end) / 2.0
    directions = np.linspace(start, end, 60)
    arc = middle + radius * np.column_stack([np.cos(directions), np.sin(directions)])
    style = {'lw': 1.2, 'color': INK, **style}
    line(axes, *arc[:-1], **style)
    arrow(axes, arc[-4], arc[-1] - arc[-4], **style)
    apart = 12.0
    at = middle + radius * np.array([np.cos(over), np.sin(over)])
    label(axes, text, at, (apart * np.cos(over), apart * np.sin(over)), color=style['color'])


def dimension(
    axes: Axes, start: ArrayLike, end: ArrayLike, aside: float, text: str, **style: Any
) -> None:
    """Draw a distance as a line with two arrows, so far to the left of it, and its label."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    left = np.array([a[1] - b[1], b[0] - a[0]]) / np.hypot(*(b - a))
    for one in (a, b):
        line(axes, one, one + aside * left, color=GREY, lw=0.6)
    arrow(axes, a + aside * left, b - a, arrowstyle='<|-|>', lw=0.9, color=GREY, mutation_scale=9.0)
    apart = 10.0 * (1.0 if aside >= 0.0 else -1.0) * left
    label(axes, text, (a + b) / 2.0 + aside * left, (apart[0], apart[1]), **style)


def placed(points: ArrayLike, pose: ArrayLike) -> NDArray[np.float64]:
    """Return points of a frame at a pose in coordinates of the drawing, shape (..., 2)."""
    H = se2.homogeneous(pose)
    placed_points: NDArray[np.float64] = np.asarray(points, dtype=np.float64) @ H[:2, :2].T + H[:2, 2]
    return placed_points


def outline(axes: Axes, points: ArrayLike, **style: Any) -> None:
    """Draw a closed, filled polygon."""
    from matplotlib.patches import Polygon

    corners = np.asarray(points, dtype=np.float64)
    axes.add_patch(Polygon(corners, closed=True, **{'fc': 'none', 'ec': INK, 'lw': 1.0, **style}))


def robot(axes: Axes, pose: ArrayLike, r: float, L: float) -> None:
    """Draw a robot with wheel radius r and separation L from above: body, axle and wheels."""
    outline(axes, placed(L * BODY, pose), fc=FILL, ec=GREY)
    wheels(axes, pose, r, L)


def wheels(axes: Axes, pose: ArrayLike, r: float, L: float, zorder: float = 3.0, **style: Any) -> None:
    """Draw the wheels of a robot from above with their axle."""
    axle = placed([[0.0, -L / 2.0], [0.0, L / 2.0]], pose)
    line(axes, *axle, lw=2.0, color=GREY, zorder=zorder - 1.0, **style)
    for wheel in wheel_outlines(r, L):
        outline(axes, placed(wheel, pose), fc='#bbbbbb', zorder=zorder, **style)


def wheel_outlines(r: float, L: float) -> list[NDArray[np.float64]]:
    """Return the outlines of the right and the left wheel in the body frame, shape (4, 2) each (m)."""
    half = TYRE * L / 2.0
    return [
        np.array([[-r, side - half], [r, side - half], [r, side + half], [-r, side + half]])
        for side in (-L / 2.0, L / 2.0)
    ]
