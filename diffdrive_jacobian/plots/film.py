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

"""A film of one or several runs: robots drive through their figure, and a line shows the time."""

from __future__ import annotations

import io
import math
import re
import tempfile
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_jacobian.bags.timeline import Array, Timeline, jumps, seconds, timeline
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.numerics.checks import number, positive
from diffdrive_jacobian.plots import run_panels, sketch
from diffdrive_jacobian.plots.output_files import FILM_FORMATS, check_directory, extension
from diffdrive_jacobian.plots.rendering import styled
from diffdrive_jacobian.plots.run_pictures import COLORS, as_runs, run_figure
from diffdrive_jacobian.plots.run_plane import OF_DRIVE, TRUTH, VISIBLE, size

RATE = 20
"""Frames per second of a film: GIF has periods of whole hundredths of a second."""
MOST_FRAMES = 3000
"""Largest number of frames: a film of two and a half minutes."""
DPI = 90
"""Resolution (dots per inch)."""
HOLD = 1.5
"""How long the last frame stays: a GIF begins again at once (s)."""
INLINE_DPI = 65
LONGEST_FRAME = 0.1
"""Longest duration of a frame in a notebook, unless a speed was given (s)."""
INLINE_FRAMES = 100
"""Largest number of frames of a film in a notebook, each of which is a picture in it."""
MOVES = 'moves'
"""Mark of the lowest artist that moves in an axes."""
LATER = 0.2
"""Opacity of what the robots have not done yet."""
BUTTONS = {
    **{'minus': '-', 'fast-backward': '|<', 'step-backward': '<', 'play fa-flip-horizontal': 'back'},
    **{'pause': '||', 'play': 'play', 'step-forward': '>', 'fast-forward': '>|', 'plus': '+'},
}
"""Icons of the buttons of matplotlib, and what they are here."""
NO_FFMPEG = 'a film in MP4 needs the program ffmpeg, which is not installed; GIF needs none'


class Film:
    """A film of runs. A notebook shows it.

    Attributes:
        frames: Its number of frames, of which the last ones are the same for `HOLD`.
        seconds: Its duration (s).
    """

    def __init__(self, runs: Any, *, speed: float | None = None) -> None:
        """Draw the figure of the runs, into which each frame puts the robots.

        Args:
            runs: As for `run_figure`.
            speed: How much faster than it was the film is. None: 1, or as a long run needs.

        Raises:
            ValueError: The speed is not positive, or so small that there are more than `MOST_FRAMES`.
            BagError, ModuleNotFoundError: As for `run_figure`.
        """
        given = speed is not None
        if speed is not None:
            number('speed', speed, positive)
        shown, runs = runs, as_runs(runs)
        self._timelines = [timeline(run) for run in runs]
        self._zeros = [run_panels.zero(one) for one in self._timelines]
        self._times = [
            np.maximum.accumulate(one.time) - zero
            for one, zero in zip(self._timelines, self._zeros, strict=True)
        ]
        first = min(run_panels.beginning(one) for one in self._timelines)
        last = max(float(times[-1]) for times in self._times)
        least = (last - first) * RATE / (MOST_FRAMES - 2)
        speed = max(1.0, least) if speed is None else speed
        if speed < least:
            raise ValueError(f'speed must be at least {least:.3g} for such a long run, got {speed:g}')
        self.seconds = (last - first) / speed
        moving = int(self.seconds * RATE) + 2
        self._shown = np.append(np.linspace(first, last, moving), np.full(int(HOLD * RATE), last))
        self.frames = len(self._shown)
        self._longest = math.inf if given else LONGEST_FRAME
        self._figure = run_figure(shown)
        self._robots = self._draw()

    def save(self, path: str | Path, *, progress: Callable[[int, int], object] | None = None) -> None:
        """Write it to a file, `.gif` or `.mp4`, which is replaced.

        Args:
            path: The file.
            progress: Called with the number of a frame and that of all.

        Raises:
            UserError: The file has another ending, or there is no ffmpeg for an MP4.
            OSError: It cannot be written.
        """
        file = Path(path)
        # Before it takes a while.
        check_directory(file.parent)
        file.write_bytes(self.content(extension(file), progress))

    def content(self, ending: str, progress: Callable[[int, int], object] | None = None) -> bytes:
        """Return the content of a file of one of the `FILM_FORMATS`; the rest as for `save`."""
        from matplotlib.animation import FFMpegWriter

        if ending not in FILM_FORMATS:
            raise UserError(f'a film must end in .{", .".join(FILM_FORMATS)}, got {ending!r}')
        if ending == 'gif':
            return self._gif(progress or (lambda number, frames: None))
        if not FFMpegWriter.isAvailable():
            raise UserError(NO_FFMPEG)
        writer: Any = FFMpegWriter(fps=RATE)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, 'film.mp4')
            with styled():
                self._animation(self.frames, DPI).save(file, writer, dpi=DPI, progress_callback=progress)
            return file.read_bytes()

    def _gif(self, progress: Callable[[int, int], object]) -> bytes:
        """Return the content of a GIF. One frame after the other is drawn: all take gigabytes."""
        from PIL import Image

        moving = self.frames - int(HOLD * RATE)

        def images() -> Iterator[Any]:
            for frame, time in enumerate(self._shown[:moving]):
                progress(frame, moving)
                yield Image.fromarray(picture(time)[..., :3])

        times = [1000 // RATE] * (moving - 1) + [int(1000.0 * HOLD)]
        content = io.BytesIO()
        with styled():
            picture, frames = self._pictures(DPI), images()
            next(frames).save(
                content, 'gif', save_all=True, append_images=frames, duration=times, loop=0
            )
        return content.getvalue()

    def _repr_html_(self) -> str:
        """Return the film for a notebook, with buttons."""
        import matplotlib

        # Ten megabytes.
        smaller: Any = {
            'savefig.dpi': INLINE_DPI,
            'animation.embed_limit': 50.0,
            'animation.frame_format': 'jpeg',
        }
        with styled(), matplotlib.rc_context(smaller):
            page: str = self._animation(min(self.frames, INLINE_FRAMES), INLINE_DPI).to_jshtml()
        # Its buttons are icons that are loaded from elsewhere: these are letters.
        page = re.sub('<link[^>]*>', '', page)
        return re.sub('<i class="fa fa-([^"]*)"></i>', lambda icon: BUTTONS.get(icon[1], icon[1]), page)

    def _animation(self, frames: int, dpi: int) -> Any:
        """Return an animation of a figure that is nothing but the picture of a frame."""
        from matplotlib.animation import FuncAnimation
        from matplotlib.figure import Figure

        shown = self._shown[np.linspace(0, self.frames - 1, frames).astype(int)]
        interval = 1e3 * min((self.seconds + HOLD) / frames, self._longest)
        picture = self._pictures(dpi)
        inches: Any = self._figure.get_size_inches()
        screen = Figure(figsize=inches, dpi=dpi)
        image = screen.figimage(picture(shown[0]))

        def show(time: float) -> tuple[()]:
            image.set_data(picture(time))
            return ()

        return FuncAnimation(screen, show, shown, interval=interval, repeat=False)

    def _pictures(self, dpi: int) -> Callable[[float], Any]:
        """Return a function that draws the frame of a time, shape (height, width, 4).

        Below what moves all is drawn once: axes and texts take a tenth of a second.
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        self._figure.set_dpi(dpi)
        canvas: Any = FigureCanvasAgg(self._figure)
        above: list[Any] = []
        for axes in self._figure.axes:
            lowest = min(one.get_zorder() for one in axes.get_children() if one.get_gid() == MOVES)
            above += [one for one in axes.get_children() if one.get_zorder() >= lowest]
        above.sort(key=lambda one: one.get_zorder())
        for one in above:
            one.set_animated(True)
        canvas.draw()
        below = canvas.copy_from_bbox(self._figure.bbox)

        def picture(time: float) -> Any:
            self._show(time)
            canvas.restore_region(below)
            for one in above:
                one.axes.draw_artist(one)
            return np.array(canvas.buffer_rgba())

        return picture

    def _draw(self) -> list[Callable[[float], None]]:
        """Draw what moves; return functions that move it to a time."""
        plane, *panels = self._figure.axes
        left, right = plane.get_xlim()
        inches = plane.get_window_extent().width / self._figure.dpi / (right - left)
        for later in plane.findobj(lambda artist: artist.get_gid() == OF_DRIVE):
            later.set_alpha(LATER)
        runs = zip(self._timelines, self._times, self._zeros, cycle(COLORS), strict=False)
        moves = [_robot(plane, *run, inches) for run in runs]
        line: Any = {'color': 'black', 'lw': 1.0, 'zorder': 6, 'gid': MOVES}
        cursors = [panel.axvline(self._shown[0], **line) for panel in panels]
        style: Any = {'transform': plane.transAxes, 'ha': 'right', 'va': 'bottom', 'fontsize': 11}
        clock = plane.text(1.0, 1.01, '', zorder=9, **style)

        def show(time: float) -> None:
            for cursor in cursors:
                cursor.set_xdata([time, time])
            clock.set_text(f'{time:.1f} s')

        return [*moves, show]

    def _show(self, time: float) -> tuple[()]:
        for move in self._robots:
            move(time)
        return ()


def _robot(
    plane: Any, one: Timeline, times: Array, zero: float, color: str, inches: float
) -> Callable[[float], None]:
    """Draw a robot with the path that it has driven; return a function that moves it to a time.

    Args:
        plane: The axes.
        one: The run.
        times: The times of its odometry on the axis of time, shape (n,) (s).
        zero: What that axis begins with (s).
        color: Its color.
        inches: Size of a meter in the plane.
    """
    run, found = one.run, size(one.run)
    poses, truths = run.odometry.values[:, :3], run.ground_truth.values[:, :2].copy()
    # A robot that was placed elsewhere has not driven there.
    places = poses[:, :2].copy()
    places[one.breaks] = math.nan
    truths[jumps(run.ground_truth)] = math.nan
    driven = plane.plot([], [], color=color, lw=2.6, zorder=3.5)[0]
    truth_times = np.maximum.accumulate(seconds(run, run.ground_truth)) - zero
    truly = plane.plot([], [], color=color, zorder=3.4, gid=MOVES, **TRUTH)[0]
    true = plane.plot([], [], 'D', ms=6, mfc='white', mec=color, mew=1.5, zorder=8.5)[0]
    parts: list[tuple[Array, Any]] = []
    mark = None
    if found is None or found.separation * inches < VISIBLE:
        mark = plane.plot([], [], 'o', ms=9, color=color, mec='white', zorder=8, clip_on=False)[0]
    else:
        style: Any = {'ec': 'black', 'clip_on': False}
        outlines = [found.separation * sketch.BODY, *sketch.wheel_outlines(*found)]
        for outline, fc, zorder in zip(outlines, (color, *'kk'), (8.0, 8.1, 8.1), strict=True):
            parts.append((outline, plane.fill([], [], fc=fc, zorder=zorder, alpha=0.8, **style)[0]))

    def move(time: float) -> None:
        count = max(int(np.searchsorted(times, time, side='right')), 1)
        driven.set_data(*places[:count].T)
        if mark is not None:
            mark.set_data(*poses[count - 1 : count, :2].T)
        for outline, part in parts:
            part.set_xy(sketch.placed(outline, poses[count - 1]))
        known = int(np.searchsorted(truth_times, time, side='right'))
        truly.set_data(*truths[:known].T)
        true.set_data(*truths[max(known - 1, 0) : known].T)

    return move
