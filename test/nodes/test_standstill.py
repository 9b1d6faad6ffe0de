"""A robot that has a goal and does not move is reported."""

from __future__ import annotations

import argparse

import numpy as np
import pytest
from nav_msgs.msg import Odometry

from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes import standstill
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import GoalClient
from diffdrive_jacobian.nodes.remote_goal import GoalResult, Result, _Session, _Silent
from diffdrive_jacobian.nodes.standstill import Standstill
from diffdrive_jacobian.ros.runner import discovery_off, ros_context, running
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _sending


def test_each_standstill_is_detected_once():
    found = Standstill()
    rest, later = np.array([1.0, 2.0, 3.14]), np.array([1.1, 2.0, 3.14])
    assert [found.update(rest, now) for now in (0.0, 4.9, 5.0, 6.0, 20.0)] == [0, 0, 1, 0, 0]
    assert [found.update(later, now) for now in (21.0, 25.9, 26.0, 27.0)] == [0, 0, 1, 0]


@pytest.mark.parametrize('step', [(0.006, 0.0, 0.0), (0.0, -0.006, 0.0), (0.0, 0.0, 0.011)])
def test_slow_motion_is_no_standstill(step):
    found = Standstill()
    poses = [(now, np.array(step) * now / 4.0) for now in range(0, 60, 2)]
    assert not any(found.update(pose, now) for now, pose in poses)


def test_noise_and_a_turn_of_the_angle_are_no_motion():
    found = Standstill()
    found.update(np.array([0.0, 0.0, np.pi]), 0.0)
    assert found.update(np.array([0.002, -0.002, -np.pi + 0.001]), 5.0)


def test_a_robot_without_a_goal_may_stand_still():
    found = Standstill()
    found.update(np.zeros(3), 0.0)
    found.reset()
    assert not found.update(np.zeros(3), 10.0)
    assert found.update(np.zeros(3), 15.0)


def test_a_goal_of_a_robot_that_does_not_move_is_reported(monkeypatch):
    monkeypatch.setattr(standstill, 'PATIENCE', 0.3)
    signals, seconds = Signals(), []

    class Progress(_Silent):
        def standing(self, duration):
            seconds.append(duration)
            signals.count += 1

    with (
        discovery_off(),
        ros_context(['test']) as context,
        running(context, isolated=True) as runner,
    ):
        controller = runner.add(lambda: GoToGoal(context=context))
        robot = controller.create_publisher(Odometry, 'odom', 10)
        odometry = Odometry()
        odometry.header.frame_id, odometry.child_frame_id = 'odom', 'base_link'
        odometry.pose.pose.orientation.w = 1.0

        def publish():
            odometry.header.stamp = controller.get_clock().now().to_msg()
            robot.publish(odometry)

        controller.create_timer(0.02, publish)
        goals = np.array([[1.0, 0.0, 0.0]])
        client = runner.add(lambda: GoalClient('client', goals, context, topic='goal_pose'))
        session = _Session(client, runner, signals, Progress())
        result = session.run(10.0, 10.0, follow=True, heading_matters=False)
    assert seconds == [0.3]
    assert (result.result, result.canceled) == (Result.INTERRUPTED, True)
    assert result.status is GoalState.CANCELED


def test_the_report_does_not_claim_that_an_unknown_robot_was_stopped(capsys):
    options = argparse.Namespace(timeout=7.0, wait=10.0, x=1.0, y=1.0)
    values = {'result': Result.TIMEOUT, 'topic': '/goal_pose', 'status': GoalState.CANCELED}
    unknown = GoalResult(**values, canceled=True)
    assert _sending.report(unknown, options, 'goal (1, 1)') == [
        'not arrived within --timeout 7 s',
        'canceled: no odometry was received, so it is not known whether a robot drove',
    ]
    known = GoalResult(**values, canceled=True, distance=1.0)
    assert _sending.report(known, options, 'goal (1, 1)')[1] == 'canceled: the robot was stopped'
    with _sending.Progress('send_goal', 'goal (1, 1)') as progress:
        progress.standing(5.0)
    assert capsys.readouterr().out == ('the robot has not moved for 5 s: call doctor to find out why\n')
