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

"""Paths that are driven: by drive_to, by send_path, and how their runs are read, tabulated and drawn."""

from __future__ import annotations

import csv
import io
import math
import re

import numpy as np
import pytest
from nav_msgs.msg import Path as PathMessage
from support.bags import status
from support.ros_messages import goal, odometry, path, receive, time_of
from support.runs import STRAIGHT, run_of

from diffdrive_jacobian.bags.run import read_run
from diffdrive_jacobian.bags.table import csv_text
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.control import Path, circle_path, line_path
from diffdrive_jacobian.drives import drive, in_lockstep
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import GoalClient
from diffdrive_jacobian.nodes.remote_goal import Result, send_goal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.recording.recording import Recording
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools.drive_to import main

pytestmark = pytest.mark.slow


def panels(run):
    return [axes.get_title(loc='left') for axes in run_figure(run).axes]


def last_row(run, column):
    """Return the last row of the table of a run in which a column has a value."""
    *_, row = (row for row in csv.DictReader(io.StringIO(csv_text(run))) if row[column])
    return row


def test_a_robot_that_takes_time_stops_at_the_end():
    takes_time = {'linear.x.max_acceleration': 0.3, 'wheel_lag': 0.2, 'command_delay': 0.2}
    known = {**takes_time, 'stop_in_time': True}
    outcome = drive(line_path(0.4), lockstep=True, parameters=known, robot_parameters=takes_time)
    assert outcome.arrived
    assert not outcome.moving
    assert outcome.distance < 0.021


def test_how_late_a_robot_is_that_is_too_slow_for_a_trajectory_is_said_everywhere(tmp_path, capfd):
    recording, slow = Recording(tmp_path / 'slow', lossless=True), {'linear.x.max_velocity': 0.2}
    trajectory = line_path(1.0).timed(0.5)
    how = {'robot_parameters': slow, 'ros_arguments': ['--ros-args', '--log-level', 'info']}
    outcome = drive(trajectory, lockstep=True, recording=recording, **how)
    recording.finish()
    one = timeline(read_run(tmp_path / 'slow'))
    assert outcome.arrived
    # 0.7 m at 0.2 m/s, and the rest as to a goal, instead of all in 2 s.
    assert outcome.late == pytest.approx(6.9, abs=0.2)
    assert f'goal reached, {outcome.late:.1f} s later than by its times' in capfd.readouterr().err
    on_path = np.isfinite(one.late)
    assert one.late[on_path][-1] == pytest.approx(outcome.late, abs=0.05)
    assert -0.33 < np.nanmin(one.along) < -0.28
    assert np.diff(one.late[on_path]).min() > -1e-9
    # It drives as fast as it can while the times wait.
    assert one.run.odometry.values[10:100, 3] == pytest.approx(np.full(90, 0.2))
    assert float(last_row(one.run, 'late_s')['late_s']) == pytest.approx(outcome.late, abs=0.05)
    assert 'behind the times [s]' in panels(one.run)


def test_a_robot_that_still_moves_is_not_said_to_have_stopped(capsys):
    arguments = ['0.2', '0', '--lockstep', '--no-record', '--command-delay', '1', '--wheel-lag', '5']
    assert main(arguments, Signals()) == 0
    out = capsys.readouterr().out
    assert 'arrived: the robot still moved at x' in out
    assert 'the robot rolled out of the tolerance of 0.02 m' in out


def test_drive_to_drives_along_a_circle_without_stopping(tmp_path, capsys):
    bag = tmp_path / 'circle'
    arguments = ['--path', 'circle:0.15', '--speed', '0.4', '--lockstep', '-o', str(bag), '--no-plot']
    assert main([*arguments, '--ros-args', '-p', 'simulate_slip:=true'], Signals()) == 0
    said = capsys.readouterr().out
    assert re.search(r'm from the end of the path, at most 0\.00.* truly 0\.\d+ m from its end', said)
    one = timeline(read_run(bag))
    ((planned,), series) = one.paths, one.run.odometry.values
    assert planned.length == pytest.approx(0.3 * math.pi, rel=1e-3)
    on_path = one.progress > 0.3
    assert on_path.sum() > 50
    speeds = series[on_path & (one.progress < 0.7), 3]
    assert speeds == pytest.approx(np.full(len(speeds), 0.4))
    assert abs(one.across[on_path]).max() < 0.01
    assert abs(one.path_heading_error[on_path]).max() < 0.03
    assert np.isnan(one.along).all()
    assert (one.path >= 0).sum() == np.isfinite(one.across).sum() > 80
    # Until the robot has arrived.
    assert one.path[-1] == -1
    assert one.progress[one.path >= 0][-1] == pytest.approx(planned.length, abs=0.021)
    row = last_row(one.run, 'path_progress_m')
    assert float(row['path_progress_m']) == pytest.approx(planned.length, abs=0.021)
    assert (row['along_path_m'], row['distance_m']) == ('', '')
    assert panels(one.run)[1:3] == ['across path [m]', 'heading to path [rad]']


def test_a_shape_begins_at_the_robot():
    start = [f'virtual_robot:{name}:={at}' for name, at in zip('xy', (2.0, 1.0), strict=True)]
    arguments = ['--ros-args', '-p', start[0], '-p', start[1], '-p', 'virtual_robot:theta:=1.5']
    outcome = drive(line_path(0.2), relative=True, lockstep=True, ros_arguments=arguments)
    assert outcome.arrived
    assert outcome.across < 1e-6
    expected = 2.0 + 0.2 * math.cos(1.5), 1.0 + 0.2 * math.sin(1.5)
    assert outcome.pose[:2] == pytest.approx(expected, abs=0.021)


def test_send_path_follows_a_path_cancels_a_long_one_and_reports_a_refused_one():
    with in_lockstep() as runner:
        runner.add(lambda: VirtualRobot(context=runner.context))
        runner.add(lambda: GoToGoal(context=runner.context))
        arrived = send_goal(circle_path(0.15), runner=runner, relative=True)
        canceled = send_goal(line_path(5.0), runner=runner, relative=True, timeout=0.5)
        refused = send_goal(line_path(5.0), runner=runner, frame='map')
    assert arrived.arrived
    assert arrived.topic == '/path'
    assert arrived.across < 0.01
    assert arrived.distance < 0.03
    assert (canceled.result, canceled.canceled) == (Result.TIMEOUT, True)
    assert 4.0 < canceled.distance < 5.0
    assert (refused.status, refused.across) == (GoalState.ABORTED, None)
    with pytest.raises(ValueError, match='path must have at most 10000 poses, got 20001'):
        send_goal(Path(np.column_stack([np.arange(20_001.0)] * 2)))


def test_a_trajectory_is_sent_with_stamps_where_the_robot_is(ros):
    def create(context, parameter_overrides):
        return GoalClient('client', line_path(1.0).timed(0.5), context, relative=True)

    client = ros.add(create, parameters=None)
    received = ros.listen(PathMessage, 'path')
    ros.add(GoToGoal)
    missing = 'no odometry on /odom, where the path is to begin'
    ros.until(lambda: client.obstacle() == missing, 'odometry is missing')
    receive(client, '/odom', odometry(1.0, 2.0, math.pi / 2))
    assert client.obstacle() is None
    client.send()
    ros.until(lambda: received, 'the path is received')
    (message,) = received
    position = message.poses[-1].pose.position
    assert (position.x, position.y) == pytest.approx((1.0, 3.0))
    stamps = [time_of(one) for one in message.poses]
    assert stamps[-1] - stamps[0] == 2 * 10**9
    assert time_of(message) == stamps[0]
    assert client.distance == pytest.approx(1.0)


# --- Timelines


ROUTE = path((0, 0), (5, 0))
ONCE = [(0.0, -1), (1.0, 0), (2.0, -1)]
STARTED = [(11.0, '/path', ROUTE), (11.0, '/goal_status', status(2))]
REFUSED = [
    (10.0, '/path', ROUTE),
    (10.01, '/goal_status', status(2)),
    (11.0, '/path', path((9, 9), stamp=7)),
    (11.01, '/goal_status', status(6, seconds=7)),
    (11.02, '/goal_status', status(2)),
]


@pytest.mark.parametrize(
    ('messages', 'expected'),
    [
        ([(11.0, '/path', ROUTE), (12.0, '/goal_pose', goal(5, 0))], ONCE),
        ([*STARTED, (11.99, '/goal_status', status(4))], ONCE),
        ([*STARTED, (11.99, '/goal_status', status(6))], ONCE),
        (REFUSED, [(0.0, 0)]),
    ],
    ids=['replaced', 'succeeded', 'aborted', 'another is refused'],
)
def test_a_path_counts_until_it_has_ended_or_a_goal_replaces_it(tmp_path, messages, expected):
    """Each pair: a time (s), and the number of the path that counts from then on, -1 for none."""
    one = timeline(run_of(tmp_path, messages, **STRAIGHT))
    changes = [0, *(np.flatnonzero(np.diff(one.path)) + 1)]
    assert [(round(float(one.time[at]), 2), int(one.path[at])) for at in changes] == expected
    assert (one.goal >= 0).sum() == (100 if messages[-1][1] == '/goal_pose' else 0)


def test_errors_along_a_trajectory_are_those_at_its_times(tmp_path):
    """The robot is at x = 0.5 m then and drives at 0.5 m/s, as the trajectory does, but ahead of it."""
    trajectory = path((0.4, 0.0), (1.4, 0.0), times=[11.0, 13.0])
    one = timeline(run_of(tmp_path, [(11.0, '/path', trajectory)], **STRAIGHT))
    along = one.along[(one.time > 1.1) & (one.time < 2.5)]
    assert along == pytest.approx(np.full(len(along), 0.1), abs=1e-6)
