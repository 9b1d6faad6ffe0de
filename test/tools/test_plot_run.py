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

"""The tool plot_run: picture and CSV are written where they should be, the CSV holds the numbers."""

from __future__ import annotations

import math
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support import commands
from support.bags import SECOND, odom, write_bag
from support.ros_messages import goal, joint_command, twist, twist_stamped
from support.runs import sample

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.bags.table import COLUMNS, decimal_seconds
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.plots.output_files import create
from diffdrive_jacobian.plots.run_pictures import names_of
from diffdrive_jacobian.tools import _output

plot = partial(commands.run, 'plot_run')
refused = partial(commands.refused, 'plot_run')
read_csv = partial(np.genfromtxt, delimiter=',', names=True)


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A run with a goal and commands."""
    extra = [
        (10.5, '/goal_pose', goal(1.0, 0.5)),
        (10.5, '/cmd_vel', twist(0.5, 0.5)),
        (12.0, '/cmd_vel', twist(0.25, 1.5)),
    ]
    return write_bag(tmp_path_factory.mktemp('bag') / 'bag', sample(extra))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Where it works."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def undrawn(monkeypatch):
    """Files are written without drawing their picture."""
    monkeypatch.setattr(_output, 'drawn', lambda *_: b'picture')


def odometry_only(path, **how):
    """Write a bag of odometry alone, which is drawn faster."""
    path.parent.mkdir(exist_ok=True)
    return write_bag(path, [one for one in sample(count=9, **how) if one[1] == '/odom'])


# --- CSV


@pytest.mark.usefixtures('undrawn')
def test_csv_holds_the_numbers_of_the_run(bag):
    assert plot(bag, '-o', 'a.png', '--csv', 'a.csv').code == 0
    run = read_run(bag)
    columns, one = read_csv('a.csv'), timeline(run)
    assert columns.dtype.names == tuple(COLUMNS) == tuple(run.table())
    assert columns['time_s'].tolist() == one.time.tolist()
    expected = dict(zip([*COLUMNS][1:6], run.odometry.values.T, strict=True))
    expected |= {'distance_m': one.distance, 'bearing_error_rad': one.bearing_error}
    expected |= {'omega_right_radps': run.wheels.values[:, 0]}
    expected |= {'omega_left_radps': run.wheels.values[:, 1]}
    expected |= {'v_command_mps': [math.nan] * 25 + [0.5] * 75 + [0.25] * 100}
    expected |= {'goal_heading_error_rad': np.full(200, math.nan)}
    for name, values in expected.items():
        np.testing.assert_allclose(columns[name], values, rtol=0.0, atol=5.1e-10, err_msg=name)
    # Along the line from where the robot was when the goal came.
    here = np.flatnonzero(one.goal == 0)
    places = run.odometry.values[here, :2]
    line = run.goals.values[0, :2] - places[0]
    beyond = (places - run.goals.values[0, :2]) @ line / np.hypot(*line)
    np.testing.assert_allclose(columns['beyond_goal_m'][here], beyond, rtol=0.0, atol=5.1e-10)


@pytest.mark.usefixtures('undrawn')
def test_csv_has_exact_times_and_no_artefacts_of_floats(folder):
    begin = 1_795_213_077
    sent = [
        (begin, '/odom', odom(57.303999999999995, 0.1 + 0.2, -1e-12, seconds=begin)),
        (begin + 1, '/odom', odom(-999999.123456789, 1e-9, 0.0, seconds=begin)),
    ]
    sent[1][2].header.stamp.nanosec = 123_456_789
    assert plot(write_bag(folder / 'bag', sent), '--csv', 'a.csv').code == 0
    _, first, second = Path('a.csv').read_text().splitlines()
    empty = ',' * (len(COLUMNS) - 6)
    assert first == '0,57.304,0.3,0,0,0' + empty
    assert second == '0.123456789,-999999.123456789,0.000000001,0,0,0' + empty
    assert decimal_seconds(-1) == '-0.000000001'
    assert decimal_seconds(2**63 - 1) == '9223372036.854775807'


@pytest.mark.usefixtures('undrawn')
def test_csv_prefers_the_commands_that_were_applied(folder):
    extra = [(10.0, '/cmd_vel', twist(9, 9)), (10.1, '/cmd_vel_out', twist_stamped(1, 2, 10 * SECOND))]
    assert plot(write_bag(folder / 'bag', sample(extra, count=9)), '--csv', 'a.csv').code == 0
    columns = read_csv('a.csv')
    assert {*zip(columns['v_command_mps'], columns['omega_command_radps'], strict=True)} == {(1.0, 2.0)}


# --- What is printed


@pytest.mark.usefixtures('undrawn')
def test_skipped_messages_and_a_table_of_the_runs_are_printed(bag, folder):
    wrong = [(10.1, '/joint_command', joint_command(1e308, 0))] * 3
    noted = write_bag(folder / 'noted', sample(wrong, count=9))
    ended = plot(bag, noted)
    note = '3 of 3 messages on /joint_command hold invalid or implausible values and were skipped'
    assert (ended.code, ended.err) == (0, f'plot_run: {noted}: {note}\n')
    header, first, second = ended.out.splitlines()[1:]
    assert header.startswith('run ')
    assert (first.split()[0], second.split()[0]) == ('bag', 'noted')
    assert ('not arrived' in first, 'no goal' in second) == (True, True)


@pytest.mark.usefixtures('undrawn')
def test_paths_are_printed_without_control_characters(bag, folder):
    place = folder / os.fsdecode(b'\x1b]0;x\x07 \xff')
    place.mkdir()
    escaped = rf'{folder}/\x1b]0;x\x07 \udcff'
    ended = plot(bag, '-o', place / 'a.png', '--csv', place / 'a.csv')
    assert ended.out.splitlines()[:2] == [f'{escaped}/a.png', f'{escaped}/a.csv']
    assert f'{escaped}/a.png exists already' in refused(bag, '-o', place / 'a.png')


# --- Files


@pytest.mark.usefixtures('no_display')
def test_the_picture_is_beside_a_bag_of_any_name(folder, monkeypatch):
    name = '_$x^$ 走行' + 'a' * 200
    monkeypatch.chdir(odometry_only(folder / name))
    picture = folder / f'{name}.png'
    ended = plot('.')
    assert (ended.code, ended.out.splitlines()[0], ended.err) == (0, str(picture), '')
    assert picture.read_bytes().startswith(b'\x89PNG')


@pytest.mark.usefixtures('undrawn')
def test_several_runs_get_one_picture_and_a_table_each(folder):
    bags = [odometry_only(folder / name / 'bag', v=v) for name, v in (('x', 0.2), ('y', 0.5))]
    # A directory that is not there, and then is.
    for force in ((), ('--force',)):
        assert plot(*bags, '--csv', 'numbers', *force).code == 0
        speeds = {one.name: read_csv(one)['v_mps'][0] for one in (folder / 'numbers').iterdir()}
        assert speeds == {'x_bag.csv': 0.2, 'y_bag.csv': 0.5}
        assert (folder / 'x' / 'bag_and_bag.png').exists()
    assert names_of([Path('/a/run'), Path('/b/walk')]) == ['run', 'walk']
    assert names_of([Path('/a/x/run'), Path('/b/x/run')]) == ['a/x/run', 'b/x/run']
    assert names_of([Path('/a/drive'), Path('/b'), Path('/a/drive')]) == ['drive 1', 'b', 'drive 2']


@pytest.mark.usefixtures('undrawn')
def test_a_topic_may_have_another_name(folder):
    sent = [(at, f'/{robot}{topic}', one) for robot in 'ab' for at, topic, one in sample(count=9)]
    bag = write_bag(folder / 'bag', sent)
    assert 'several topics' in refused(bag)
    assert plot(bag, *(f'--topic={name}=b/{name}' for name in ('odom', 'joint_states'))).code == 0


def test_wrong_files_are_refused_before_anything_is_read(bag, folder):
    (folder / 'x.png').mkdir()
    (folder / 'notes').write_text('precious')
    cases = [
        *((2, ('-o', name), f'.png, .svg, .pdf, got {name!r}') for name in ('a.jpg', 'a.', 'a.png.gz')),
        *((2, ('-o', name), 'must be a file') for name in ('x.png', 'new.png/')),
        *((2, ('--csv', name), 'ends in .csv') for name in ('x.txt', 'x.csv.gz')),
        (2, ('--csv', 'notes'), 'notes exists already'),
        (2, (bag, '--csv', 'a.csv'), '--csv must be a directory for 2 runs'),
        (2, ('no_bag/',), 'once'),
        (1, ('-o', 'none/a.png'), 'none/a.png cannot be written: No such file'),
        (1, ('--csv', 'none/deeper/a.csv'), 'none/deeper/a.csv cannot be written: No such file'),
        (1, ('--csv', 'notes/a.csv'), 'notes/a.csv cannot be written: Not a directory'),
    ]
    for code, arguments, words in cases:
        assert words in refused('no_bag', *arguments, code=code), arguments
    assert sorted(os.listdir(folder)) == ['notes', 'x.png']


def test_a_bag_without_odometry_is_refused(folder):
    bag = write_bag(folder / 'bag', [(1.0, '/cmd_vel', twist(0, 0))])
    message = refused(bag)
    assert str(bag) in message
    assert 'no odometry' in message
    assert list(folder.iterdir()) == [bag]


@pytest.mark.usefixtures('undrawn')
def test_a_table_that_cannot_be_written_does_not_keep_the_picture(bag):
    # For root, too, there is no such place.
    ended = plot(bag, '-o', 'a.png', '--csv', '/proc/no/a.csv')
    assert (ended.code, ended.out) == (1, 'a.png\n')
    assert commands.error_of('plot_run', ended).startswith('/proc/no/a.csv cannot be written: ')


def test_a_file_that_has_come_meanwhile_is_not_overwritten(folder):
    (folder / 'a.png').touch()
    with pytest.raises(FileExistsError):
        create(folder / 'a.png', b'x')
