"""Drives from Python, without the command line."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from rclpy.parameter import Parameter

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.drives import (
    DriveError,
    Outcome,
    drive,
    in_lockstep,
    in_real_time,
    waypoints_through,
)
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.remote_goal import Result, send_goal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.recording.recording import Recording
from diffdrive_jacobian.signals import Signals

QUICK = {'kp': 12.0, 'kv': 3.0}


class Progress:
    """Keeps what it receives."""

    def __init__(self):
        self.names = []
        self.states = []

    def nodes_created(self, names):
        self.names += names

    def driving(self, *state):
        self.states.append(state)


def test_a_drive_from_python_returns_the_outcome():
    progress = Progress()
    outcome = drive([[0.5, 0.0], [0.5, 0.5]], lockstep=True, parameters=QUICK, progress=progress)
    assert isinstance(outcome, Outcome)
    assert outcome.arrived
    assert not outcome.interrupted
    assert outcome.distance <= 0.02
    assert math.dist(outcome.pose[:2], (0.5, 0.5)) == pytest.approx(outcome.distance)
    assert progress.names == ['/virtual_robot', '/wheel_bridge', '/go_to_goal', '/drive_to']
    seconds, indices, distances, _ = zip(*progress.states, strict=True)
    assert list(seconds) == sorted(seconds)
    assert sorted(set(indices)) == [0, 1]
    assert distances[0] == pytest.approx(0.5)


def test_drives_in_lockstep_are_reproducible():
    first, second = (drive([[0.3, 0.2]], lockstep=True, parameters=QUICK) for _ in range(2))
    assert first.pose.tobytes() == second.pose.tobytes()
    assert (first.seconds, first.distance) == (second.seconds, second.distance)


def test_a_drive_is_recorded_where_the_caller_says(tmp_path):
    recording = Recording(tmp_path / 'bag', 'mcap', lossless=True)
    outcome = drive([[0.3, 0.0]], lockstep=True, parameters=QUICK, recording=recording)
    recording.finish()
    run = read_run(tmp_path / 'bag')
    np.testing.assert_array_equal(run.odometry.values[-1, :3], outcome.pose)


def test_distance_is_that_of_the_driven_point():
    parameters = {'controller': 'offset_point', 'offset': 0.2, **QUICK}
    outcome = drive([[0.5, 0.0]], lockstep=True, parameters=parameters)
    x, y, theta = outcome.pose
    point = (x + 0.2 * math.cos(theta), y + 0.2 * math.sin(theta))
    assert outcome.offset == 0.2
    assert outcome.distance == pytest.approx(math.dist(point, (0.5, 0.0)))
    assert outcome.distance <= 0.02


def test_timeout_and_signals_end_a_drive():
    late = drive([[50.0, 0.0]], lockstep=True, timeout=0.5)
    assert not late.arrived
    assert late.seconds == pytest.approx(0.5, abs=0.03)
    signals = Signals()
    signals.count = 1
    assert drive([[50.0, 0.0]], lockstep=True, signals=signals).interrupted


def test_errors_are_typed(monkeypatch):
    with pytest.raises(UserError, match="'kp' must be in"):
        drive([[1.0, 1.0]], lockstep=True, parameters={'kp': -1.0})
    with pytest.raises(UserError, match='unknown ROS arguments'):
        drive([[1.0, 1.0]], lockstep=True, ros_arguments=['--ros-args', '--no-such-option'])
    with pytest.raises(ValueError, match='a drive in lockstep is always isolated'):
        drive([[1.0, 1.0]], lockstep=True, isolated=False)
    with pytest.raises(ValueError, match=r'must have shape \(n, 2\)'):
        drive([1.0, 1.0], lockstep=True)
    with in_lockstep() as runner, pytest.raises(ValueError, match=r'goals must have shape \(n, 3\)'):
        drive(np.zeros((0, 3)), runner=runner)
    with in_lockstep() as runner, pytest.raises(ValueError, match='are those of the runner'):
        drive([[1.0, 1.0]], runner=runner, lockstep=True)

    def sleep(self, *_):
        self.get_clock().sleep_until(self.get_clock().now() + GoToGoal.LONG)

    from rclpy.duration import Duration

    monkeypatch.setattr(GoToGoal, 'LONG', Duration(seconds=10), raising=False)
    monkeypatch.setattr(GoToGoal, '_on_odometry', sleep)
    with pytest.raises(DriveError, match='sleeps on its clock'):
        drive([[1.0, 1.0]], lockstep=True)


@pytest.mark.parametrize('timeout', [-1.0, 0.0, math.nan])
def test_times_are_positive(timeout):
    with pytest.raises(ValueError, match='timeout must be positive'):
        drive([[1.0, 1.0]], lockstep=True, timeout=timeout)
    with pytest.raises(ValueError, match='timeout must be positive'):
        send_goal([1.0, 1.0, 0.0], timeout=timeout)
    with pytest.raises(ValueError, match='patience must be positive'):
        send_goal([1.0, 1.0, 0.0], patience=timeout)


def test_goals_are_sent_one_after_the_other_in_one_runner():
    for run in (in_lockstep, in_real_time):
        with run() as runner:
            nodes = [
                runner.add(lambda node=node: node(context=runner.context))
                for node in (VirtualRobot, GoToGoal)
            ]
            nodes[1].set_parameters([Parameter('kv', value=4.0), Parameter('kp', value=12.0)])
            for x in (0.2, 0.4):
                assert send_goal([x, 0.0, 0.0], runner=runner).arrived
                left = partial(nodes[0].count_publishers, '/goal_pose')
                assert runner.spin(lambda left=left: not left(), timeout=5.0)


def test_an_error_of_the_progress_cancels_the_goal():
    class Broken(Progress):
        def waiting(self, reason):
            pass

        def driving(self, *state):
            raise BrokenPipeError

    with in_lockstep() as runner:
        robot = runner.add(lambda: VirtualRobot(context=runner.context))
        controller = runner.add(lambda: GoToGoal(context=runner.context))
        with pytest.raises(BrokenPipeError):
            send_goal([5.0, 0.0, 0.0], runner=runner, progress=Broken())
        assert controller.waypoint is None
        assert robot.get_publishers_info_by_topic('/goal_pose') == []


def test_a_goal_is_sent_where_no_timer_runs():
    with in_lockstep() as runner:
        sent = send_goal([0.5, 0.0, 0.0], runner=runner, patience=2.0)
        assert sent.result is Result.NOT_SENT
        runner.add(lambda: GoToGoal(context=runner.context))
        sent = send_goal([0.5, 0.0, 0.0], runner=runner, timeout=2.0)
        assert (sent.result, sent.canceled) == (Result.TIMEOUT, True)


def test_waypoints_have_the_direction_to_the_next():
    waypoints = waypoints_through([[0, 0], [1, 0], [1, 2]], heading=-1.0)
    np.testing.assert_allclose(waypoints, [[0, 0, 0], [1, 0, math.pi / 2], [1, 2, -1.0]])
    np.testing.assert_array_equal(waypoints_through([[3, 4]]), [[3, 4, 0]])
