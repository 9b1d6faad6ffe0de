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

"""Where everything is in a figure of runs. Each text has its room, so that nothing overlaps.

All sizes are inches, and places are those from the top left corner.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from diffdrive_jacobian.bags.timeline import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 11.0
"""Width of the figure."""
PLANE_WIDTH, PLANE_LEAST = 5.0, 2.4
"""Width of the plane beside the panels, at most and at least."""
WIDE, WIDE_WIDTH, WIDE_HEIGHT = 1.6, 6.9, 3.4
"""The plane is above the panels if it is so many times wider than high, and has at most this size."""
PANEL_HEIGHT, LEAST_HEIGHT = 1.59, 4.2
"""Height of a panel over time with its title, and least one of all in a column."""
TICKS, TITLE, AXIS, EDGE = 0.62, 0.34, 0.5, 0.12
"""Room for tick labels left of axes, for a title above, for tick labels and the label below, and at the
edge of the figure."""
LINE, HEADER_LINE, NOTE_LINE, LETTER = 0.2, 0.26, 0.17, 0.066
"""Height of a line of a legend, of the header and of a note, and width of a letter of a legend."""
RUNS = 10
"""Number of runs beyond which their lines shrink."""
GREY = '#777777'


class Arrangement(NamedTuple):
    """The plane and the panels over time."""

    above: bool
    """Whether the plane is above the panels, not beside them."""
    plane_width: float
    plane_height: float
    rows: int
    columns: int

    @property
    def panels_height(self) -> float:
        """Height of all rows of panels with their titles."""
        return max(self.rows * PANEL_HEIGHT, 0.0 if self.above else LEAST_HEIGHT)


class Texts(NamedTuple):
    """What stands around the axes."""

    header: Sequence[str]
    runs: Sequence[Any]
    """Lines with the runs as their labels; none for a single run."""
    marks: Sequence[Any]
    """What is drawn, with labels."""
    notes: Sequence[str]


def arrange(bounds: Array, count: int) -> Arrangement:
    """Return the arrangement for what the plane shows, shape (2, 2) (m), and a number of panels."""
    width, height = (bounds[1] - bounds[0]).tolist()
    aspect = width / height
    if aspect > WIDE:
        columns = 2 if count in (2, 4) else 3
        wide = min(WIDE_WIDTH, WIDE_HEIGHT * aspect)
        return Arrangement(True, wide, wide / aspect, math.ceil(count / columns), columns)
    columns = 1 if count == 2 else 2
    rows = math.ceil(count / columns)
    room = max(rows * PANEL_HEIGHT, LEAST_HEIGHT) - TITLE
    wide = min(max(room * aspect, PLANE_LEAST), PLANE_WIDTH)
    tall = min(room, wide / aspect)
    return Arrangement(False, tall * aspect, tall, rows, columns)


def lay_out(
    drawing: Figure,
    plane: Axes,
    panels: Sequence[Axes],
    arrangement: Arrangement,
    texts: Texts,
    time_label: str,
) -> None:
    """Give the figure its size and the axes their places, and write the texts around them.

    Args:
        drawing: The figure.
        plane: Axes of the plane.
        panels: Axes over time.
        arrangement: Their arrangement.
        texts: What stands around them.
        time_label: Label of the lowest panels.
    """
    above, plane_width, plane_height, _, columns = arrangement
    marks_lines = sum(one.get_label().count('\n') + 1 for one in texts.marks)
    marks_height = LINE * marks_lines + 0.1
    longest = max(len(line) for one in texts.marks for line in one.get_label().split('\n'))
    marks_width = 0.55 + LETTER * longest
    right_of_plane = EDGE + TICKS + max(plane_width, PLANE_LEAST) + 0.25
    run_line = LINE * min(1.0, RUNS / max(len(texts.runs), 1))
    runs_top = EDGE + HEADER_LINE * len(texts.header)
    top = runs_top + run_line * len(texts.runs) + 0.1
    if above:
        marks_fit = marks_height <= plane_height + AXIS
        marks_fit &= right_of_plane + marks_width <= WIDTH - EDGE
        plane_top, panels_left = top, EDGE
        panels_top = top + plane_height + AXIS + TITLE
        marks_at = right_of_plane, top
    else:
        marks_fit = marks_height <= arrangement.panels_height - TITLE - plane_height - 0.1
        marks_fit &= EDGE + TICKS + marks_width <= right_of_plane + TICKS
        plane_top = panels_top = top + TITLE
        panels_left = right_of_plane
        marks_at = EDGE + TICKS - 0.1, plane_top + plane_height + AXIS
    bottom = panels_top + arrangement.panels_height - TITLE + AXIS
    marks_columns = 1
    if not marks_fit:
        # In rows below everything.
        marks_at = EDGE, bottom + 0.1
        marks_columns = max(1, int((WIDTH - 2.0 * EDGE) / marks_width))
        bottom += LINE * math.ceil(marks_lines / marks_columns) + 0.15
    paper = _Paper(drawing, bottom + EDGE + NOTE_LINE * len(texts.notes))
    for index, text in enumerate(texts.header):
        size = 12.0 if index == 0 and not texts.runs else 10.0
        paper.write(EDGE + 0.1, EDGE + HEADER_LINE * index, text, fontsize=size)
    if texts.runs:
        paper.legend(EDGE, runs_top, texts.runs, 1, min(9.0, 45.0 * run_line))
    paper.place(plane, EDGE + TICKS, plane_top, plane_width, plane_height)
    width = (WIDTH - EDGE - panels_left) / columns
    height = arrangement.panels_height / arrangement.rows
    for index, panel in enumerate(panels):
        row, column = divmod(index, columns)
        left, last = panels_left + column * width + TICKS, index + columns >= len(panels)
        paper.place(panel, left, panels_top + row * height, width - TICKS - 0.08, height - TITLE)
        panel.tick_params(labelbottom=last)
        panel.set_xlabel(time_label if last else '')
    paper.legend(*marks_at, texts.marks, marks_columns, 9.0)
    for index, text in enumerate(texts.notes):
        paper.write(EDGE + 0.1, bottom + NOTE_LINE * index, text, fontsize=8.0, color=GREY)


class _Paper:
    """A figure whose places are given from its top left corner."""

    def __init__(self, drawing: Figure, height: float) -> None:
        self._drawing, self._height = drawing, height
        drawing.set_size_inches(WIDTH, height)

    def place(self, axes: Axes, x: float, y: float, width: float, height: float) -> None:
        low = 1.0 - (y + height) / self._height
        axes.set_position((x / WIDTH, low, width / WIDTH, height / self._height))

    def write(self, x: float, y: float, text: str, **style: Any) -> None:
        self._drawing.text(x / WIDTH, 1.0 - y / self._height, text, va='top', **style)

    def legend(self, x: float, y: float, handles: Sequence[Any], columns: int, size: float) -> None:
        self._drawing.legend(
            handles=handles,
            loc='upper left',
            bbox_to_anchor=(x / WIDTH, 1.0 - y / self._height),
            ncol=columns,
            fontsize=size,
            handlelength=2.6,
            borderaxespad=0.0,
            borderpad=0.0,
            labelspacing=0.45,
        )
