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
from support.bags import SECOND, odom, status, write_bag
from support.ros_messages import goal, joint_command, twist, twist_stamped
from support.ros_messages import path as path_message
from support.runs import RATE, sample

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags.table import COLUMNS, decimal_seconds
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.plots.output_files import create
from diffdrive_jacobian.plots.run_panels import COMMAND, LABELS, fault_label
from diffdrive_jacobian.plots.run_pictures import COLORS, names_of
from diffdrive_jacobian.plots.run_plane import ARROWS, PLANNED
from diffdrive_jacobian.tools import _output

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
    monkeypatch.setattr(_output, 'drawn', lambda *_: b'picture')


def odometry_only(path, **how):
    """Write a bag of odometry alone, which is drawn faster."""
    path.parent.mkdir(exist_ok=True)
    return write_bag(path, [one for one in sample(count=9, **how) if one[1] == '/odom'])


# --- What is in the picture


def by_label(made):
    """Return the panels over time by their titles, without limits."""
    return {one.get_title(loc='left').partition(', limit')[0]: one for one in made.axes[1:]}


def drawn(axes, color=COLORS[0]):
    """Return the points of the lines of a colour, without their gaps."""
    rows = [np.column_stack(one.get_data()) for one in axes.lines if one.get_color() == color]
    rows = np.vstack([one for one in rows if len(one) > 1])
    return rows[~np.isnan(rows).any(axis=1)]


def legends(made):
    return [text.get_text() for one in made.legends for text in one.get_texts()]


def written(made):
    """Return the lines of text around the axes."""
    return [one.get_text() for one in made.texts]


def commanded(made):
    lines = by_label(made)[LABELS['v']].lines
    return [one for one in lines if one.get_color() == COMMAND]


def test_the_axes_show_the_run_with_units(run):
    made = run_figure(run)
    plane, axes = made.axes[0], by_label(made)
    assert plane.get_aspect() == 1.0
    assert (plane.get_xlabel(), plane.get_ylabel()) == ('x [m]', 'y [m]')
    of_paths = {LABELS[name] for name in ('across', 'along', 'path_heading_error', 'late')}
    assert set(axes) == {*LABELS.values()} - of_paths
    assert {one.get_xlabel() for one in axes.values()} == {'time since the first goal [s]', ''}
    assert drawn(plane)[: len(run.odometry)] == pytest.approx(run.odometry.values[:, :2], abs=0.0)
    one = timeline(run)
    shown = {
        'v': run.odometry.values[:, 3],
        'omega': run.odometry.values[:, 4],
        'right': run.wheels.values[:, 0],
        'distance': one.distance,
        'bearing_error': one.bearing_error,
    }
    # The goal came half a second after the first odometry.
    for quantity, values in shown.items():
        expected = np.column_stack([np.arange(200) / RATE - 0.5, values])[~np.isnan(values)]
        assert drawn(axes[LABELS[quantity]]) == pytest.approx(expected, abs=1e-9)
    (line,) = commanded(made)
    assert line.get_drawstyle() == 'steps-post'
    values = [[0.0, 0.5], [1.5, 0.25], [199 / RATE - 0.5, 0.25]]
    assert np.column_stack(line.get_data()) == pytest.approx(np.array(values), abs=1e-9)
    assert written(made)[0] == 'bag: not arrived within 3.5 s, 1.74 m driven'


def test_limits_are_drawn_where_they_are_near(run):
    def bounds(parameters):
        made = run_figure(replace(run, parameters={'/virtual_robot': parameters}))
        lines = by_label(made)[LABELS['v']].lines
        found = {one.get_ydata()[0] for one in lines if one.get_color() == 'black'}
        assert ('limit' in legends(made)) == bool(found)
        title = by_label(made)[LABELS['v']].get_title(loc='left')
        assert title.partition(', limit ')[2] == ' and '.join(f'{one:g}' for one in sorted(found))
        return found

    # It drives with 0.5 m/s.
    assert bounds({'linear.x.max_velocity': 0.22, 'linear.x.min_velocity': -0.1}) == {0.22}
    assert bounds({'linear.x.max_velocity': 0.7}) == {0.7}
    assert bounds({'linear.x.max_velocity': 0.8}) == set()


def test_runs_differ_by_colour_and_by_style_and_have_no_commands(run):
    made = run_figure([replace(run, path=Path(name)) for name in 'abc'])
    named = made.legends[0]
    assert [one.get_text()[:3] for one in named.get_texts()] == ['a: ', 'b: ', 'c: ']
    assert len({one.get_color() for one in named.get_lines()}) == 3
    assert len({one.get_linestyle() for one in named.get_lines()}) == 3
    # One for each run, zero, and the limit that is near, for each.
    assert len(by_label(made)[LABELS['v']].lines) == 3 + 3 + 3
    assert commanded(made) == []


def test_gains_that_differ_stand_beside_the_runs_and_the_others_in_the_title(run):
    def driven(name, kp, controller='go_to_goal'):
        values = {'controller': controller, 'kp': kp, 'kv': 0.5}
        return replace(run, path=Path(name), parameters={'/go_to_goal': values})

    def lines(*runs):
        made = run_figure([*runs])
        return [*written(made), *(one.get_text() for one in made.legends[0].get_texts())]

    title, a, b = lines(driven('a', 1.0), driven('b', 2.0))
    assert title == 'control law go_to_goal: kv = 0.5 1/s'
    assert [a.rpartition('; ')[2], b.rpartition('; ')[2]] == ['kp = 1 1/s', 'kp = 2 1/s']
    _, title = written(run_figure(driven('a', 1.0)))
    assert title == 'control law go_to_goal: kp = 1 1/s, kv = 0.5 1/s'
    a, b = lines(driven('a', 1.0), driven('b', 1.0, 'pose'))
    assert a.endswith('; go_to_goal: kp = 1 1/s, kv = 0.5 1/s')
    assert b.endswith('; pose: kp = 1 1/s, kv = 0.5 1/s')


def test_waiting_before_the_goal_is_cut_off_and_driving_before_it_is_not(tmp_path):
    def window(name, v):
        times = [(0.1 * k, 10.0 + 0.1 * k) for k in range(60)]
        sent = [(at, '/odom', odom(v * t, 0.0, 0.0, seconds=at)) for t, at in times]
        read = read_run(write_bag(tmp_path / name, [*sent, (14.0, '/goal_pose', goal(2.0, 0.0))]))
        return by_label(run_figure(read))[LABELS['v']].get_xlim()

    low, high = window('waits', 0.0)
    assert -0.1 < low <= 0.0
    assert 1.9 < high < 2.0
    assert window('drives', 0.2)[0] == pytest.approx(-4.0, abs=0.2)


def test_the_robot_is_drawn_to_scale_where_its_size_is_known(run, tmp_path):
    sized = {'/virtual_robot': {'wheel_radius': 0.03, 'wheel_separation': 0.2}}
    plane = run_figure(replace(run, parameters=sized)).axes[0]
    bodies = [one.get_xy() for one in plane.patches if len(one.get_xy()) == 7]
    # From the left to the right wheel, at the start and at the end.
    ends = run.odometry.values[[0, -1], :3]
    for body, (x, y, theta) in zip(bodies, ends, strict=True):
        lateral = (body - [x, y]) @ [-np.sin(theta), np.cos(theta)]
        assert np.ptp(lateral) == pytest.approx(0.84 * 0.2)
    assert 'robot at the end' in legends(run_figure(replace(run, parameters=sized)))
    # It would be a dot, or its size is not known.
    for parameters in ({'/virtual_robot': {'wheel_radius': 1e-3, 'wheel_separation': 2e-3}}, {}):
        made = run_figure(replace(run, parameters=parameters))
        assert not made.axes[0].patches
        assert 'end' in legends(made)


def test_the_plane_has_goals_headings_and_planned_paths(tmp_path):
    values = {'controller': 'go_to_goal', 'use_goal_heading': True, 'xy_goal_tolerance': 0.05}
    planned = path_message((0.0, 0.0, 0.0), (1.0, 0.5, 0.0), times=[0.0, 3.0])
    sent = [(10.5, '/goal_pose', goal(1.0, 0.5, 1.5)), (12.0, '/path', planned)]
    bag = write_bag(tmp_path / 'bag', sample(sent), parameters={'/go_to_goal': values})
    made = run_figure(read_run(bag))
    plane = made.axes[0]
    (circles,) = (one for one in plane.collections if 'PatchCollection' in type(one).__name__)
    box = circles.get_paths()[0].get_extents()
    assert (box.width, box.height) == pytest.approx((0.1, 0.1), abs=1e-3)
    assert (box.x0 + box.x1, box.y0 + box.y1) == pytest.approx((2.0, 1.0))
    arrows = [one for one in plane.collections if 'Quiver' in type(one).__name__]
    (heading,) = (one for one in arrows if len(one.U) == 1)
    assert (heading.U[0], heading.V[0]) == pytest.approx((math.cos(1.5), math.sin(1.5)))
    # The others are along the path, which the robot drives at 0.5 rad/s.
    (along,) = (one for one in arrows if len(one.U) > 1)
    # The last one is the end, where the robot is not drawn.
    assert len(along.U) == ARROWS
    assert np.unwrap(np.arctan2(along.V, along.U)).max() < 2.0
    (path,) = (one for one in plane.lines if one.get_color() == PLANNED)
    assert path.get_xydata()[[0, -1]].tolist() == [[0.0, 0.0], [1.0, 0.5]]
    assert {'goal with its tolerance and heading', 'planned path', 'a goal or path begins or ends'} <= {
        *legends(made)
    }
    panel = by_label(made)[LABELS['v']]
    assert [one.get_xdata()[0] for one in panel.lines if one.get_linestyle() == ':'] == pytest.approx(
        [0.0, 1.5]
    )
    assert panel.get_xlabel() == ''
    assert made.axes[-1].get_xlabel() == 'time since the start [s]'


def test_a_refused_goal_is_not_drawn(tmp_path):
    sent = [(10.5, '/goal_pose', goal(90.0, 0.5)), (10.5, '/goal_status', status(6))]
    made = run_figure(read_run(write_bag(tmp_path / 'bag', sample(sent))))
    assert made.axes[0].get_xlim()[1] < 10.0
    assert LABELS['distance'] not in by_label(made)
    assert written(made)[0].startswith('bag: refused')


def test_both_passes_are_shown_where_time_goes_back(tmp_path):
    """As with a simulation that starts again."""
    sent = [*sample(count=100), *((at + 2.0, *rest) for at, *rest in sample(count=100, begin=8.0))]
    sent = [(10.0 + 0.01 * k, topic, one) for k, (_, topic, one) in enumerate(sent)]
    read = read_run(write_bag(tmp_path / 'bag', [*sent, (10.5, '/goal_pose', goal(3.0, 0.0))]))
    made = run_figure(read)
    low, high = by_label(made)[LABELS['v']].get_xlim()
    shown = drawn(by_label(made)[LABELS['v']])
    assert low < shown[:, 0].min() < shown[:, 0].max() < high
    assert 'within -' not in written(made)[0]


def test_long_lists_of_gains_are_wrapped_and_cut(run):
    gains = {f'gain_{"x" * 12}_{letter}': 1.25 for letter in 'abcdefghijkl'}
    parameters = {'/go_to_goal': {'controller': 'mine', **gains}}
    made = run_figure(replace(run, parameters=parameters))
    assert sum('gain_' in one for one in written(made)) == 3
    assert overlapping(made) == []
    other = replace(run, path=Path('other'), parameters={'/go_to_goal': {'controller': 'pose'}})
    assert overlapping(run_figure([replace(run, parameters=parameters), other])) == []


def test_without_goals_wheels_and_limits_these_are_left_out(tmp_path):
    plain = read_run(odometry_only(tmp_path / 'bag'))
    # More runs than there are styles.
    made = run_figure([replace(plain, path=Path(f'run_{index}')) for index in range(7)])
    assert set(by_label(made)) == {LABELS['v'], LABELS['omega']}
    assert legends(made)[7:] == ['start', 'end']
    assert by_label(made)[LABELS['omega']].get_xlabel() == 'time [s]'


def test_no_line_leads_to_where_the_odometry_is_reset_and_one_pose_is_drawn(tmp_path):
    sent = [(1.0 + k, '/odom', odom(5 * (k > 2), 0.01 * k, 0, seconds=1.0 + k)) for k in range(6)]
    made = run_figure(read_run(write_bag(tmp_path / 'bag', sent)))
    path = made.axes[0].lines[0]
    assert np.flatnonzero(np.isnan(path.get_xdata())).tolist() == [3]
    low, high = run_figure(read_run(write_bag(tmp_path / 'one', sent[:1]))).axes[0].get_xlim()
    assert 0.4 < high - low < 5.0


def overlapping(made):
    """Return pairs of texts, and of texts and axes, that overlap or are not in the picture."""
    made.draw_without_rendering()
    page, found = made.bbox, []
    boxes = [('legend', one.get_window_extent()) for one in made.legends]
    boxes += [(one.get_text(), one.get_window_extent()) for one in made.texts]
    for axes in made.axes:
        boxes.append((axes.get_label(), axes.get_window_extent()))
        labels = [axes.xaxis.label, axes.yaxis.label, axes.title, axes._left_title, axes._right_title]
        for one in [*labels, *axes.get_xticklabels(), *axes.get_yticklabels()]:
            inside = axes.get_xlim() if one in axes.get_xticklabels() else axes.get_ylim()
            tick = one in axes.get_xticklabels() or one in axes.get_yticklabels()
            at = one.get_position()[one in axes.get_yticklabels()]
            if one.get_text() and one.get_visible() and (not tick or inside[0] <= at <= inside[1]):
                boxes.append((one.get_text(), one.get_window_extent()))
        boxes += [(one.get_text(), one.get_window_extent()) for one in axes.texts]
    for index, (name, box) in enumerate(boxes):
        if not (page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1):
            found.append((name, 'outside'))
        for other, another in boxes[index + 1 :]:
            # A label of a goal is in the plane; axes have half a pixel.
            if 'goal' in name[:4] or 'goal' in other[:4]:
                continue
            if (
                box.overlaps(another)
                and min(
                    box.x1 - another.x0, another.x1 - box.x0, box.y1 - another.y0, another.y1 - box.y0
                )
                > 1.0
            ):
                found.append((name, other))
    return found


@pytest.mark.parametrize('shape', [(1.0, 0.0), (1.0, 0.3), (1.0, 0.9), (0.5, 1.0), (0.0, 1.0)])
@pytest.mark.parametrize('runs', [1, 2, 7, 12])
def test_nothing_overlaps_with_up_to_nine_panels_whatever_the_names(tmp_path, shape, runs):
    """With goals, a trajectory that waits, wheels, long names and notes."""
    x, y = shape
    wrong = [(10.1, '/joint_command', joint_command(1e308, 0))] * 3
    places = [(x * k / 4, y * k / 4, 0.0) for k in range(5)]
    planned = path_message(*places, times=[0.0, 0.1, 0.2, 0.3, 0.4])
    sent = [*sample(wrong), (10.5, '/goal_pose', goal(x, y)), (11.0, '/path', planned)]
    for _, topic, one in sent:
        if topic == '/odom':
            one.pose.pose.position.x *= x
            one.pose.pose.position.y = y * one.header.stamp.nanosec / 1e9
    read = read_run(write_bag(tmp_path / 'bag', sent))
    made = run_figure([replace(read, path=Path(f'{number}_{60 * "x"}')) for number in range(runs)])
    assert len(by_label(made)) >= 8
    assert overlapping(made) == []


def test_labels_of_goals_are_apart(tmp_path):
    """Also of goals at nearly the same place."""
    sent = sample([(10.1 + 0.1 * k, '/goal_pose', goal(1.0 + 0.01 * k, 0.5)) for k in range(12)])
    made = run_figure(read_run(write_bag(tmp_path / 'bag', sent)))
    made.draw_without_rendering()
    boxes = [one.get_window_extent() for one in made.axes[0].texts]
    assert len(boxes) > 4
    assert not any(a.overlaps(b) for index, a in enumerate(boxes) for b in boxes[index + 1 :])


def test_the_users_style_is_of_no_effect(run):
    import matplotlib

    with matplotlib.rc_context({'figure.figsize': (1, 1), 'text.usetex': True}):
        made = run_figure([run, replace(run, path=Path('second'))])
        assert matplotlib.rcParams['text.usetex'] is True
    assert made.get_size_inches()[0] == 11.0
    assert overlapping(made) == []


def test_numbers_of_faults_have_two_decimals():
    fault = "Loss('odom', probability=0.8151234, burst=3, start=12.00412, duration=0.000123456)"
    found = fault_label(fault)
    assert found.startswith("Loss('odom', probability=0.82, burst=3, start=12.00, durati")
    assert len(found) == 60


@pytest.mark.usefixtures('undrawn')
def test_messages_that_were_skipped_are_reported_in_picture_and_terminal(run, tmp_path):
    wrong = [(10.1, '/joint_command', joint_command(1e308, 0))] * 3
    bag = write_bag(tmp_path / 'bag', sample(wrong, count=9))
    note = '3 of 3 messages on /joint_command hold invalid or implausible values and were skipped'
    ended = plot(bag)
    assert (ended.code, ended.err) == (0, f'plot_run: {bag}: {note}\n')
    noted = read_run(bag)
    assert written(run_figure(noted))[-1] == note
    # Notes of several runs name them, and are not too many.
    several = run_figure([replace(noted, path=Path(f'r{index}$')) for index in range(5)])
    lines = written(several)[-4:]
    assert [one[:5] for one in lines[:3]] == [r'r0\$:', r'r1\$:', r'r2\$:']
    assert lines[3:] == ['and 2 more notes']


# --- What is printed


@pytest.mark.usefixtures('undrawn')
def test_a_table_compares_the_runs(bag, folder):
    other = odometry_only(folder / 'other', v=0.25)
    header, first, second = plot(bag, other).out.splitlines()[1:]
    assert header.split('  ')[0] == 'run'
    columns = [one.strip() for one in header.split('  ') if one.strip()]
    assert columns == [
        *('run', 'outcome', 'time', 'length', 'to the goal', 'max bearing error', 'max v', 'max omega')
    ]
    assert first.split('  ')[-1].strip() == '0.50 rad/s'
    assert ('not arrived' in first, 'no goal' in second) == (True, True)
    assert ('3.5 s' in first, '1.74 m' in first, '0.50 m/s' in first) == (True, True, True)
    # A column ends at the same place in each line.
    assert second.index('0.25 m/s') == first.index('0.50 m/s') == header.index('max v') - 3


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
        run_figure(read_run(bag))


def test_files_are_checked_also_when_they_are_written(tmp_path):
    (tmp_path / 'a.png').touch()
    with pytest.raises(FileExistsError):
        create(tmp_path / 'a.png', b'x')


@pytest.mark.usefixtures('undrawn')
def test_paths_are_printed_without_control_characters(bag, tmp_path):
    place = tmp_path / os.fsdecode(b'\x1b]0;x\x07 \xff')
    place.mkdir()
    escaped = rf'{tmp_path}/\x1b]0;x\x07 \udcff'
    ended = plot(bag, '-o', place / 'a.png', '--csv', place / 'a.csv')
    assert ended.out.splitlines()[:2] == [f'{escaped}/a.png', f'{escaped}/a.csv']
    assert f'{escaped}/a.png exists already' in refused(bag, '-o', place / 'a.png')
    missing = place / 'none' / 'a.png'
    assert f'{escaped}/none/a.png cannot be written: ' in refused(bag, '-o', missing, code=1)
