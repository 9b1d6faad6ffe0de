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

"""Sweeps of gains and the tool sweep_gains: numbers equal those of single loops and of the theory."""

from __future__ import annotations

import math
import os
import stat
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from support import commands

from diffdrive_jacobian.control import (
    KP,
    KV,
    Arrival,
    VelocityLimits,
    find_controller,
    go_to_pose,
)
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.plots import output_files, sweep_figure
from diffdrive_jacobian.plots.sweep_pictures import CONTOUR_GRID, TITLES
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.simulation import (
    RobotModel,
    SweepSetup,
    closed_loops,
    describe_sweep,
    sweep,
    sweep_table,
)
from diffdrive_jacobian.simulation.gain_sweep import MEASURES, columns
from diffdrive_jacobian.tools import _output, sweep_gains

pytestmark = pytest.mark.slow
CONFIG = Path(__file__).parents[2] / 'config'
LIMITS = VelocityLimits(min_v=-0.306, max_v=0.306, min_omega=-1.9, max_omega=1.9, max_wheel_speed=8.559)
"""Those of config/create3.yaml."""
SMALL = SweepSetup(grid=5, starts=3, rate=10.0)
"""The least kp with the largest kv does not arrive from everywhere."""
QUICK = ('--grid', '2', '--starts', '1', '--duration', '20', '--rate', '10')
small = cache(lambda: sweep(SMALL))


run = partial(commands.run, 'sweep_gains')
refused = partial(commands.refused, 'sweep_gains')


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Where it works: what is left there, it has left."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def undrawn(monkeypatch):
    """Nothing is drawn, which takes a while."""
    monkeypatch.setattr(_output, 'drawn', lambda *_: b'picture')


@pytest.fixture
def swept_setup(monkeypatch):
    """Return what would be swept with some options."""
    asked = []

    def catch(setup, progress):
        asked.append(setup)
        raise UserError('asked')

    def swept_with(options):
        assert run(*options.split(), '--csv', 'a.csv').code == 2
        return asked[-1]

    monkeypatch.setattr(sweep_gains, 'sweep', catch)
    return swept_with


def left(folder):
    return sorted(one.name for one in folder.iterdir())


# --- The numbers


def test_a_cell_is_what_single_loops_give():
    limits = VelocityLimits(min_v=-0.3, max_v=0.3, max_wheel_speed=12.0)
    robot = RobotModel(wheel_radius=0.04, wheel_separation=0.2, limits=limits)
    setup = replace(SMALL, grid=3, rate=20.0, controller='pose', robot=robot, tolerance=0.05)
    swept = sweep(setup)
    row, column = 1, 2
    kp, kv = swept.x[column], swept.y[row]
    loops = closed_loops(
        go_to_pose,
        setup.poses(),
        [0.0, 0.0, 0.0],
        kp,
        kv,
        rate=20.0,
        duration=60.0,
        arrival=Arrival(xy_tolerance=0.05, use_heading=True),
        turning_gain=kp,
        limits=limits,
        r=0.04,
        L=0.2,
    )
    assert loops.arrived.all()
    for measure in MEASURES:
        values = getattr(loops, measure)
        assert swept.mean(measure)[row, column] == pytest.approx(np.mean(values), abs=1e-9)
        assert swept.largest(measure)[row, column] == pytest.approx(max(values), abs=1e-9)


ERRORS = np.linspace(0.0, math.pi / 2.0, 100_001)
"""Heading errors e > 0 at which it may settle, where sin(2e)/(2e) = kp/kv: doc/mathematics.md."""


def test_beyond_the_boundary_it_spirals_in_as_the_theory_says():
    """The distance decays as exp(-kv cos^2(e) t), with the heading error e at which it settles."""
    setup = SweepSetup(gains={'kp': (0.5, 2.0), 'kv': (0.5, 2.0)}, grid=3, starts=2, duration=80.0)
    near, nearer = (sweep(replace(setup, tolerance=tolerance)) for tolerance in (2e-3, 2e-5))
    assert nearer.complete.all()
    taken = nearer.outcomes.time - near.outcomes.time
    kp, kv = np.meshgrid(near.x, near.y)
    error = np.interp(-kp / kv, -np.sinc(2.0 * ERRORS / math.pi), ERRORS)
    expected = math.log(100.0) / (kv * np.cos(error) ** 2)
    # At the boundary itself it takes long to settle.
    settled = abs(kp / kv - 1.0) > 0.3
    assert {(kp < kv)[settled].any(), (kp > kv)[settled].any()} == {True}
    for start in range(2):
        np.testing.assert_allclose(taken[settled, start], expected[settled], rtol=0.03)


@pytest.mark.parametrize('count', [1, 7])
def test_starts_lie_evenly_around_the_goal_and_gains_are_decimals(count):
    assert SweepSetup().values(KP).tolist() == [round(0.2 + 0.1 * k, 1) for k in range(59)]
    assert SweepSetup().values(KV).tolist() == [round(0.1 + 0.05 * k, 2) for k in range(59)]
    poses = SweepSetup(starts=count, distance=3.0).poses()
    assert np.hypot(poses[:, 0], poses[:, 1]) == pytest.approx(np.full(count, 3.0))
    bearings = np.sort(np.arctan2(poses[:, 1], poses[:, 0]) % math.tau)
    assert np.diff(bearings) == pytest.approx(math.tau / count)
    errors = wrap_angle(np.arctan2(-poses[:, 1], -poses[:, 0]) - poses[:, 2])
    sizes = (np.arange(count) + 0.5) * math.pi / count
    assert np.sort(abs(errors)) == pytest.approx(sizes, abs=1e-12)


def test_means_are_over_those_that_arrived_and_the_fastest_is_one_from_which_all_do():
    swept = sweep(replace(SMALL, duration=5.8))
    partly = np.argwhere((swept.arrived > 0) & ~swept.complete)
    assert len(partly)
    for row, column in partly:
        times = swept.outcomes.time[row, column]
        assert swept.mean('time')[row, column] == pytest.approx(np.nanmean(times))
        assert swept.largest('time')[row, column] == np.nanmax(times)
    # From some cells only some arrive, and were they quick: they do not count.
    swept = small()
    quick = swept.outcomes._replace(time=np.where(swept.complete[..., None], swept.outcomes.time, 0.1))
    assert swept._replace(outcomes=quick).fastest() == swept.fastest() == (4, 4)
    words = 'fastest: kp 6, kv 3 (the largest kp and the largest kv of the grid): at the goal after 1.'
    assert describe_sweep(swept).startswith(words)
    # Inside the grid: at so low a rate it overshoots with large gains.
    gains = {'kp': (0.5, 5.0), 'kv': (0.5, 3.0)}
    assert 'of the grid' not in describe_sweep(sweep(replace(SMALL, grid=7, gains=gains, rate=2.0)))


def test_a_sweep_from_which_nothing_arrives_has_no_numbers():
    swept = sweep(replace(SMALL, grid=2, duration=1.0))
    assert swept.fastest() is None
    assert 'no gains bring the robot to the goal' in describe_sweep(swept)
    rows = sweep_table(swept).splitlines()
    assert rows[1:] == [f'{kp},{kv},3,0,,,,,,' for kp in (0.2, 6.0) for kv in (0.1, 3.0)]
    assert 'fastest' not in ' '.join(legend(sweep_figure(swept)))


def test_a_setup_checks_itself():
    with pytest.raises(ValueError, match=r"controller must be one of '.*'offset_point'"):
        SweepSetup(controller='other')
    with pytest.raises(ValueError, match="gains must be of kv, offset, those of 'offset_point'"):
        SweepSetup(controller='offset_point', gains={'kp': 1.0})


# --- Files


@pytest.mark.usefixtures('undrawn')
def test_plain_it_writes_a_picture_and_the_numbers_and_overwrites_nothing(folder, monkeypatch):
    class Still(output_files.datetime):
        @classmethod
        def now(cls):
            return cls(2026, 1, 2, 3, 4, 5)

    def slow(*arguments):
        for name in taken:
            Path(name).write_text('precious')
        return sweep(*arguments)

    monkeypatch.setattr(output_files, 'datetime', Still)
    stem = 'sweep_2026_01_02-03_04_05'
    first = run(*QUICK)
    assert first.out.splitlines()[:2] == [f'{stem}.csv', f'{stem}.png']
    assert first.out.splitlines()[2].startswith('fastest: kp 6, kv 3 ')
    assert (first.code, first.err) == (0, '')
    # Others take names meanwhile.
    taken = [f'{stem}__2.png', f'{stem}__3.csv']
    monkeypatch.setattr(sweep_gains, 'sweep', slow)
    assert run(*QUICK).out.splitlines()[:2] == [f'{stem}__4.csv', f'{stem}__4.png']
    assert {Path(name).read_text() for name in taken} == {'precious'}
    made = [f'{stem}{number}.{ending}' for number in ('', '__4') for ending in ('csv', 'png')]
    assert left(folder) == sorted([*taken, *made])


def test_csv_holds_the_numbers(folder):
    assert run('--grid', 5, '--starts', 3, '--rate', 10, '--csv', 'a.csv').code == 0
    assert left(folder) == ['a.csv']
    found, swept = np.genfromtxt('a.csv', delimiter=',', names=True), small()
    assert found.dtype.names == columns(swept.setup)
    assert found['kp_per_s'].tolist() == np.repeat(swept.x, 5).tolist()
    assert found['kv_per_s'].tolist() == np.tile(swept.y, 5).tolist()
    assert set(found['starts']) == {3.0}
    assert found['arrived'].tolist() == swept.arrived.T.ravel().tolist()
    for measure, unit in MEASURES.items():
        for name, values in (('mean', swept.mean(measure)), ('max', swept.largest(measure))):
            np.testing.assert_array_equal(found[f'{measure}_{name}_{unit}'], values.T.ravel())


def test_where_nobody_may_write_is_reported_before_the_batch(folder, monkeypatch):
    monkeypatch.delattr(sweep_gains, 'sweep')
    for option, name in (('-o', 'none/a.png'), ('--csv', f'{"a" * 300}.csv')):
        assert refused(option, name, code=1).startswith(f'{name} cannot be written: ')
    # Root may write everywhere, and tests may run as root.
    monkeypatch.setattr(os, 'access', lambda path, mode: not (mode & stat.S_IWOTH))
    assert refused(code=1).endswith('.png cannot be written: Permission denied')
    assert left(folder) == []


# --- Options


PLAIN = RobotModel(command_timeout=500_000_000)
"""Without limits, as the node has it."""
MAXIMA = VelocityLimits(min_v=-0.5, max_v=0.5, min_omega=-2.0, max_omega=2.0)
GAINS = {'kp': (1.0, 2.5), 'kv': (0.5, 0.75)}


@pytest.mark.parametrize(
    ('options', 'changes', 'robot'),
    [
        ('', {}, {}),
        ('--kp 1e0 2.5 --kv .5 0.75 --grid 7 --starts 5', {'gains': GAINS, 'grid': 7, 'starts': 5}, {}),
        ('--distance 0.5 --tolerance 0.1', {'distance': 0.5, 'tolerance': 0.1}, {}),
        ('--controller pose --rate 12.5', {'controller': 'pose', 'rate': 12.5}, {}),
        ('--duration 9', {'duration': 9.0}, {}),
        ('--max-velocity 0.5 --max-yaw-rate 2', {}, {'limits': MAXIMA}),
    ],
)
def test_options_are_what_is_swept(swept_setup, options, changes, robot):
    assert swept_setup(options) == SweepSetup(robot=replace(PLAIN, **robot), **changes)


def test_a_parameter_file_describes_the_robot_and_options_its_limits(swept_setup):
    robot = swept_setup(f'--params-file {CONFIG}/create3.yaml --max-velocity 0.1').robot
    assert (robot.wheel_radius, robot.wheel_separation) == (0.03575, 0.233)
    assert robot.limits == replace(LIMITS, min_v=-0.1, max_v=0.1)


# --- The picture


def maps(made):
    return dict(zip(TITLES, made.axes, strict=False))


def legend(made):
    (found,) = (one.get_legend() for one in made.axes if one.get_legend())
    return [text.get_text() for text in found.get_texts()]


def test_maps_show_the_means_with_units():
    swept = sweep(replace(SMALL, duration=5.8))
    made = sweep_figure(swept)
    assert set(maps(made)) == set(MEASURES)
    for measure, panel in maps(made).items():
        assert panel.get_title() == TITLES[measure]
        assert TITLES[measure].endswith((' [s]', ' [m]'))
        assert (panel.get_xlabel(), made.axes[0].get_ylabel()) == ('kp [1/s]', 'kv [1/s]')
        assert (panel.get_xlim(), panel.get_ylim()) == ((0.2, 6.0), (0.1, 3.0))
        (mesh,) = (one for one in panel.collections if hasattr(one, 'get_coordinates'))
        values = mesh.get_array().reshape(5, 5)
        assert (np.ma.getmaskarray(values) == ~swept.complete).all()
        np.testing.assert_array_equal(values.compressed(), swept.mean(measure)[swept.complete])
        # The cell of kp is around it.
        edges = mesh.get_coordinates()[0, :, 0]
        np.testing.assert_allclose(edges[1:-1], (swept.x[1:] + swept.x[:-1]) / 2.0)
        assert panel.patch.get_hatch()
    title = made._suptitle.get_text()
    for word in ('go_to_goal', '3 starts', '2 m', '10 Hz', 'limits: none', '0.02 m'):
        assert word in title
    assert legend(made)[1] == 'defaults: kp 3, kv 0.5'
    assert legend(made)[2].startswith('fastest: kp 6, kv 3, ')
    assert 'not all starts arrived within 5.8 s' in legend(made)


@pytest.mark.parametrize(
    ('controller', 'ratio', 'equation'), [('go_to_goal', 1.0, 'kp = kv'), ('pose', 2.0, 'kp = 2 kv')]
)
def test_the_boundary_is_drawn_in_every_map(controller, ratio, equation):
    made = sweep_figure(small()._replace(setup=replace(SMALL, controller=controller)))
    assert f'{equation}: {find_controller(controller).boundary.beyond}' in legend(made)
    for panel in maps(made).values():
        line = next(one for one in panel.lines if one.is_dashed())
        kp, kv = line.get_data()
        assert kp == pytest.approx(ratio * kv)
        assert (kv[0], kv[-1]) == pytest.approx((max(0.1, 0.2 / ratio), 3.0))
        assert [text.get_text() for text in panel.texts] == [equation]


def test_a_fine_grid_has_lines_of_equal_values_and_only_what_lies_in_it_is_marked():
    gains = {'kp': (5.0, 6.0), 'kv': (0.5, 0.6)}
    coarse = sweep_figure(sweep(replace(SMALL, gains=gains, grid=2)))
    (only,) = legend(coarse)
    assert only.startswith('fastest: kp 6, kv 0.6, ')
    assert not any(panel.texts for panel in maps(coarse).values())
    fine = sweep_figure(sweep(replace(SMALL, grid=CONTOUR_GRID, starts=1)))
    for lined, plain in zip(maps(fine).values(), maps(coarse).values(), strict=True):
        assert len(lined.collections) > len(plain.collections)


def test_everything_drawn_lies_inside_the_picture_whatever_the_users_style():
    # The longest title, and labels of many digits.
    gains = {'kp': (2.0, 2.000001), 'kv': (0.4, 0.400001)}
    robot = RobotModel(limits=replace(LIMITS, min_v=-0.1))
    setup = replace(SMALL, grid=2, starts=1, controller='pose', gains=gains, robot=robot)
    with matplotlib.rc_context({'figure.figsize': (1, 1), 'text.usetex': True, 'image.cmap': 'jet'}):
        made = sweep_figure(sweep(setup))
    made.get_layout_engine().execute(made)
    above = made._suptitle.get_window_extent()
    for box in [*(one.get_tightbbox() for one in made.axes), above]:
        assert made.bbox.x0 <= box.x0 < box.x1 <= made.bbox.x1
        assert made.bbox.y0 <= box.y0 < box.y1 <= made.bbox.y1
    assert above.y0 > max(panel.title.get_window_extent().y1 for panel in maps(made).values())


# --- Signals


def test_a_signal_during_the_batch_or_the_drawing_ends_it(folder, monkeypatch):
    interrupted = (130, '', 'sweep_gains: interrupted: nothing was written\n')
    signals = Signals()

    def signal(*_):
        signals.count = 1
        return b'picture'

    monkeypatch.setattr(_output, 'drawn', signal)
    assert run(*QUICK, signals=signals) == interrupted
    signals.count = 0
    monkeypatch.setattr(_output.Bar, 'show', signal)
    assert run(*QUICK, signals=signals) == interrupted
    assert left(folder) == []
