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

"""The nodes on the two executors that run them in earnest, in real time: what lockstep cannot show."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.lockstep_nodes import SECOND, Topics
from support.ros_messages import (
    at_rest,
    goal,
    instants,
    odometry,
    pose_message,
    twist,
    twists,
)

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros import node as ros_node


def test_robot_drives_to_its_timeout_and_reports(ros, executor_kind):
    topics = Topics(ros)
    ros.add(VirtualRobot, parameters={'cmd_vel_timeout': 0.1, 'enable_odom_tf': False})
    ros.talk(Twist, 'cmd_vel').publish(twist(1.0, 2.0))
    ros.until(lambda: len(topics.applied) == 2 and topics.odom and at_rest(topics.odom[-1]), 'the stop')
    begun, stopped = instants(topics.applied)
    assert stopped - begun == SECOND // 10
    # However late the timers came, in real time, too: the same bits.
    assert topics.odom[-1].pose.pose == pose_message(se2.integrate([0, 0, 0], [1, 2], 0.1))
    assert list(np.diff(instants(topics.odom)) > 0) == [True] * (len(topics.odom) - 1)


def test_controller_and_bridge_stop_when_nothing_is_received(ros, executor_kind):
    topics, wheels = Topics(ros), ros.listen(JointState, 'bridge/joint_command')
    ros.add(GoToGoal, parameters={'odom_timeout': 0.1})
    ros.add(WheelBridge, namespace='bridge', parameters={'cmd_vel_timeout': 0.1})
    odom = ros.talk(Odometry, 'odom')
    ros.talk(PoseStamped, 'goal_pose').publish(goal(1.0, 0.0))
    ros.talk(Twist, 'bridge/cmd_vel').publish(twist(0.033, 0.0))
    ros.until(lambda: topics.status, 'the goal is accepted')
    odom.publish(odometry(0, 0, 0))
    ros.until(lambda: len(topics.commands) == len(wheels) == 2, 'the zeros')
    assert twists(topics.commands) == [(0.5, 0.0), (0.0, 0.0)]
    assert [list(one.velocity) for one in wheels] == [[1.0, 1.0], [0.0, 0.0]]
    first, last = instants(wheels)
    assert last - first >= SECOND // 10


# --- A world without /clock


@pytest.fixture
def often(monkeypatch):
    """Let the nodes check the clock often."""
    monkeypatch.setattr(ros_node, 'WATCH_PERIOD', 0.05)


def test_without_a_clock_the_robot_moves_nothing_and_that_is_said(ros, capfd, often):
    topics = Topics(ros)
    ros.add(VirtualRobot, parameters={'use_sim_time': True})
    ros.talk(Twist, 'cmd_vel').publish(twist(1.0, 0.0))
    ros.until_said(capfd, 'nothing came on /clock for', 'command dropped: simulated time')
    assert not ros.call(Trigger, 'reset_odometry').success
    assert topics.odom == topics.applied == topics.starts == []


def test_without_a_clock_the_controller_commands_nothing(ros, capfd, often):
    commands = ros.listen(Twist, 'cmd_vel')
    ros.add(GoToGoal, parameters={'use_sim_time': True})
    ros.talk(PoseStamped, 'goal_pose').publish(goal(1.0, 0.0))
    odom = ros.talk(Odometry, 'odom')
    ros.peer.create_timer(0.02, lambda: odom.publish(odometry(0, 0, 0)))
    ros.until_said(capfd, 'goal accepted', 'goal canceled: time stands still')
    assert set(twists(commands)) <= {(0.0, 0.0)}


def test_without_a_clock_the_bridge_stops_the_wheels(ros, capfd, often):
    out = ros.listen(JointState, 'joint_command')
    node = ros.add(WheelBridge)
    commands = ros.talk(Twist, 'cmd_vel')
    commands.publish(twist(0.2, 0.0))
    ros.until(lambda: len(out) == 1, 'wheel speeds')
    # Switched to simulated time while the wheels turn: no timeout would ever strike.
    assert node.set_parameters([Parameter('use_sim_time', value=True)])[0].successful
    ros.until(lambda: len(out) == 2, 'the stop')
    assert list(out[1].velocity) == [0.0, 0.0]
    commands.publish(twist(0.2, 0.0))
    ros.until_said(capfd, 'command dropped: simulated time has not started')
    assert len(out) == 2
