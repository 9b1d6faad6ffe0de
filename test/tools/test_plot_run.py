"""The tool plot_run: the picture shows the run's numbers, the CSV holds them, mistakes are told."""

from __future__ import annotations

import math
import os
import shutil
import signal
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support import commands
from support.bags import REAL, SECOND, changed, odom, start, status, write_bag
from support.ros_messages import goal, goals, joint_command, twist, twist_stamped
from support.runs import RATE, STRAIGHT, drive, run_of, sample

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags.timeline import BUCKETS, limits, line, seconds, timeline
from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.plots import output_files
from diffdrive_jacobian.plots import run_figure as _figure
from diffdrive_jacobian.plots.rendering import render
from diffdrive_jacobian.plots.run_figure import LABELS, draw, figure, names
from diffdrive_jacobian.plots.run_table import COLUMNS, decimal_seconds
from diffdrive_jacobian.signals import CAUGHT, Signals

PARAMETERS = {
    '/virtual_robot': {
        'linear.x.max_velocity': 0.22,
        'linear.x.min_velocity': -0.1,
        'angular.z.max_velocity': math.nan,
        'angular.z.min_velocity': math.nan,
        'max_wheel_velocity': 6.67,
    },
    '/go_to_goal': {'xy_goal_tolerance': 0.05, 'angular.z.max_velocity': 1.0},
    '/wheel_bridge': {'max_wheel_velocity': 9.0},
}
"""Nodes that limit each other's speeds."""


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A run with a goal, commands and limits. It is not changed."""
    extra = [
        (10.5, '/goal_pose', goal(1.0, 0.5)),
        (10.5, '/cmd_vel', twist(0.5, 0.5)),
        (12.0, '/cmd_vel', twist(0.25, 1.5)),
        (12.0, '/joint_command', joint_command(1, 2)),
    ]
    path = tmp_path_factory.mktemp('recorded') / 'bag'
    return write_bag(path, sample(extra), parameters=PARAMETERS)


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
    monkeypatch.setattr(_figure, 'figure', lambda *_: None)
    monkeypatch.setattr(_figure, 'render', lambda *_: b'picture')


def odometry_only(path, **how):
    """Write a bag with odometry alone, which is drawn faster."""
    path.parent.mkdir(exist_ok=True)
    return write_bag(path, [one for one in sample(**how) if one[1] == '/odom'])


plot = partial(commands.run, 'plot_run')
refused = partial(commands.refused, 'plot_run')
read_csv = partial(np.genfromtxt, delimiter=',', names=True)


def by_label(made):
    return {one.get_ylabel(): one for one in made.axes if one.get_ylabel()}


def drawn(axes, color=_figure.COLORS[0]):
    """Give the points of the lines of a colour, without their holes."""
    rows = [np.column_stack(one.get_data()) for one in axes.lines if one.get_color() == color]
    rows = np.vstack([one for one in rows if len(one) > 1])
    return rows[~np.isnan(rows).any(axis=1)]


# --- Files


@pytest.mark.slow
@pytest.mark.usefixtures('no_display')
def test_the_picture_lies_beside_a_bag_of_any_name(folder, monkeypatch):
    name = '_$x^$ 走行' + 'a' * 200
    monkeypatch.chdir(odometry_only(folder / name))
    picture = folder / f'{name}.png'
    assert plot('.') == (0, f'{picture}\n', '')
    assert picture.read_bytes().startswith(b'\x89PNG')


@pytest.mark.slow
def test_the_picture_is_of_the_format_of_its_ending(folder):
    bag = odometry_only(folder / 'bag', count=9)
    assert plot(bag, '-o', 'picture.SVG') == (0, 'picture.SVG\n', '')
    assert (folder / 'picture.SVG').read_bytes().startswith(b'<?xml')


def test_the_users_style_does_not_matter(run):
    import matplotlib

    with matplotlib.rc_context({'figure.figsize': (1, 1), 'text.usetex': True, 'axes.grid': False}):
        made = figure([run])
        assert matplotlib.rcParams['text.usetex'] is True
    assert made.get_size_inches().tolist() == [11.0, 7.0]


@pytest.mark.usefixtures('undrawn')
def test_a_bag_of_another_robot_is_written(tmp_path):
    bag = shutil.copytree(REAL, tmp_path / 'bag')
    assert plot(bag, '--csv', tmp_path / 'a.csv').code == 0
    assert read_csv(tmp_path / 'a.csv')['v_mps'].max() == pytest.approx(0.15)
    assert len(timeline(read_run(bag)).breaks) == 0


# --- What is in the picture


def test_the_axes_show_the_run_with_units(run):
    made = figure([run])
    plane, axes = made.axes[0], by_label(made)
    assert plane.get_aspect() == 1.0
    assert (plane.get_xlabel(), plane.get_ylabel()) == ('x [m]', 'y [m]')
    of_paths = {LABELS[name] for name in ('across', 'along', 'path_heading_error')}
    assert set(axes) == {'y [m]', *LABELS.values()} - of_paths
    assert {one.get_xlabel() for one in axes.values()} == {'x [m]', 'time [s]', ''}
    assert drawn(plane)[: len(run.odometry)] == pytest.approx(run.odometry.values[:, :2], abs=0.0)
    time = np.arange(200) / RATE
    for quantity, column in (('v', 3), ('omega', 4)):
        values = np.column_stack([time, run.odometry.values[:, column]])
        assert drawn(axes[LABELS[quantity]]) == pytest.approx(values, abs=1e-9)
    wheels = drawn(axes[LABELS['right']])
    assert wheels == pytest.approx(np.column_stack([time, run.wheels.values[:, 0]]), abs=1e-9)
    x, y, theta = run.odometry.values[25:, :3].T
    distance = drawn(axes[LABELS['distance']])
    assert distance[:, 1] == pytest.approx(np.hypot(1.0 - x, 0.5 - y), abs=1e-12)
    error = wrap_angle(np.arctan2(0.5 - y, 1.0 - x) - theta)
    reached = np.flatnonzero(np.hypot(1.0 - x, 0.5 - y) <= 0.05)
    until = reached[0] if len(reached) else len(x)
    shown = drawn(axes[LABELS['bearing_error']])
    assert shown[:, 1] == pytest.approx(error[:until], abs=1e-12)


@pytest.mark.slow
def test_everything_drawn_lies_inside_the_picture(run):
    made = figure([run, replace(run, path=Path('second'))])
    render(made, 'png')
    width, height = made.get_size_inches() * made.dpi
    for axes in made.axes:
        box = axes.get_tightbbox()
        assert box.x0 >= 0.0
        assert box.y0 >= 0.0
        assert box.x1 <= width
        assert box.y1 <= height


def test_runs_differ_by_colour_and_by_style(run):
    made = figure([replace(run, path=Path(name)) for name in 'abcde'])
    labelled = [one for one in made.axes[0].lines if not one.get_label().startswith('_')]
    assert [one.get_label()[:2] for one in labelled] == ['a:', 'b:', 'c:', 'd:', 'e:']
    assert len({one.get_color() for one in labelled}) == 5
    assert len({str(one._dash_pattern) for one in labelled}) == 5
    # One for each run, zero, and two limits for each.
    assert len(by_label(made)[LABELS['v']].lines) == 5 + 5 + 2 * 5


def test_only_a_single_run_shows_its_commands(run):

    def lines(made):
        axes = by_label(made)[LABELS['v']]
        return [one for one in axes.lines if one.get_color() == _figure.COMMAND]

    (commanded,) = lines(figure([run]))
    assert commanded.get_drawstyle() == 'steps-post'
    values = [[0.5, 0.5], [2.0, 0.25], [199 / RATE, 0.25]]
    assert np.column_stack(commanded.get_data()) == pytest.approx(np.array(values), abs=1e-9)
    assert lines(figure([run, replace(run, path=Path('b'))])) == []


def test_without_goals_and_wheels_their_axes_are_left_out(tmp_path):
    plain = read_run(odometry_only(tmp_path / 'bag', count=9))
    # More runs than there are styles.
    for count in (1, 20):
        made = figure([replace(plain, path=Path(f'run_{index}')) for index in range(count)])
        assert set(by_label(made)) == {'y [m]', LABELS['v'], LABELS['omega']}


@pytest.mark.parametrize('count', [1, 2])
def test_a_robot_that_stands_is_drawn(tmp_path, count):
    made = figure([run_of(tmp_path, count=count, v=0.0, omega=0.0)])
    low, high = made.axes[0].get_xlim()
    assert 0.4 < high - low < 5.0


# --- Limits


def test_limits_are_the_narrowest_of_the_nodes(run):
    found = {name: bounds[:, 0, 1].tolist() for name, bounds in limits(timeline(run)).items()}
    assert found == {
        'v': [-0.1, 0.22],
        'omega': [-1.0, 1.0],
        'right': [-6.67, 6.67],
        'left': [-6.67, 6.67],
    }


def test_limits_that_are_not_known_are_not_drawn(tmp_path):
    run = run_of(tmp_path, parameters={'/virtual_robot': {'max_wheel_velocity': math.nan}})
    assert all(np.isnan(bounds[..., 1]).all() for bounds in limits(timeline(run)).values())
    assert len(by_label(figure([run]))[LABELS['v']].lines) == 1 + 1 + 1 + 2


def test_a_limit_holds_from_when_it_was_set(tmp_path):
    change = (11.0, '/parameter_events', changed('/virtual_robot', 'max_wheel_velocity', 3.0))
    run = run_of(tmp_path, [change], parameters=PARAMETERS)
    upper = limits(timeline(run))['right'][1]
    assert upper == pytest.approx(np.array([[0.0, 6.67], [1.0, 3.0], [199 / RATE, 3.0]]), abs=1e-9)


# --- Which goal counts


CONTROLLER = {'controller': 'go_to_goal', 'use_goal_heading': False, 'xy_goal_tolerance': 0.05}
TOPICS = {'PoseStamped': '/goal_pose', 'GoalStatus': '/goal_status', 'Goals': '/goals'}
FAR, OTHER = goal(5, 0), goal(7, 0)
WAY = goals(goal(0.5, 0.3), goal(1.0, 0))
NINTH = goal(5, 0, stamp=9)
UNRECORDED = [
    (11.5, status(1, 11)),
    (12.0, status(4, 11)),
    (13.0, goal(7, 0, stamp=13)),
    (13.0, status(1, 13)),
]
COUNTING = {
    'from when it came until the next': (
        [(11.0, FAR), (12.0, OTHER)],
        [(0.0, -1), (1.0, 0), (2.0, 1)],
    ),
    'missed: until the closest approach': ([(10.0, WAY)], [(0.0, 0), (1.0, 1)]),
    'not reached, as the node says': ([(10.0, WAY), (10.0, status(2))], [(0.0, 0)]),
    'until it is canceled': (
        [(11.0, FAR), (11.0, status(2)), (11.99, status(5))],
        [(0.0, -1), (1.0, 0), (2.0, -1)],
    ),
    'until it is aborted': (
        [(11.0, FAR), (11.0, status(2)), (11.99, status(6))],
        [(0.0, -1), (1.0, 0), (2.0, -1)],
    ),
    'not one that is refused': (
        [(10.0, FAR), (10.01, status(2)), (11.0, OTHER), (11.01, status(6)), (11.02, status(2))],
        [(0.0, 0)],
    ),
    'until it is replaced': (
        [(10.0, FAR), (10.0, status(1)), (11.0, OTHER), (11.0, status(5)), (11.0, status(1))],
        [(0.0, 0), (1.0, 1)],
    ),
    'until one replaces it that was not recorded': (
        [(10.0, NINTH), (10.0, status(1, 9)), (11.0, status(5, 9)), *UNRECORDED],
        [(0.0, 0), (1.02, -1), (3.0, 1)],
    ),
    'until one comes after it that was not recorded': (
        [(10.0, NINTH), (10.0, status(1, 9)), (11.0, status(4, 9)), *UNRECORDED],
        [(0.0, 0), (1.5, -1), (3.0, 1)],
    ),
}
"""Messages, and `(time, goal)` whenever the goal changes."""


def goals_of(run):
    """Give `(time, goal)` whenever the goal changes."""
    one = timeline(run)
    changes = [0, *(np.flatnonzero(np.diff(one.goal)) + 1).tolist()]
    return [(round(float(one.time[index]), 6), int(one.goal[index])) for index in changes]


@pytest.mark.parametrize(('messages', 'expected'), COUNTING.values(), ids=COUNTING)
def test_a_goal_counts(tmp_path, messages, expected):
    extra = [(at, TOPICS[type(one).__name__], one) for at, one in messages]
    run = run_of(tmp_path, extra, **STRAIGHT)
    assert goals_of(run) == expected
    assert np.isnan(timeline(run).distance[timeline(run).goal < 0]).all()


def test_the_tolerance_counts_from_when_it_was_set(tmp_path):
    extra = [
        (10.0, '/goals', goals(goal(0.5, 0.0), goal(3.0, 0.0))),
        (10.5, '/parameter_events', changed('/go_to_goal', 'xy_goal_tolerance', 0.2)),
    ]
    run = run_of(tmp_path, extra, parameters={'/go_to_goal': CONTROLLER}, **STRAIGHT)
    assert goals_of(run) == [(0.0, 0), (0.6, 1)]


@pytest.mark.parametrize(
    ('parameters', 'tolerance'),
    [(None, 0.02), ({'/go_to_goal': {'xy_goal_tolerance': 0.1}}, 0.1)],
)
def test_the_next_waypoint_counts_from_within_the_tolerance(tmp_path, parameters, tolerance):
    way = (10.0, '/goals', goals(goal(0.5, 0), goal(1.0, 0), goal(1.5, 0)))
    run = run_of(tmp_path, [way], parameters=parameters, **STRAIGHT)
    times = [round((x - tolerance) / 0.5, 6) for x in (0.5, 1.0, 1.5)]
    assert goals_of(run) == [(0.0, 0), (times[0], 1), (times[1], 2)]
    one = timeline(run)
    reached = np.flatnonzero(np.isnan(one.bearing_error))
    assert one.time[reached[0]] == pytest.approx(times[2])
    assert not np.isnan(one.distance).any()


@pytest.mark.parametrize('node', ['/go_to_goal', '/renamed'])
def test_parameters_of_the_controller_count_from_when_they_were_set(tmp_path, node):
    extra = [
        (10.0, '/goal_pose', goal(5.0, 1.0, 1.0)),
        (11.0, '/parameter_events', changed(node, 'use_goal_heading', value=True)),
        (12.0, '/parameter_events', changed(node, 'controller', 'offset_point')),
        (12.0, '/parameter_events', changed(node, 'offset', 0.3)),
    ]
    run = run_of(tmp_path, extra, parameters={node: CONTROLLER}, omega=0.0)
    one = timeline(run)
    x = run.odometry.values[:, 0]
    heading, driven = one.time >= 1.0, np.where(one.time >= 2.0, x + 0.3, x)
    assert one.goal_heading_error == pytest.approx(np.where(heading, 1.0, np.nan), nan_ok=True)
    assert one.distance == pytest.approx(np.hypot(5.0 - driven, 1.0))


def test_a_goal_that_is_only_passed_is_driven_to_until_the_end(tmp_path):
    """It comes near the goal, drives on, and is placed elsewhere before the node reports success."""
    states = [(10.0, '/goal_status', status(2)), (13.9, '/goal_status', status(4))]
    for name, extra in (('node', states), ('other', [])):
        placed = (12.0, '/start_pose', start(1.0, 0, 0, seconds=12.0))
        sent = sample([(10.0, '/goal_pose', goal(0.5, 0)), placed, *extra], **STRAIGHT)
        one = timeline(read_run(write_bag(tmp_path / name, sent)))
        assert one.breaks.tolist() == [100]
        assert not np.isnan(one.distance).any()
        assert drawn(by_label(figure([one.run]))[LABELS['distance']])[-1, 0] == one.time[-1]


def test_a_goal_is_reached_when_the_node_says_so(tmp_path):
    """Until then it has a direction, also after it was passed; from then on until a reset a distance."""
    drives = [*drive(100, v=0.5, omega=0.0), *drive(100, v=-0.25, omega=0.0, begin=12.0)]
    sent = [(at, topic, one) for at, topic, one in drives if topic == '/odom']
    for index, (_, _, one) in enumerate(sent[100:]):
        one.pose.pose.position.x = 1.0 - 0.25 * index / RATE
    extra = [(10.0, '/goal_pose', goal(0.75, 0)), (10.0, '/goal_status', status(2))]
    extra += [(13.0, '/goal_status', status(4)), (13.5, '/start_pose', start(0.625, 0, 0, seconds=13.5))]
    run = read_run(write_bag(tmp_path / 'bag', sorted([*sent, *extra], key=lambda one: one[0])))
    one = timeline(run)
    # Within 0.02 m of it again since 12.92 s.
    assert np.flatnonzero(np.isnan(one.bearing_error))[0] == 146
    assert np.flatnonzero(np.isnan(one.distance)).tolist() == list(range(175, 200))


# --- Time


@pytest.mark.parametrize('delay', [0.0, 0.5, 1.7e9])
def test_what_has_no_stamp_counts_by_the_recorders_clock(tmp_path, delay):
    extra = [(12.0 + delay, '/cmd_vel', twist(0.1, 0.2)), (11.0 + delay, '/goal_pose', goal(1, 1))]
    run = run_of(tmp_path, extra, delay=delay)
    assert seconds(run, run.cmd_vel) == pytest.approx([2.0], abs=1e-6)
    assert timeline(run).time == pytest.approx(np.arange(200) / RATE, abs=1e-9)
    assert np.flatnonzero(timeline(run).goal == 0)[0] in (50, 51)


def test_no_line_leads_to_where_the_odometry_begins_anew(tmp_path):
    sent = [
        *drive(100),
        (12.0, '/start_pose', start(0, 0, 0, seconds=12.0)),
        *drive(100, begin=12.0),
        *(
            (14.0 + index / RATE, '/odom', odom(5, 5, 0, seconds=14.0 + index / RATE))
            for index in range(9)
        ),
        (14.2, '/odom', odom(5, 5, 0, seconds=1.0)),
    ]
    run = read_run(write_bag(tmp_path / 'bag', sent))
    assert timeline(run).breaks.tolist() == [100, 200, 209]
    (path,) = (one for one in figure([run]).axes[0].lines if not one.get_label().startswith('_'))
    assert np.flatnonzero(np.isnan(path.get_xdata())).tolist() == [100, 201, 211]
    assert path.get_label().startswith('bag: ')


def test_odometry_of_the_instant_of_a_new_beginning_may_be_from_before(tmp_path):
    sent = [*drive(50, **STRAIGHT), (11.0, '/odom', odom(0.5, 0, 0, seconds=11.0))]
    sent += [
        (11.0, '/start_pose', start(0.52, 0, 0, seconds=11.0)),
        (11.02, '/odom', odom(0.52, 0, 0, seconds=11.02)),
    ]
    assert timeline(read_run(write_bag(tmp_path / 'bag', sent))).breaks.tolist() == [51]


def test_a_teleport_breaks_the_line_and_a_gap_in_the_recording_does_not(tmp_path):
    placed = [*drive(50, **STRAIGHT), *drive(50, begin=11.0, **STRAIGHT)]
    gap = [one for one in drive(200, **STRAIGHT) if not 10.5 < one[0] < 12.5]
    for name, sent, breaks in (('placed', placed, [50]), ('gap', gap, [])):
        assert timeline(read_run(write_bag(tmp_path / name, sent))).breaks.tolist() == breaks


# --- Long runs


def test_a_long_line_keeps_its_extremes_and_its_ends():
    rng = np.random.default_rng(1)
    rows = np.column_stack([np.arange(100_000.0), rng.normal(size=100_000)])
    rows[77_777, 1], rows[33, 1] = 50.0, -50.0
    kept = line(rows, np.array([50_000]))
    assert len(kept) < 4 * BUCKETS + 4
    assert {33.0, 77_777.0, 0.0, 99_999.0} <= set(kept[:, 0])
    assert np.isnan(kept[:, 1]).sum() == 1
    assert (np.diff(kept[~np.isnan(kept[:, 0]), 0]) > 0).all()
    assert line(rows[:1000], np.array([], dtype=int)).tolist() == rows[:1000].tolist()


def test_a_long_line_with_very_many_gaps_is_drawn_without_them():
    count = 100_000
    rows = np.column_stack([np.arange(count), np.sin(np.arange(count))])
    kept = line(rows, np.arange(10, count, 10))
    assert np.isfinite(kept).all()
    assert len(kept) < count / 5
    np.testing.assert_allclose(
        [kept.min(axis=0), kept.max(axis=0)], [rows.min(axis=0), rows.max(axis=0)]
    )


# --- CSV


@pytest.mark.usefixtures('undrawn')
def test_csv_holds_the_numbers_of_the_run(bag, run, tmp_path):
    assert plot(bag, '-o', tmp_path / 'a.png', '--csv', tmp_path / 'a.csv').code == 0
    columns, one = read_csv(tmp_path / 'a.csv'), timeline(run)
    assert columns.dtype.names == COLUMNS
    assert columns['time_s'].tolist() == one.time.tolist()
    rounded = {'rtol': 0.0, 'atol': 5.1e-10}
    for name, values in zip(COLUMNS[1:6], run.odometry.values.T, strict=True):
        np.testing.assert_allclose(columns[name], values, **rounded)
    np.testing.assert_allclose(columns['distance_m'], one.distance, **rounded)
    assert np.isnan(columns['goal_heading_error_rad']).all()
    np.testing.assert_allclose(columns['bearing_error_rad'], one.bearing_error, **rounded)
    assert columns['omega_right_radps'].tolist() == run.wheels.values[:, 0].tolist()
    assert columns['omega_left_radps'].tolist() == run.wheels.values[:, 1].tolist()
    first = np.flatnonzero(one.goal == one.goal.max())
    goal, *places = np.vstack([run.goals.values[-1:, :2], run.odometry.values[first, :2]]) @ [1.0, 1.0j]
    way = goal - places[0]
    beyond = ((np.array(places) - goal) * way.conjugate()).real / abs(way)
    np.testing.assert_allclose(columns['beyond_goal_m'][first], beyond, **rounded)
    assert beyond[0] == pytest.approx(-abs(way))
    assert np.ptp(beyond) > 0.1
    held = [math.nan] * 25 + [0.5] * 75 + [0.25] * 100
    np.testing.assert_array_equal(columns['v_command_mps'], held)


@pytest.mark.usefixtures('undrawn')
def test_csv_has_exact_times_and_no_artefacts_of_floats(tmp_path):
    begin = 1_795_213_077
    sent = [
        (begin, '/odom', odom(57.303999999999995, 0.1 + 0.2, -1e-12, seconds=begin)),
        (begin + 1, '/odom', odom(-999999.123456789, 1e-9, 0.0, seconds=begin)),
    ]
    sent[1][2].header.stamp.nanosec = 123_456_789
    bag = write_bag(tmp_path / 'bag', sent)
    assert plot(bag, '--csv', tmp_path / 'a.csv').code == 0
    _, first, second = (tmp_path / 'a.csv').read_text().splitlines()
    empty = ',' * (len(COLUMNS) - 6)
    assert first == '0,57.304,0.3,0,0,0' + empty
    assert second == '0.123456789,-999999.123456789,0.000000001,0,0,0' + empty


def test_csv_times_are_exact():
    times = {
        0: '0',
        1: '0.000000001',
        -1: '-0.000000001',
        2**63 - 1: '9223372036.854775807',
        5 * SECOND: '5',
    }
    assert {time: decimal_seconds(time) for time in times} == times


@pytest.mark.usefixtures('undrawn')
def test_csv_prefers_the_commands_that_were_applied(tmp_path):
    extra = [(10.0, '/cmd_vel', twist(9, 9)), (10.5, '/cmd_vel_out', twist_stamped(1, 2, 10 * SECOND))]
    bag = write_bag(tmp_path / 'bag', sample(extra))
    assert plot(bag, '--csv', tmp_path / 'a.csv').code == 0
    columns = read_csv(tmp_path / 'a.csv')
    assert set(columns['v_command_mps']) == {1.0}
    assert set(columns['omega_command_radps']) == {2.0}


@pytest.mark.usefixtures('undrawn')
def test_several_runs_get_one_picture_and_a_table_each(folder):
    bags = [odometry_only(folder / name / 'bag', v=v) for name, v in (('x', 0.2), ('y', 0.5))]
    # A directory that is not there, and then is.
    for force in ((), ('--force',)):
        assert plot(*bags, '--csv', 'numbers', *force).code == 0
        speeds = {one.name: read_csv(one)['v_mps'][0] for one in (folder / 'numbers').iterdir()}
        assert speeds == {'x_bag.csv': 0.2, 'y_bag.csv': 0.5}
        assert (folder / 'x' / 'bag_and_bag.png').exists()


def test_names_are_as_long_as_it_takes():
    assert names([Path('/a/run')]) == ['run']
    assert names([Path('/a/run'), Path('/b/walk')]) == ['run', 'walk']
    assert names([Path('/a/x/run'), Path('/b/x/run')]) == ['a/x/run', 'b/x/run']


# --- Notes


@pytest.mark.usefixtures('undrawn')
def test_messages_that_were_skipped_are_reported_in_picture_and_terminal(run, tmp_path):
    wrong = [(13.9, '/joint_command', joint_command(1e308, 0))] * 3
    bag = write_bag(tmp_path / 'bag', sample(wrong))
    note = '3 of 3 messages on /joint_command hold invalid or implausible values and were skipped'
    assert plot(bag) == (0, f'{tmp_path / "bag.png"}\n', f'plot_run: {bag}: {note}\n')
    noted = read_run(bag)
    assert figure([noted]).get_supxlabel() == note
    assert figure([run]).get_supxlabel() == ''
    # Notes of several runs name them, and are not too many.
    several = figure([replace(noted, path=Path(f'r{index}$')) for index in range(6)])
    lines = several.get_supxlabel().splitlines()
    assert [one[:5] for one in lines[:3]] == [r'r0\$:', r'r1\$:', r'r2\$:']
    assert lines[3:] == ['and 3 more notes']


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
    ]
    for option, ending in (('-o', 'png'), ('--csv', 'csv')):
        for place, words in (
            (f'none/deeper/a.{ending}', 'No such file or directory'),
            (f'notes/a.{ending}', 'Not a directory'),
        ):
            cases.append((1, (option, place), (f'{place} cannot be written: {words}',)))
    for code, arguments, words in cases:
        message = refused('no_bag', *arguments, code=code)
        assert all(word in message for word in words), (arguments, message)
    assert sorted(os.listdir(folder)) == ['notes', 'x.png']


def test_a_bag_without_odometry_is_refused(run, tmp_path):
    bag = write_bag(tmp_path / 'bag', [(1.0, '/cmd_vel', twist(0, 0))])
    message = refused(bag)
    assert str(bag) in message
    assert 'no odometry' in message
    assert not (tmp_path / 'bag.png').exists()
    empty = read_run(write_bag(tmp_path / 'empty', []))
    with pytest.raises(BagError, match='no odometry'):
        draw([run, empty], tmp_path / 'a.png')


def test_files_are_checked_also_when_they_are_written(run, tmp_path):
    with pytest.raises(ValueError, match=r'must end in \.png, \.svg, \.pdf'):
        draw([run], tmp_path / 'a.gif')
    (tmp_path / 'a.png').touch()
    for write in (lambda path: draw([run], path), lambda path: output_files.create(path, b'x')):
        with pytest.raises(FileExistsError):
            write(tmp_path / 'a.png')


@pytest.mark.usefixtures('undrawn')
def test_where_nobody_may_write_is_told(bag, tmp_path):
    # For root, too, there is no such place.
    ended = plot(bag, '-o', tmp_path / 'a.png', '--csv', '/proc/no/a.csv')
    assert (ended.code, ended.out) == (1, f'{tmp_path}/a.png\n')
    assert commands.error_of('plot_run', ended).startswith('/proc/no/a.csv cannot be written: ')


@pytest.mark.usefixtures('undrawn')
def test_a_file_that_cannot_be_finished_is_taken_away(bag, folder, monkeypatch):
    class Full:
        def __init__(self, path, mode):
            Path(path).touch()

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def write(self, data):
            raise OSError(28, 'No space left on device')

    monkeypatch.setattr(output_files, 'open', Full, raising=False)
    message = refused(bag, '-o', 'a.png', code=1)
    assert message == 'a.png cannot be written: No space left on device'
    assert list(folder.iterdir()) == []


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


def test_without_matplotlib_it_says_how_to_get_it(bag, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    monkeypatch.setitem(sys.modules, 'matplotlib.figure', None)
    assert "pip install 'diffdrive_jacobian[plot]'" in refused(bag, '-o', 'a.png')
    assert list(folder.iterdir()) == []


@pytest.mark.usefixtures('undrawn')
def test_a_topic_may_have_another_name(tmp_path):
    sent = [(at, f'/{robot}{topic}', one) for robot in 'ab' for at, topic, one in sample()]
    bag = write_bag(tmp_path / 'bag', sent)
    message = refused(bag)
    assert 'several topics' in message
    assert '/a/' in message
    assert plot(bag, *(f'--topic={name}=b/{name}' for name in ('odom', 'joint_states'))).code == 0


def test_a_signal_ends_the_drawing(bag, tmp_path, monkeypatch):
    class EndedError(Exception):
        pass

    def end():
        raise EndedError

    signals = Signals(end)
    monkeypatch.setattr(_figure, 'render', lambda *_: os.kill(os.getpid(), signal.SIGHUP))
    before = {number: signal.getsignal(number) for number in CAUGHT}
    try:
        signals.catch()
        with pytest.raises(EndedError):
            commands.run('plot_run', bag, '-o', tmp_path / 'run.png', signals=signals)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert not (tmp_path / 'run.png').exists()
