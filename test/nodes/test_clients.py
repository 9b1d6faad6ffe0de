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

"""The clients of go_to_goal: goals and their status, nodes that were killed, robots that stand still."""

from __future__ import annotations

import argparse
import math

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger
from support.ros_messages import odometry, receive, spoiled

from diffdrive_jacobian.control import Arrival
from diffdrive_jacobian.drives.nodes import in_lockstep, overrides
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import DRIVEN_POINT_PARAMETERS, GoalClient, driven_offset
from diffdrive_jacobian.nodes.remote_goal import (
    SILENCE,
    GoalResult,
    RemoteProgress,
    Result,
    Standstill,
    loss,
    send_goal,
)
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros.runner import Runner
from diffdrive_jacobian.ros.service_client import LONGEST_STEP, PENDING, Liveness
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools.send_goal import report

pytestmark = pytest.mark.slow


def add_client(ros, goals, **kwargs):
    def create(context, parameter_overrides):
        return GoalClient('client', np.array(goals), context, **kwargs)

    return ros.add(create, parameters=None)


# --- Goals


def test_invalid_goals_and_topics_are_named(ros):
    for bad in (np.zeros(3), np.zeros((0, 3)), np.zeros((1, 2))):
        with pytest.raises(ValueError, match=r'goals must have shape \(n, 3\)'):
            GoalClient('client', bad, None)
    with pytest.raises(ValueError, match='goal_pose takes one goal, got 2'):
        GoalClient('client', np.zeros((2, 3)), None, topic='goal_pose')
    with pytest.raises(ParameterError, match='two topics of this node have the name /goal_status'):
        add_client(ros, [[0.0, 0.0, 0.0]], cli_args=['--ros-args', '-r', 'odom:=goal_status'])
    ros.peer.create_publisher(PoseStamped, 'odom', 1)
    with pytest.raises(ParameterError, match='/odom must have one type within a process'):
        add_client(ros, [[0.0, 0.0, 0.0]])


def test_distance_is_that_of_the_point_the_controller_drives(ros, capfd):
    client = add_client(ros, [[1.0, 0.0, 0.0]], topic='goal_pose')
    node = ros.add(GoToGoal, parameters={'controller': 'offset_point', 'offset': 0.25})
    watch = Liveness(client, ['/go_to_goal', '/missing'], DRIVEN_POINT_PARAMETERS)
    ros.until(lambda: watch.silence() is None or watch.values, 'the parameters are reported')
    assert watch.values == {'/go_to_goal': {'controller': 'offset_point', 'offset': 0.25}}
    offset = driven_offset(watch.values['/go_to_goal'])
    assert node.arrival.offset == offset
    assert client.distance == math.inf
    assert client.cancel_answer == ''
    client.arrival = Arrival(offset=offset)
    receive(client, '/odom', odometry(0.0, 0.0, 0.0))
    receive(client, '/odom', spoiled(odometry(9.0, 0.0, 0.0), 'header.stamp.sec', -1))
    assert client.distance == 0.75
    assert 'odometry dropped: its stamp must' in capfd.readouterr().err
    for values in ({}, {'controller': 'offset_point', 'offset': math.nan}):
        assert driven_offset(values) == 0.0


# --- Nodes that were killed or hang are detected within seconds, and only they


class Clock:
    """A monotonic clock that the test advances."""

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now


def test_a_node_that_is_not_served_falls_silent_and_comes_back(ros):
    clock, node = Clock(), ros.add(GoToGoal)
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)

    def await_answer():
        watch.answering.clear()

        def answered():
            clock.now += 0.1
            watch.silence()
            return watch.answering

        ros.until(answered, 'an answer')

    for _ in range(3):
        await_answer()
    ros.executor.remove_node(node)
    # Time in which this process stands still does not count.
    before = watch.silence()
    clock.now += 60.0
    assert watch.silence() <= before + LONGEST_STEP
    served = 0
    while watch.silence() < SILENCE:
        clock.now += 0.1
        served += 1
        ros.executor.spin_once(timeout_sec=0.001)
    assert (SILENCE - LONGEST_STEP) / 0.1 - 2 <= served <= SILENCE / 0.1 + 2
    # Requests do not pile up.
    for _ in range(2 * PENDING):
        clock.now += 1.0
        watch.silence()
    assert len(watch._clients['/go_to_goal']._pending_requests) == PENDING
    ros.executor.add_node(node)
    await_answer()


def test_a_node_without_parameter_services_is_never_silent(ros):
    clock = Clock()
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)
    ros.add(GoToGoal, start_parameter_services=False)
    for _ in range(100):
        clock.now += 0.1
        ros.executor.spin_once(timeout_sec=0.0)
        assert watch.silence() == 0.0


A, B, OTHER = b'a', b'b', b'o'
ONE, TWO = {A: '/go_to_goal'}, {A: '/go_to_goal', B: '/go_to_goal'}


def test_why_a_controller_is_lost():
    for sent_to, present, silence, expected in (
        (ONE, ONE, 2.9, None),
        (ONE, {}, 0.0, 'the controller is gone'),
        (ONE, {OTHER: '/other'}, 0.0, 'the controller is gone'),
        (ONE, {**ONE, OTHER: '/other'}, 0.0, None),
        # One of them was killed before, or the goal was not sent.
        (TWO, TWO, 0.0, None),
        (TWO, ONE, 0.0, None),
        (ONE, TWO, 0.0, 'another controller /go_to_goal has started'),
        (ONE, {B: '/go_to_goal'}, 0.0, 'another controller /go_to_goal has started'),
        (ONE, ONE, 3.0, 'the controller /go_to_goal has not answered for 3 s'),
    ):
        found = loss(sent_to, present, silence)
        assert found is expected if expected is None else found.startswith(expected)


@pytest.mark.parametrize('names', [('/go_to_goal', '/go_to_goal'), ('/first', '/second')])
def test_a_goal_is_not_sent_to_several_controllers_that_answer(ros, names):
    for name in names:
        ros.add(GoToGoal, cli_args=['--ros-args', '-r', f'__node:={name[1:]}'])
    received = ros.listen(PoseStamped, 'goal_pose')
    result = send_goal([1.0, 0.0, 0.0], runner=Runner(ros.context, ros.executor))
    assert result.result is Result.SEVERAL
    for name in names:
        assert name in result.reason
    assert not received


def test_a_controller_that_does_not_answer_does_not_count(ros):
    corpse = ros.add(GoToGoal)
    ros.executor.remove_node(corpse)
    ros.add(GoToGoal)
    ros.until(lambda: ros.peer.count_publishers('goal_status') == 2, 'both are discovered')
    result = send_goal([1.0, 0.0, 0.0], runner=Runner(ros.context, ros.executor), follow=False)
    assert result.acknowledged


class MuteController(Node):
    """Receives goals, and says nothing about them."""

    def __init__(self, context):
        super().__init__('mute', context=context)
        self.heard = []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.status = self.create_publisher(GoalStatus, 'goal_status', latched)
        self.create_subscription(PoseStamped, 'goal_pose', self.on_goal, 10)
        self.create_service(Trigger, 'cancel_goal', self.on_cancel)

    def on_goal(self, _):
        self.heard.append('goal')

    def on_cancel(self, _, response):
        self.heard.append('cancel')
        return response


class LateController(MuteController):
    """Drives to a goal, and has arrived when it is asked to cancel."""

    def on_goal(self, goal):
        self.report = GoalStatus(status=GoalStatus.STATUS_EXECUTING)
        self.report.goal_info.stamp = goal.header.stamp
        self.status.publish(self.report)

    def on_cancel(self, request, response):
        self.report.status = GoalStatus.STATUS_SUCCEEDED
        self.status.publish(self.report)
        return response


def test_a_goal_without_an_answer_is_withdrawn():
    """The controller may only be slow, and nobody would follow the goal."""
    with in_lockstep() as runner:
        mute = runner.add(lambda: MuteController(runner.context))
        result = send_goal([1.0, 0.0, 0.0], runner=runner)
        runner.settle()
    assert result.result is Result.NO_ANSWER
    assert mute.heard == ['goal', 'cancel']


def test_a_robot_that_arrives_while_it_is_canceled_has_arrived():
    with in_lockstep() as runner:
        runner.add(lambda: LateController(runner.context))
        result = send_goal([1.0, 0.0, 0.0], runner=runner, timeout=1.0)
    assert (result.result, result.arrived, result.canceled) == (Result.ENDED, True, None)


# --- Robots that have a goal and do not move


def test_each_standstill_is_detected_once():
    found = Standstill()
    rest, later = (1.0, 2.0, 3.14), (1.1, 2.0, 3.14)
    assert [found.update(rest, now) for now in (0.0, 4.9, 5.0, 6.0, 20.0)] == [0, 0, 1, 0, 0]
    # Noise and a turn of the angle are no motion.
    found.update(later, 21.0)
    noisy = (1.102, 1.998, 3.141 - math.tau)
    assert [found.update(noisy, now) for now in (25.9, 26.0, 27.0)] == [0, 1, 0]
    # A robot without a goal may stand still.
    found.reset()
    assert [found.update((0.0, 0.0, 0.0), now) for now in (30.0, 34.9, 35.0)] == [0, 0, 1]
    # Slow motion is none.
    for step in ([0.006, 0.0, 0.0], [0.0, -0.006, 0.0], [0.0, 0.0, 0.011]):
        found = Standstill()
        slow = [(tuple(one * now / 4.0 for one in step), now) for now in range(0, 60, 2)]
        assert not any(found.update(*one) for one in slow)


def test_a_goal_of_a_robot_that_does_not_move_is_reported():
    signals, seconds = Signals(), []

    class Progress(RemoteProgress):
        def standing(self, duration):
            seconds.append(duration)
            signals.count += 1

    with in_lockstep() as runner:
        # Nobody drives its wheels.
        values = overrides({'command_interface': 'wheels', 'publish_rate': 10.0})
        runner.add(lambda: VirtualRobot(context=runner.context, parameter_overrides=values))
        runner.add(lambda: GoToGoal(context=runner.context))
        result = send_goal([1.0, 0.0, 0.0], runner=runner, signals=signals, progress=Progress())
    assert seconds == [5.0]
    assert (result.result, result.canceled) == (Result.INTERRUPTED, True)
    assert (result.status, result.reason) == (GoalState.CANCELED, 'goal canceled, zero sent')


def test_the_report_does_not_claim_that_an_unknown_robot_was_stopped():
    options = argparse.Namespace(timeout=7.0, wait=10.0, x=1.0, y=1.0)
    values = {'result': Result.TIMEOUT, 'topic': '/goal_pose', 'status': GoalState.CANCELED}
    for distance, words in ((None, 'it is not known whether a robot drove'), (1.0, 'robot was stopped')):
        result = GoalResult(**values, canceled=True, distance=distance)
        late, canceled = report(result, options, 'goal (1, 1)')
        assert late.startswith('not arrived within --timeout 7 s')
        assert words in canceled
