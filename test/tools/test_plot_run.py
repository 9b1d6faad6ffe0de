"""The tool plot_run: the picture shows the run's numbers, the CSV holds them, mistakes are reported."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support import commands
from support.bags import SECOND, odom, write_bag
from support.ros_messages import goal, joint_command, twist, twist_stamped
from support.runs import RATE, sample

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags.table import COLUMNS, decimal_seconds
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.plots.output_files import create
from diffdrive_jacobian.plots.run_figure import LABELS, draw, figure, names

plot = partial(commands.run, 'plot_run')
refused = partial(commands.refused, 'plot_run')
read_csv = partial(np.genfromtxt, delimiter=',', names=True)


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A run with a goal, commands and limits. It is not changed."""
    extra = [
        (10.5, '/goal_pose', goal(1.0, 0.5)),
        (10.5, '/cmd_vel', twist(0.5, 0.5)),
        (12.0, '/cmd_vel', twist(0.25, 1.5)),
        (12.0, '/joint_command', joint_command(1, 2)),
    ]
    parameters = {
        '/virtual_robot': {'linear.x.max_velocity': 0.22, 'linear.x.min_velocity': -0.1},
        '/go_to_goal': {'xy_goal_tolerance': 0.05},
    }
    return write_bag(tmp_path_factory.mktemp('bag') / 'bag', sample(extra), parameters=parameters)


@pytest.fixture(scope='module')
def run(bag):
    return read_run(bag)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where it works."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def undrawn(monkeypatch):
    """Files are written without drawing their picture."""
    monkeypatch.setattr(run_figure, 'figure', lambda *_: None)
    monkeypatch.setattr(run_figure, 'render', lambda *_: b'picture')


def odometry_only(path, **how):
    """Write a bag of odometry alone, which is drawn faster."""
    path.parent.mkdir(exist_ok=True)
    return write_bag(path, [one for one in sample(count=9, **how) if one[1] == '/odom'])


# --- What is in the picture


def by_label(made):
    return {one.get_ylabel(): one for one in made.axes if one.get_ylabel()}


def drawn(axes, color=run_figure.COLORS[0]):
    """Return the points of the lines of a colour, without their gaps."""
    rows = [np.column_stack(one.get_data()) for one in axes.lines if one.get_color() == color]
    rows = np.vstack([one for one in rows if len(one) > 1])
    return rows[~np.isnan(rows).any(axis=1)]


def legends(made):
    found = [axes.get_legend() for axes in made.axes]
    return [text.get_text() for one in found if one for text in one.get_texts()]


def commanded(made):
    lines = by_label(made)[LABELS['v']].lines
    return [one for one in lines if one.get_color() == run_figure.COMMAND]


def test_the_axes_show_the_run_with_units(run):
    made = figure([run])
    plane, axes = made.axes[0], by_label(made)
    assert plane.get_aspect() == 1.0
    assert (plane.get_xlabel(), plane.get_ylabel()) == ('x [m]', 'y [m]')
    of_paths = {LABELS[name] for name in ('across', 'along', 'path_heading_error', 'late')}
    assert set(axes) == {'y [m]', *LABELS.values()} - of_paths
    assert 'limit' in legends(made)
    assert {one.get_xlabel() for one in axes.values()} == {'x [m]', 'time [s]', ''}
    assert drawn(plane)[: len(run.odometry)] == pytest.approx(run.odometry.values[:, :2], abs=0.0)
    one = timeline(run)
    shown = {
        'v': run.odometry.values[:, 3],
        'omega': run.odometry.values[:, 4],
        'right': run.wheels.values[:, 0],
        'distance': one.distance,
        'bearing_error': one.bearing_error,
    }
    for quantity, values in shown.items():
        expected = np.column_stack([np.arange(200) / RATE, values])[~np.isnan(values)]
        assert drawn(axes[LABELS[quantity]]) == pytest.approx(expected, abs=1e-9)
    (line,) = commanded(made)
    assert line.get_drawstyle() == 'steps-post'
    values = [[0.5, 0.5], [2.0, 0.25], [199 / RATE, 0.25]]
    assert np.column_stack(line.get_data()) == pytest.approx(np.array(values), abs=1e-9)


def test_runs_differ_by_colour_and_by_style_and_have_no_commands(run):
    made = figure([replace(run, path=Path(name)) for name in 'abc'])
    labelled = [one for one in made.axes[0].lines if not one.get_label().startswith('_')]
    assert [one.get_label()[:2] for one in labelled] == ['a:', 'b:', 'c:']
    assert len({one.get_color() for one in labelled}) == 3
    assert len({one.get_linestyle() for one in labelled}) == 3
    # One for each run, zero, and two limits for each.
    assert len(by_label(made)[LABELS['v']].lines) == 3 + 3 + 2 * 3
    assert commanded(made) == []


def test_without_goals_wheels_and_limits_these_are_left_out(tmp_path):
    plain = read_run(odometry_only(tmp_path / 'bag'))
    # More runs than there are styles.
    made = figure([replace(plain, path=Path(f'run_{index}')) for index in range(7)])
    assert set(by_label(made)) == {'y [m]', LABELS['v'], LABELS['omega']}
    assert 'limit' not in legends(made)


def test_no_line_leads_to_where_the_odometry_is_reset_and_one_pose_is_drawn(tmp_path):
    sent = [(1.0 + k, '/odom', odom(5 * (k > 2), 0.01 * k, 0, seconds=1.0 + k)) for k in range(6)]
    made = figure([read_run(write_bag(tmp_path / 'bag', sent))])
    (path,) = (one for one in made.axes[0].lines if not one.get_label().startswith('_'))
    assert np.flatnonzero(np.isnan(path.get_xdata())).tolist() == [3]
    low, high = figure([read_run(write_bag(tmp_path / 'one', sent[:1]))]).axes[0].get_xlim()
    assert 0.4 < high - low < 5.0


def test_everything_drawn_lies_inside_the_picture_whatever_the_users_style(run):
    import matplotlib

    with matplotlib.rc_context({'figure.figsize': (1, 1), 'text.usetex': True}):
        made = figure([run, replace(run, path=Path('second'))])
        assert matplotlib.rcParams['text.usetex'] is True
    made.draw_without_rendering()
    assert made.get_size_inches().tolist() == [11.0, 7.0]
    width, height = made.get_size_inches() * made.dpi
    boxes = [axes.get_tightbbox() for axes in made.axes]
    assert min(min(box.x0, box.y0) for box in boxes) >= 0.0
    assert max(box.x1 for box in boxes) <= width
    assert max(box.y1 for box in boxes) <= height


@pytest.mark.parametrize('runs', [1, 2, 7, 12])
def test_long_names_leave_the_path_its_room(run, runs):
    made = figure([replace(run, path=Path(f'{number}_{60 * "x"}')) for number in range(runs)])
    made.draw_without_rendering()
    width, height = made.get_size_inches() * made.dpi
    plane = made.axes[0]
    assert plane.get_window_extent().width > 0.3 * width
    names = plane.get_legend().get_window_extent()
    assert 0.0 <= names.x0 < names.x1 <= width
    assert plane.get_window_extent().y1 < names.y0 < names.y1 <= height


@pytest.mark.usefixtures('undrawn')
def test_messages_that_were_skipped_are_reported_in_picture_and_terminal(run, tmp_path):
    wrong = [(10.1, '/joint_command', joint_command(1e308, 0))] * 3
    bag = write_bag(tmp_path / 'bag', sample(wrong, count=9))
    note = '3 of 3 messages on /joint_command hold invalid or implausible values and were skipped'
    assert plot(bag) == (0, f'{tmp_path / "bag.png"}\n', f'plot_run: {bag}: {note}\n')
    noted = read_run(bag)
    assert figure([noted]).get_supxlabel() == note
    # Notes of several runs name them, and are not too many.
    several = figure([replace(noted, path=Path(f'r{index}$')) for index in range(5)])
    lines = several.get_supxlabel().splitlines()
    assert [one[:5] for one in lines[:3]] == [r'r0\$:', r'r1\$:', r'r2\$:']
    assert lines[3:] == ['and 2 more notes']


# --- CSV


@pytest.mark.usefixtures('undrawn')
def test_csv_holds_the_numbers_of_the_run(bag, run, folder):
    assert plot(bag, '-o', 'a.png', '--csv', 'a.csv').code == 0
    columns, one = read_csv('a.csv'), timeline(run)
    assert columns.dtype.names == tuple(COLUMNS)
    assert run.table().keys() == COLUMNS.keys()
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
    assert [decimal_seconds(time) for time in (-1, 2**63 - 1)] == [
        '-0.000000001',
        '9223372036.854775807',
    ]


@pytest.mark.usefixtures('undrawn')
def test_csv_prefers_the_commands_that_were_applied(folder):
    extra = [(10.0, '/cmd_vel', twist(9, 9)), (10.1, '/cmd_vel_out', twist_stamped(1, 2, 10 * SECOND))]
    assert plot(write_bag(folder / 'bag', sample(extra, count=9)), '--csv', 'a.csv').code == 0
    columns = read_csv('a.csv')
    applied = np.column_stack([columns['v_command_mps'], columns['omega_command_radps']])
    assert (applied == (1.0, 2.0)).all()


# --- Files


@pytest.mark.usefixtures('no_display')
def test_the_picture_is_beside_a_bag_of_any_name(folder, monkeypatch):
    name = '_$x^$ 走行' + 'a' * 200
    monkeypatch.chdir(odometry_only(folder / name))
    picture = folder / f'{name}.png'
    assert plot('.') == (0, f'{picture}\n', '')
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
    assert names([Path('/a/run'), Path('/b/walk')]) == ['run', 'walk']
    assert names([Path('/a/x/run'), Path('/b/x/run')]) == ['a/x/run', 'b/x/run']


@pytest.mark.usefixtures('undrawn')
def test_a_topic_may_have_another_name(tmp_path):
    sent = [(at, f'/{robot}{topic}', one) for robot in 'ab' for at, topic, one in sample(count=9)]
    bag = write_bag(tmp_path / 'bag', sent)
    message = refused(bag)
    assert 'several topics' in message
    assert '/a/' in message
    assert plot(bag, *(f'--topic={name}=b/{name}' for name in ('odom', 'joint_states'))).code == 0


# --- Mistakes


def test_wrong_files_are_refused_before_anything_is_read(bag, folder):
    (folder / 'x.png').mkdir()
    (folder / 'notes').write_text('precious')
    endings = '.png, .svg, .pdf'
    cases = [
        *((2, ('-o', name), (endings, repr(name))) for name in ('a.jpg', 'a', 'a.', 'a.png.gz', '')),
        *((2, ('-o', name), ('must be a file', name)) for name in ('x.png', 'new.png/')),
        *((2, ('--csv', name), ('ends in .csv', repr(name))) for name in ('x.txt', 'x.csv.gz')),
        (2, ('--csv', 'notes'), ('notes exists already',)),
        (2, (bag, '--csv', 'a.csv'), ('--csv must be a directory for 2 runs',)),
        (2, ('no_bag/',), ('once',)),
        (1, ('-o', 'none/a.png'), ('none/a.png cannot be written: No such file',)),
        (1, ('--csv', 'none/deeper/a.csv'), ('none/deeper/a.csv cannot be written: No such file',)),
        (1, ('--csv', 'notes/a.csv'), ('notes/a.csv cannot be written: Not a directory',)),
    ]
    for code, arguments, words in cases:
        message = refused('no_bag', *arguments, code=code)
        assert all(word in message for word in words), (arguments, message)
    assert sorted(os.listdir(folder)) == ['notes', 'x.png']


@pytest.mark.usefixtures('undrawn')
def test_a_table_that_cannot_be_written_does_not_keep_the_picture(bag, folder):
    # For root, too, there is no such place.
    ended = plot(bag, '-o', 'a.png', '--csv', '/proc/no/a.csv')
    assert (ended.code, ended.out) == (1, 'a.png\n')
    assert commands.error_of('plot_run', ended).startswith('/proc/no/a.csv cannot be written: ')


def test_a_bag_without_odometry_is_refused(tmp_path):
    bag = write_bag(tmp_path / 'bag', [(1.0, '/cmd_vel', twist(0, 0))])
    message = refused(bag)
    assert str(bag) in message
    assert 'no odometry' in message
    assert list(tmp_path.iterdir()) == [bag]
    with pytest.raises(BagError):
        draw([read_run(bag)], tmp_path / 'a.png')


def test_files_are_checked_also_when_they_are_written(run, tmp_path):
    with pytest.raises(ValueError, match=r'must end in \.png, \.svg, \.pdf'):
        draw([run], tmp_path / 'a.gif')
    (tmp_path / 'a.png').touch()
    for write in (lambda path: draw([run], path), lambda path: create(path, b'x')):
        with pytest.raises(FileExistsError):
            write(tmp_path / 'a.png')


@pytest.mark.usefixtures('undrawn')
def test_paths_are_printed_without_control_characters(bag, tmp_path):
    place = tmp_path / os.fsdecode(b'\x1b]0;x\x07 \xff')
    place.mkdir()
    escaped = rf'{tmp_path}/\x1b]0;x\x07 \udcff'
    ended = plot(bag, '-o', place / 'a.png', '--csv', place / 'a.csv')
    assert ended == (0, f'{escaped}/a.png\n{escaped}/a.csv\n', '')
    assert f'{escaped}/a.png exists already' in refused(bag, '-o', place / 'a.png')
    missing = place / 'none' / 'a.png'
    assert f'{escaped}/none/a.png cannot be written: ' in refused(bag, '-o', missing, code=1)
