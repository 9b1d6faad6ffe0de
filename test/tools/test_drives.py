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

"""Drives from Python and by the tool drive_to, mostly in simulated time."""

from __future__ import annotations

import errno
import math
import os
import re
import threading
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from rclpy.parameter import Parameter
from support import commands

from diffdrive_jacobian.bags import journal, read_run
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.drives import (
    drive,
    in_lockstep,
    in_real_time,
    waypoints_through,
)
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.lockstep import runner as lockstep_runner
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.remote_goal import Result, send_goal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.recording.recording import Recording
from diffdrive_jacobian.testing import Lockstep
from diffdrive_jacobian.tools import _output

pytestmark = pytest.mark.slow
QUICK = {'kp': 12.0, 'kv': 3.0}
# Integers are taken for doubles.
QUICK_ARGUMENTS = ('--ros-args', '-p', 'kp:=12', '-p', 'kv:=3')
CONFIG = Path(__file__).parents[2] / 'config'
RECORD = ('--no-plot', '-o', 'bag')


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Where bags are recorded."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


# --- From Python


def test_a_drive_returns_the_outcome_and_reports_its_progress():
    progress = Mock()
    outcome = drive([[0.2, 0.0], [0.2, 0.2]], lockstep=True, parameters=QUICK, progress=progress)
    assert outcome.arrived
    assert not outcome.interrupted
    assert outcome.distance <= 0.02
    assert math.dist(outcome.pose[:2], (0.2, 0.2)) == pytest.approx(outcome.distance)
    names = ['/virtual_robot', '/wheel_bridge', '/go_to_goal', '/drive_to']
    progress.nodes_created.assert_called_once_with(names)
    states = [call.args for call in progress.driving.call_args_list]
    seconds, indices, distances, _ = zip(*states, strict=True)
    assert list(seconds) == sorted(seconds)
    assert sorted(set(indices)) == [0, 1]
    assert distances[0] == pytest.approx(0.2)


def test_drives_in_lockstep_are_reproducible_and_recorded_where_the_caller_says():
    parameters = {'controller': 'offset_point', 'offset': 0.2, **QUICK}
    recording = Recording(Path('bag'), lossless=True)
    first = drive([[0.3, 0.1]], lockstep=True, parameters=parameters, recording=recording)
    recording.finish()
    second = drive([[0.3, 0.1]], lockstep=True, parameters=parameters)
    assert first.pose.tobytes() == second.pose.tobytes()
    assert (first.seconds, first.distance) == (second.seconds, second.distance)
    np.testing.assert_array_equal(read_run(Path('bag')).odometry.values[-1, :3], first.pose)
    # The distance is that of the driven point.
    x, y, theta = first.pose
    point = (x + 0.2 * math.cos(theta), y + 0.2 * math.sin(theta))
    assert first.distance == pytest.approx(math.dist(point, (0.3, 0.1)))
    assert first.distance <= 0.02


@pytest.mark.parametrize(
    ('options', 'error', 'words'),
    [
        ({'parameters': {'kp': -1.0}}, UserError, "'kp' must be in"),
        ({'ros_arguments': ['--ros-args', '--no']}, UserError, 'unknown ROS arguments'),
        ({'isolated': False}, ValueError, 'isolated'),
        ({'timeout': math.nan}, ValueError, 'timeout'),
        ({'goals': [1.0, 1.0]}, ValueError, r'goals must have shape \(n, 2\)'),
        ({'goals': np.zeros((0, 3))}, ValueError, 'goals must have shape'),
    ],
)
def test_invalid_arguments_are_named(options, error, words):
    with pytest.raises(error, match=words):
        drive(**{'goals': [[1.0, 1.0]], 'lockstep': True, **options})


def test_a_runner_has_its_own_arguments():
    with in_lockstep() as runner, pytest.raises(ValueError, match='are those of the runner'):
        drive([[1.0, 1.0]], runner=runner, lockstep=True)
    for name in ('timeout', 'patience'):
        with pytest.raises(ValueError, match=f'{name} must be positive'):
            send_goal([1.0, 1.0, 0.0], **{name: -1.0})


@pytest.mark.parametrize('run', [in_lockstep, in_real_time])
def test_goals_are_sent_one_after_the_other_in_one_runner(run):
    with run() as runner:
        runner.add(lambda: VirtualRobot(context=runner.context))
        controller = runner.add(lambda: GoToGoal(context=runner.context))
        controller.set_parameters([Parameter('kv', value=4.0), Parameter('kp', value=12.0)])
        for x in (0.1, 0.2):
            assert send_goal([x, 0.0, 0.0], runner=runner).arrived
            assert runner.spin(lambda: not controller.count_publishers('/goal_pose'), timeout=5.0)


def test_a_goal_that_is_not_reached_is_canceled_also_where_no_timer_runs():
    with in_lockstep() as runner:
        sent = send_goal([0.5, 0.0, 0.0], runner=runner, patience=2.0)
        assert sent.result is Result.NOT_SENT
        controller = runner.add(lambda: GoToGoal(context=runner.context))
        sent = send_goal([0.5, 0.0, 0.0], runner=runner, timeout=2.0)
        assert (sent.result, sent.canceled) == (Result.TIMEOUT, True)
        # By an error of who is told of its progress.
        runner.add(lambda: VirtualRobot(context=runner.context))
        progress = Mock(**{'driving.side_effect': BrokenPipeError})
        with pytest.raises(BrokenPipeError):
            send_goal([5.0, 0.0, 0.0], runner=runner, progress=progress)
        assert controller.waypoint is None
        assert controller.get_publishers_info_by_topic('/goal_pose') == []


def test_waypoints_have_the_direction_to_the_next():
    waypoints = waypoints_through([[0, 0], [1, 0], [1, 2]], heading=-1.0)
    np.testing.assert_allclose(waypoints, [[0, 0, 0], [1, 0, math.pi / 2], [1, 2, -1.0]])
    np.testing.assert_array_equal(waypoints_through([[3, 4]]), [[3, 4, 0]])


# --- drive_to


def drive_to(*arguments, code=0):
    """Run drive_to in simulated time; return the line about the drive."""
    ended = commands.run('drive_to', '--lockstep', *arguments)
    assert ended.code == code, ended
    return next(line for line in ended.out.splitlines() if 'the robot stopped' in line)


@pytest.mark.parametrize('x', [-0.2, 0])
def test_arrives_behind_and_where_it_is_with_the_parameters_of_a_file(x):
    file = CONFIG / 'turtlebot3_burger.yaml'
    line = drive_to(x, 0, '--params-file', file, *RECORD, *QUICK_ARGUMENTS)
    found = re.match(r'arrived: the robot stopped at x (\S+) m, y (\S+) m,', line)
    assert math.dist(map(float, found.groups()), (x, 0)) <= 0.021
    assert read_run(Path('bag')).of_node('virtual_robot')['wheel_separation'] == 0.16


def test_the_true_distance_of_a_robot_that_slips_is_that_of_its_ground_truth():
    slip = ('-p', 'simulate_slip:=true', '-p', 'wheel_travel_variance:=0.01')
    line = drive_to(0.5, 0.5, *RECORD, *QUICK_ARGUMENTS, *slip)
    found = re.search(r' (\S+) m from the goal by odometry, (\S+) m by ground truth, after', line)
    distance, truth = map(float, found.groups())
    end = read_run(Path('bag')).ground_truth.values[-1, :2]
    assert distance <= 0.02 < truth
    assert truth == pytest.approx(math.dist(end, (0.5, 0.5)), abs=1e-3)


@pytest.mark.parametrize('controller', ['pose', 'offset_point'])
def test_a_controller_arrives_and_takes_the_heading_that_is_asked_for(controller):
    options = ('--heading', -2.5, '--controller', controller)
    line = drive_to(0.3, 0.3, 0, 0.6, *options, *RECORD, *QUICK_ARGUMENTS)
    x, y, theta = map(float, re.search(r'x (\S+) m, y (\S+) m, heading (\S+) rad', line).groups())
    offset = 0.1 if controller == 'offset_point' else 0.0
    assert math.hypot(x, y - 0.6) <= offset + 0.021
    assert theta == pytest.approx(-2.5, abs=0.021)
    run = read_run(Path('bag'))
    seen = timeline(run)
    last = seen.goal == 1
    # Of the point that is driven: it comes to each goal.
    assert max(seen.distance[~last].min(), seen.distance[last].min()) <= 0.021
    # The heading matters at the last goal alone.
    error = np.angle(np.exp(1j * (-2.5 - run.odometry.values[:, 2])))
    np.testing.assert_allclose(seen.goal_heading_error[last], error[last], atol=1e-9)
    assert np.isnan(seen.goal_heading_error[~last]).all()


def test_timeout_is_of_simulated_time_and_nothing_is_driven_afterwards():
    line = drive_to(50, 0, '--no-record', '--timeout', 0.5, code=1)
    assert line.startswith('not arrived (--timeout 0.5 s was too short): ')
    assert line.endswith('after 0.5 s of simulated time')
    # In real time. It is over before the first odometry, so before a goal was sent.
    ended = commands.run('drive_to', 1, 1, '--timeout', '1e-9', *RECORD)
    assert ended.code == 1
    assert 'the robot stopped at x 0.000 m, y 0.000 m' in ended.out
    run = read_run(Path('bag'))
    assert len(run.goals) == 0
    assert not run.cmd_vel_out.values.any()


def test_a_full_disk_is_reported(folder, monkeypatch):
    """A drive that arrives, but of which only a part is recorded, is not done."""
    write, written = os.write, []

    def limited(descriptor, data):
        if threading.current_thread().name == 'journal':
            # Less than a drive of a second.
            if sum(written) + len(data) > 20_000:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            written.append(len(data))
        return write(descriptor, data)

    monkeypatch.setattr(journal.os, 'write', limited)
    ended = commands.run('drive_to', 0.5, 0.5, '--lockstep', *RECORD, *QUICK_ARGUMENTS)
    assert ended.code == 1
    assert 'drive_to: error: the recording was aborted: No space left on device' in ended.err
    assert ended.out.splitlines()[-1] == 'recorded in part: bag'
    assert (folder / 'bag.journal.mcap').exists()


def test_a_stuck_callback_fails_and_the_recording_is_kept(monkeypatch):
    """That run is the one to look at."""
    on_odometry, never = GoToGoal._on_odometry, threading.Event()

    def stuck(self, *args):
        on_odometry(self, *args)
        while self.get_clock().now().nanoseconds > 1_500_000_000:
            never.wait(0.01)

    monkeypatch.setattr(GoToGoal, '_on_odometry', stuck)
    monkeypatch.setattr(lockstep_runner, 'Lockstep', partial(Lockstep, patience=0.5))
    ended = commands.run('drive_to', 1, 1, '--lockstep', *RECORD)
    assert ended.code == 1
    assert ended.err.startswith('drive_to: error: ')
    assert '/go_to_goal' in ended.err
    assert ended.out.splitlines()[-1] == 'recorded: bag'
    assert len(read_run(Path('bag')).odometry) >= 20


def test_a_bug_keeps_the_recording(folder, monkeypatch):
    monkeypatch.setattr(_output.GoalBar, 'show_goal', lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        commands.run('drive_to', 1, 1, '--lockstep', *RECORD)
    assert (folder / 'bag').is_dir()
