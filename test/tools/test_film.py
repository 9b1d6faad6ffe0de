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

"""Films of runs: robots that drive through the figure of their runs."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.animation import FFMpegWriter
from PIL import Image
from support.commands import refused, run
from support.runs import run_of

from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.plots import sketch
from diffdrive_jacobian.plots.film import HOLD, INLINE_FRAMES, RATE, Film
from diffdrive_jacobian.plots.run_panels import zero

pytestmark = pytest.mark.slow
WHEELS = {'/virtual_robot': {'wheel_radius': 0.03, 'wheel_separation': 0.16}}


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """Runs of the same robot, one with its size and one without."""
    folder = tmp_path_factory.mktemp('runs')
    (folder / 'b').mkdir()
    return run_of(folder, parameters=WHEELS), run_of(folder / 'b')


def shapes(film):
    """Return the corners of the robots."""
    plane = film._figure.axes[0]
    places = {id(one): one.get_xy() for one in plane.patches if one.get_zorder() == 8}
    marks = {id(one): one.get_xydata() for one in plane.lines if one.get_zorder() == 8}
    return [*places.values(), *marks.values()]


def test_robots_are_where_they_were_and_leave_a_trace(recorded):
    for runs in (recorded[:1], recorded):
        film = Film(runs, speed=2.0)
        one = timeline(recorded[0])
        for index in (0, len(one.time) // 2, -1):
            film._show(float(one.time[index] - zero(one)) + 1e-6)
            pose = recorded[0].odometry.values[index, :3]
            found = shapes(film)
            assert len(found) == len(runs)
            if len(runs) == 1:
                np.testing.assert_allclose(found[0][:-1], sketch.placed(0.16 * sketch.BODY, pose))
            trace = next(line for line in film._figure.axes[0].lines if line.get_zorder() == 3.5)
            np.testing.assert_allclose(trace.get_xydata()[-1], pose[:2])
        cursors = [panel.lines[-1].get_xdata() for panel in film._figure.axes[1:]]
        assert {tuple(one) for one in cursors} == {(one.time[-1] - zero(one) + 1e-6,) * 2}


def test_a_frame_is_the_figure_of_its_time(recorded):
    film = Film(recorded, speed=2.0)
    picture = film._pictures(80)(2.0)
    for artist in film._figure.findobj():
        artist.set_animated(False)
    film._figure.canvas.draw()
    np.testing.assert_array_equal(picture, film._figure.canvas.buffer_rgba())


def test_a_film_is_as_long_as_the_run_took_by_its_speed(recorded):
    seen = []
    film = Film(recorded[0], speed=8.0)
    took = float(np.ptp(timeline(recorded[0]).time))
    assert film.seconds == pytest.approx(took / 8.0, rel=0.02)
    picture = Image.open(io.BytesIO(film.content('gif', lambda *state: seen.append(state))))
    moving = int(film.seconds * RATE) + 2
    assert film.frames == moving + int(HOLD * RATE)
    assert seen == [(number, moving) for number in range(moving)]
    assert picture.n_frames == moving
    assert picture.info['duration'] * RATE == 1000.0
    first = np.array(picture.convert('RGB'))
    picture.seek(picture.n_frames - 1)
    assert (first != np.array(picture.convert('RGB'))).any()
    # It stays, instead of many that are the same.
    assert picture.info['duration'] == 1000.0 * HOLD


def test_a_notebook_shows_a_film_of_bounded_size(recorded, monkeypatch):
    monkeypatch.setattr('diffdrive_jacobian.plots.film.INLINE_FRAMES', 3)
    assert INLINE_FRAMES >= 100
    page = Film(recorded[0])._repr_html_()
    assert page.count('data:image/jpeg;base64') == 3
    # It needs nothing from elsewhere.
    assert 'href=' not in page
    assert 'fa-play' not in page


def test_what_is_no_film_is_refused(recorded, monkeypatch):
    for speed, words in ((0.0, 'speed must be positive'), (1e-4, 'speed must be at least 0.0')):
        with pytest.raises(ValueError, match=words):
            Film(recorded[0], speed=speed)
    film = Film(recorded[0], speed=30.0)
    with pytest.raises(FileNotFoundError):
        film.save('no_such_folder/run.gif')
    with pytest.raises(UserError, match=r'^a film must end in \.gif, \.mp4, got'):
        film.content('avi')
    monkeypatch.setattr(FFMpegWriter, 'isAvailable', classmethod(lambda cls: False))
    with pytest.raises(UserError, match='needs the program ffmpeg'):
        film.content('mp4')


@pytest.mark.skipif(not FFMpegWriter.isAvailable(), reason='ffmpeg is not installed')
def test_an_mp4_is_written(recorded, tmp_path):
    Film(recorded[0], speed=30.0).save(tmp_path / 'run.mp4')
    assert (tmp_path / 'run.mp4').read_bytes()[4:8] == b'ftyp'


def test_plot_run_writes_a_film_and_no_picture(recorded, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bags = [str(one.path) for one in recorded]
    film = ('--film', 'run.gif', '--speed', '30')
    assert run('plot_run', *bags, *film).code == 0
    assert [one.name for one in tmp_path.iterdir()] == ['run.gif']
    assert 'exists already' in refused('plot_run', *bags, *film)
    assert run('plot_run', bags[0], *film, '--force', '-o', 'run.png').code == 0
    assert {one.name for one in tmp_path.iterdir()} == {'run.gif', 'run.png'}
    for arguments, words in (
        (('--speed', '2'), '--speed has no effect without --film'),
        (('--film', 'run.avi'), 'the film must end in .gif, .mp4'),
        (('--film', 'b.gif', '--speed', '1e-4'), 'speed must be at least'),
    ):
        assert words in refused('plot_run', bags[0], *arguments)
