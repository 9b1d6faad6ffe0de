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

"""Worlds in which our own nodes are explored: a robot, its bridge, its controller and who sends goals.

`test_explored_nodes.py` runs a few of them.
"""

from __future__ import annotations

import math
from unittest.mock import Mock

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from hypothesis import strategies as st
from nav_msgs.msg import Goals, Path
from std_srvs.srv import Trigger
from support.lockstep_nodes import make, make_complete
from support.ros_messages import value_of

from diffdrive_jacobian import faults
from diffdrive_jacobian.lockstep.runner import LockstepRunner
from diffdrive_jacobian.messages import conversion as messages
from diffdrive_jacobian.messages.codecs import ODOMETRY
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.remote_goal import ANSWER_PATIENCE, Result, send_goal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.properties import (
    NeverFasterThan,
    NoCommandAfterCancel,
    PoseFinite,
    StatusProtocol,
    StopsAfterLastCommand,
    StopsAfterLostOdometry,
    end_of_faults,
)
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.testing import fault_schedules, goals, poses, times
from diffdrive_jacobian.time_units import NANOSECONDS

DISTURBED = 4.0
"""Time at which the last fault has ended (s)."""
RATE = 25.0
"""Rate of the odometry (Hz): half of the default, to explore twice as many worlds."""
TIMEOUT = 0.5
"""Timeouts of odometry and of commands (s)."""
MAX_V, MAX_OMEGA = 0.5, 2.0
"""Limits of the controller (m/s, rad/s)."""
ARRIVAL = 40.0
"""Longest time to the goal that is sent after the faults (s)."""
NODES = ('go_to_goal', 'virtual_robot', 'wheel_bridge')
TOPICS = ('odom', 'cmd_vel', 'joint_command')


def add_nodes(world, start, make=make):
    """Add the three nodes. They are created again if they are killed.

    Those of `make_complete` have services for parameters, which only send_goal calls.
    """
    x, y, theta = map(float, start)
    world.create(
        lambda: make(
            VirtualRobot,
            command_interface='wheels',
            publish_rate=RATE,
            cmd_vel_timeout=TIMEOUT,
            simulate_slip=True,
            slip_seed=1,
            x=x,
            y=y,
            theta=theta,
        )
    )
    world.create(lambda: make(WheelBridge))
    limits = {'linear__x__max_velocity': MAX_V, 'angular__z__max_velocity': MAX_OMEGA}
    world.create(lambda: make(GoToGoal, odom_timeout=TIMEOUT, **limits))


class Operator:
    """Who sends goals, cancels them and drives by hand, without looking whether anybody listens."""

    def __init__(self, world):
        self._world, node = world, world.node
        self._pose = node.create_publisher(PoseStamped, 'goal_pose', 10)
        self._goals = node.create_publisher(Goals, 'goals', 10)
        self._path = node.create_publisher(Path, 'path', 10)
        self._cmd_vel = node.create_publisher(Twist, 'cmd_vel', 10)
        self._cancel = node.create_client(Trigger, 'cancel_goal')
        self.status = world.listen(GoalStatus, 'goal_status')

    def do(self, what, argument):
        """Do one thing of the script."""
        getattr(self, what)(argument)
        self._world.settle()

    def goal(self, pose):
        self._pose.publish(self._stamped(pose))

    def waypoints(self, poses):
        message = Goals(goals=[self._stamped(pose) for pose in poses])
        messages.set_time(message.header.stamp, self._world.now)
        self._goals.publish(message)

    def path(self, poses):
        message = Path(poses=[self._stamped(pose) for pose in poses])
        messages.set_time(message.header.stamp, self._world.now)
        self._path.publish(message)

    def cancel(self, _):
        self._cancel.call_async(Trigger.Request())

    def drive(self, v):
        message = Twist()
        message.linear.x = float(v)
        self._cmd_vel.publish(message)

    def _stamped(self, pose):
        message = PoseStamped()
        messages.set_time(message.header.stamp, self._world.now)
        messages.set_pose(message.pose, np.array(pose, dtype=np.float64))
        return message


def go_on_until(world, seconds):
    """Advance to a world time (s), if it has not passed."""
    left = seconds - world.world_time / NANOSECONDS
    if left > 1e-9:
        world.run_for(left)


def chain(world, case):
    """Goals, cancellations and commands by hand, under faults; after them a goal is reached."""
    add_nodes(world, case['start'])
    operator = Operator(world)
    for seconds, what, argument in sorted(case['script'], key=lambda action: action[0]):
        go_on_until(world, seconds)
        operator.do(what, argument)
    # What was delayed arrives after the last fault.
    go_on_until(world, end_of_faults(world) + 1.0)
    # Whatever has happened, the next goal is reached.
    for name in NODES:
        world.find(name)
    pose = np.array(value_of(ODOMETRY, world.last('odom')).pose)
    assert all(map(math.isfinite, pose)), pose
    x, y, theta = map(float, pose)
    goal = x + 0.2 * math.cos(theta + 1.0), y + 0.2 * math.sin(theta + 1.0), 0.0
    stamp = operator._stamped(goal).header.stamp
    world.publish('goal_pose', operator._stamped(goal))
    world.run_until(
        lambda: any(
            one.goal_info.stamp == stamp and one.status == GoalStatus.STATUS_SUCCEEDED
            for one in operator.status
        ),
        ARRIVAL,
        'the goal that was sent after the faults is reached',
    )
    world.run_for(0.2)
    twist = world.last('odom').twist.twist
    assert (twist.linear.x, twist.angular.z) == (0.0, 0.0), twist


def client(world, case):
    """A goal that send_goal sends and follows, under faults: what it reports is true."""
    add_nodes(world, case['start'], make_complete)
    status = world.listen(GoalStatus, 'goal_status')
    signals = Signals()
    if case['interrupted'] is not None:

        def interrupt():
            signals.count += 1
            timer.cancel()

        timer = world.node.create_timer(case['interrupted'] + 1e-3, interrupt)
    patience, timeout = 2.0, case['timeout']
    result = send_goal(
        [float(value) for value in case['goal']],
        runner=LockstepRunner(world),
        patience=patience,
        timeout=timeout,
        signals=signals,
        progress=Mock(),
    )
    spent = world.world_time / NANOSECONDS
    longest = patience + timeout + 3.0 * ANSWER_PATIENCE
    assert spent <= longest, f'send_goal ended after {spent} s, allowed: {longest} s'
    published = [one.status for one in status]
    if result.arrived:
        assert GoalStatus.STATUS_SUCCEEDED in published, (result, published)
    if result.result is Result.LOST:
        disturbing = [one for one in world.fault_events if not isinstance(one.fault, faults.Loss)]
        assert disturbing, result
    if result.canceled:
        assert set(published) & {
            GoalStatus.STATUS_CANCELED,
            GoalStatus.STATUS_SUCCEEDED,
            GoalStatus.STATUS_ABORTED,
        }, (result, published)
    go_on_until(world, max(DISTURBED, spent) + 1.0)


ACTIONS = st.one_of(
    st.tuples(times(DISTURBED), st.just('goal'), goals(2.0)),
    st.tuples(times(DISTURBED), st.just('cancel'), st.none()),
    st.tuples(times(DISTURBED), st.just('waypoints'), st.lists(poses(2.0), min_size=1, max_size=3)),
    st.tuples(times(DISTURBED), st.just('drive'), st.sampled_from((0.2, 0.0, -0.2))),
)
CHAIN_CASES = {'start': poses(2.0), 'script': st.lists(ACTIONS, min_size=1, max_size=4)}
CLIENT_CASES = {
    'start': poses(2.0),
    'goal': goals(1.0),
    'timeout': st.sampled_from((10.0, 3.0, 1.0)),
    'interrupted': st.one_of(st.none(), times(DISTURBED)),
}


FIELDS = {
    'odom': ('pose.pose.position.x', 'pose.pose.orientation.z', 'header.stamp', 'header.frame_id'),
    'cmd_vel': ('linear.x', 'angular.z'),
    'joint_command': ('velocity[0]', 'header.stamp'),
}
"""Fields of messages that are corrupted."""


def schedules(*topics):
    """Return the strategy of faults for a scenario in which these topics have subscriptions, too."""
    return fault_schedules(
        topics=(*TOPICS, *topics),
        nodes=NODES,
        services=('cancel_goal',),
        robots=('virtual_robot',),
        fields=FIELDS,
        clock=True,
        max_faults=4,
        duration=DISTURBED,
    )


SCENARIOS = {
    'chain': (chain, CHAIN_CASES, schedules('goal_pose', 'goals')),
    'client': (client, CLIENT_CASES, schedules('goal_pose', 'goal_status')),
}
"""Scenarios, their cases and their faults."""


def properties():
    """Return what must hold in every world."""
    timer = 0.05
    return [
        NeverFasterThan(MAX_V, MAX_OMEGA, topic='cmd_vel'),
        PoseFinite(),
        PoseFinite(odom='ground_truth'),
        StatusProtocol(),
        NoCommandAfterCancel(),
        StopsAfterLostOdometry(TIMEOUT + timer, node='go_to_goal'),
        StopsAfterLastCommand(TIMEOUT + 1.0 / RATE + timer, commands='joint_command'),
    ]
