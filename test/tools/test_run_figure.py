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

"""The picture of runs: it shows their numbers, with units, and nothing overlaps."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.transforms import Bbox
from support.bags import odom, write_bag
from support.ros_messages import goal, joint_command, twist
from support.ros_messages import path as path_message
from support.runs import RATE, run_of, sample

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.plots.run_panels import COMMAND, LABELS, fault_label
from diffdrive_jacobian.plots.run_pictures import COLORS
from diffdrive_jacobian.plots.run_plane import ARROWS, PLANNED

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """A run with a goal, half a second after its begin, and commands."""
    extra = [
        (10.5, '/goal_pose', goal(1.0, 0.5)),
        (10.5, '/cmd_vel', twist(0.5, 0.5)),
        (12.0, '/cmd_vel', twist(0.25, 1.5)),
    ]
    return run_of(tmp_path_factory.mktemp('bag'), extra)


def by_label(made):
    """Return the panels over time by their titles, without limits."""
    return {one.get_title(loc='left').partition(', limit')[0]: one for one in made.axes[1:]}


def drawn(axes):
    """Return the points of the lines of the first run, without their gaps."""
    rows = [np.column_stack(one.get_data()) for one in axes.lines if one.get_color() == COLORS[0]]
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


# --- Quantities over time


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
    for quantity, values in shown.items():
        expected = np.column_stack([np.arange(200) / RATE - 0.5, values])[~np.isnan(values)]
        assert drawn(axes[LABELS[quantity]]) == pytest.approx(expected, abs=1e-9)
    (line,) = commanded(made)
    assert line.get_drawstyle() == 'steps-post'
    values = [[0.0, 0.5], [1.5, 0.25], [199 / RATE - 0.5, 0.25]]
    assert np.column_stack(line.get_data()) == pytest.approx(np.array(values), abs=1e-9)
    assert written(made)[0] == 'run: not arrived within 3.5 s, 1.74 m driven'


def test_limits_are_drawn_where_they_are_near(run):
    def bounds(parameters):
        made = run_figure(replace(run, parameters={'/virtual_robot': parameters}))
        panel = by_label(made)[LABELS['v']]
        found = {one.get_ydata()[0] for one in panel.lines if one.get_color() == 'black'}
        assert ('limit' in legends(made)) == bool(found)
        title = panel.get_title(loc='left')
        assert title.partition(', limit ')[2] == ' and '.join(f'{one:g}' for one in sorted(found))
        return found

    # It drives with 0.5 m/s.
    assert bounds({'linear.x.max_velocity': 0.22, 'linear.x.min_velocity': -0.1}) == {0.22}
    assert bounds({'linear.x.max_velocity': 0.7}) == {0.7}
    assert bounds({'linear.x.max_velocity': 0.8}) == set()


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


def test_without_goals_wheels_and_limits_these_are_left_out(tmp_path):
    sent = [one for one in sample(count=9) if one[1] == '/odom']
    plain = read_run(write_bag(tmp_path / 'bag', sent))
    # More runs than there are styles.
    made = run_figure([replace(plain, path=Path(f'run_{index}')) for index in range(7)])
    assert set(by_label(made)) == {LABELS['v'], LABELS['omega']}
    assert legends(made)[7:] == ['start', 'end']
    assert by_label(made)[LABELS['omega']].get_xlabel() == 'time [s]'


# --- The plane


def test_the_robot_is_drawn_to_scale_where_its_size_is_known(run):
    sized = {'/virtual_robot': {'wheel_radius': 0.03, 'wheel_separation': 0.2}}
    made = run_figure(replace(run, parameters=sized))
    bodies = [one.get_xy() for one in made.axes[0].patches if len(one.get_xy()) == 7]
    # From the left to the right wheel, at the start and at the end.
    ends = run.odometry.values[[0, -1], :3]
    for body, (x, y, theta) in zip(bodies, ends, strict=True):
        lateral = (body - [x, y]) @ [-np.sin(theta), np.cos(theta)]
        assert np.ptp(lateral) == pytest.approx(0.84 * 0.2)
    assert 'robot at the end' in legends(made)
    # It would be a dot, or its size is not known.
    for parameters in ({'/virtual_robot': {'wheel_radius': 1e-3, 'wheel_separation': 2e-3}}, {}):
        made = run_figure(replace(run, parameters=parameters))
        assert not made.axes[0].patches
        assert 'end' in legends(made)


def test_the_plane_has_goals_headings_and_planned_paths(tmp_path):
    values = {'controller': 'go_to_goal', 'use_goal_heading': True, 'xy_goal_tolerance': 0.05}
    planned = path_message((0.0, 0.0, 0.0), (1.0, 0.5, 0.0), times=[0.0, 3.0])
    sent = [(10.5, '/goal_pose', goal(1.0, 0.5, 1.5)), (12.0, '/path', planned)]
    made = run_figure(run_of(tmp_path, sent, parameters={'/go_to_goal': values}))
    plane = made.axes[0]
    (circles,) = (one for one in plane.collections if 'PatchCollection' in type(one).__name__)
    box = circles.get_paths()[0].get_extents()
    assert box.extents == pytest.approx([0.95, 0.45, 1.05, 0.55], abs=1e-3)
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
    marks = {'goal with its tolerance and heading', 'planned path', 'a goal or path begins or ends'}
    assert marks <= {*legends(made)}
    changes = [one for one in by_label(made)[LABELS['v']].lines if one.get_linestyle() == ':']
    assert [one.get_xdata()[0] for one in changes] == pytest.approx([0.0, 1.5])
    assert made.axes[-1].get_xlabel() == 'time since the start [s]'


def test_no_line_leads_to_where_the_odometry_is_reset_and_one_pose_is_drawn(tmp_path):
    sent = [(1.0 + k, '/odom', odom(5 * (k > 2), 0.01 * k, 0, seconds=1.0 + k)) for k in range(6)]
    made = run_figure(read_run(write_bag(tmp_path / 'bag', sent)))
    path = made.axes[0].lines[0]
    assert np.flatnonzero(np.isnan(path.get_xdata())).tolist() == [3]
    low, high = run_figure(read_run(write_bag(tmp_path / 'one', sent[:1]))).axes[0].get_xlim()
    assert 0.4 < high - low < 5.0


# --- Several runs, and texts


def driven(run, name, kp, controller='go_to_goal'):
    values = {'controller': controller, 'kp': kp, 'kv': 0.5}
    return replace(run, path=Path(name), parameters={'/go_to_goal': values})


def test_runs_differ_by_colour_and_by_style_and_have_no_commands(run):
    made = run_figure([replace(run, path=Path(name)) for name in 'abc'])
    named = made.legends[0]
    assert [one.get_text()[:3] for one in named.get_texts()] == ['a: ', 'b: ', 'c: ']
    assert len({one.get_color() for one in named.get_lines()}) == 3
    assert len({one.get_linestyle() for one in named.get_lines()}) == 3
    # One for each run, and zero for each.
    assert len(by_label(made)[LABELS['v']].lines) == 3 + 3
    assert commanded(made) == []


def test_gains_that_differ_stand_beside_the_runs_and_the_others_in_the_title(run):
    def lines(*runs):
        made = run_figure([*runs])
        return [*written(made), *(one.get_text() for one in made.legends[0].get_texts())]

    title, a, b = lines(driven(run, 'a', 1.0), driven(run, 'b', 2.0))
    assert title == 'control law go_to_goal: kv = 0.5 1/s'
    assert [a.rpartition('; ')[2], b.rpartition('; ')[2]] == ['kp = 1 1/s', 'kp = 2 1/s']
    _, title = written(run_figure(driven(run, 'a', 1.0)))
    assert title == 'control law go_to_goal: kp = 1 1/s, kv = 0.5 1/s'
    a, b = lines(driven(run, 'a', 1.0), driven(run, 'b', 1.0, 'pose'))
    assert a.endswith('; go_to_goal: kp = 1 1/s, kv = 0.5 1/s')
    assert b.endswith('; pose: kp = 1 1/s, kv = 0.5 1/s')


def test_notes_of_several_runs_name_them_and_are_not_too_many(run):
    runs = [replace(run, path=Path(f'r{index}$'), notes=('noted',)) for index in range(5)]
    assert written(run_figure(runs[0]))[-1] == 'noted'
    *lines, last = written(run_figure(runs))[-4:]
    assert lines == [rf'r{index}\$: noted' for index in range(3)]
    assert last == 'and 2 more notes'


def test_numbers_of_faults_have_two_decimals():
    fault = "Loss('odom', probability=0.8151234, burst=3, start=12.00412, duration=0.000123456)"
    found = fault_label(fault)
    assert found.startswith("Loss('odom', probability=0.82, burst=3, start=12.00, durati")
    assert len(found) == 60


def overlapping(made):
    """Return what overlaps, of texts and of axes with their labels, or is not in the picture."""
    made.draw_without_rendering()
    boxes = [(one.get_text(), one.get_window_extent()) for one in made.texts]
    boxes += [('legend', one.get_window_extent()) for one in made.legends]
    # Labels of goals are in the plane.
    boxes += [(one.get_label(), one.get_tightbbox(bbox_extra_artists=[])) for one in made.axes]
    page = made.bbox.padded(0.5)
    found = [name for name, box in boxes if not page.containsx(box.x0) or not page.containsx(box.x1)]
    found += [name for name, box in boxes if not page.containsy(box.y0) or not page.containsy(box.y1)]
    for index, (name, box) in enumerate(boxes):
        for other, another in boxes[:index]:
            common = Bbox.intersection(box, another)
            # Axes have half a pixel.
            if common is not None and min(common.width, common.height) > 1.0:
                found.append((name, other))
    return found


SHAPES = [((1.0, 0.0), 1), ((1.0, 0.3), 12), ((1.0, 0.9), 1), ((0.5, 1.0), 7), ((0.0, 1.0), 2)]
"""Ends of the goal, and numbers of runs: the plane is above the panels, or beside them."""


@pytest.mark.parametrize(('shape', 'runs'), SHAPES)
def test_nothing_overlaps_with_up_to_nine_panels_whatever_the_names(tmp_path, shape, runs):
    """With goals, a trajectory that waits, wheels, long names and notes."""
    x, y = shape
    places = [(x * k / 4, y * k / 4, 0.0) for k in range(5)]
    planned = path_message(*places, times=[0.0, 0.1, 0.2, 0.3, 0.4])
    wrong = [(10.1, '/joint_command', joint_command(1e308, 0))] * 3
    sent = [*wrong, (10.5, '/goal_pose', goal(x, y)), (11.0, '/path', planned)]
    read = run_of(tmp_path, sent)
    read.odometry.values[:, 0] *= x
    read.odometry.values[:, 1] = y * np.arange(200) / 200
    made = run_figure([replace(read, path=Path(f'{number}_{60 * "x"}')) for number in range(runs)])
    assert len(by_label(made)) >= 8
    assert overlapping(made) == []


def test_long_lists_of_gains_are_wrapped_and_cut_whatever_the_users_style(run):
    gains = {f'gain_{"x" * 12}_{letter}': 1.25 for letter in 'abcdefghijkl'}
    long = replace(run, parameters={'/go_to_goal': {'controller': 'mine', **gains}})
    with matplotlib.rc_context({'figure.figsize': (1, 1), 'text.usetex': True}):
        made = run_figure(long)
        several = run_figure([long, driven(run, 'other', 1.0, 'pose')])
        assert matplotlib.rcParams['text.usetex'] is True
    assert sum('gain_' in one for one in written(made)) == 3
    assert overlapping(made) == overlapping(several) == []
    assert made.get_size_inches()[0] == 11.0


def test_labels_of_goals_are_apart(tmp_path):
    """Also of goals at nearly the same place."""
    sent = [(10.1 + 0.1 * k, '/goal_pose', goal(1.0 + 0.01 * k, 0.5)) for k in range(12)]
    made = run_figure(run_of(tmp_path, sent))
    made.draw_without_rendering()
    boxes = [one.get_window_extent() for one in made.axes[0].texts]
    assert len(boxes) > 4
    assert not any(a.overlaps(b) for index, a in enumerate(boxes) for b in boxes[index + 1 :])
