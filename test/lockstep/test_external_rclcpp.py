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

"""A C++ node in a lockstep world: only where rclcpp and CMake are installed."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger

from diffdrive_jacobian.exploration.trial import MessageDigest
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.testing import Lockstep

SOURCE = Path(__file__).with_name('rclcpp_controller')


@pytest.fixture(scope='module')
def built(tmp_path_factory):
    """Build the nodes, and return their folder."""
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    if shutil.which('cmake') is None or not any(Path(one, 'share/rclcpp').is_dir() for one in prefixes):
        pytest.skip('rclcpp or CMake is not installed: C++ nodes are not tested')
    folder = tmp_path_factory.mktemp('rclcpp')
    for command in (['cmake', '-S', str(SOURCE), '-B', '.'], ['cmake', '--build', '.']):
        subprocess.run(command, cwd=folder, check=True)
    return folder


@pytest.fixture
def controller(built):
    """Return the command of the controller."""
    return [str(built / 'controller')]


def drive(command):
    """Drive to a goal, with another gain on the way, and cancel. Return the hash of all messages."""
    with Lockstep() as world, MessageDigest(world) as digest:
        world.add(VirtualRobot())
        world.start(command)
        goal = PoseStamped()
        goal.pose.position.x, goal.pose.position.y, goal.pose.orientation.w = 0.6, 0.4, 1.0
        world.publish('goal_pose', goal)
        world.run_for(1.0)
        gain = Parameter('kp', value=2.0).to_parameter_msg()
        request = SetParameters.Request(parameters=[gain])
        assert world.call(SetParameters, 'controller/set_parameters', request).results[0].successful
        world.run_for(4.0)
        position = world.last('odom').pose.pose.position
        assert math.dist((position.x, position.y), (0.6, 0.4)) < 0.01
        assert world.call(Trigger, 'cancel').success
        world.run_for(0.1)
        assert world.last('cmd_vel').linear.x == 0.0
        return digest.value()


def test_a_node_in_cpp_does_the_same_each_time(controller):
    assert drive(controller) == drive(controller)


@pytest.mark.parametrize(
    'how', ['timer', 'rate', 'sleep', 'sleep_until', 'condition', 'system', 'future']
)
def test_what_waits_on_wall_time_in_cpp_goes_on_in_simulated_time(built, how):
    """As in `test_wall_time.py`."""
    heard = []
    with Lockstep() as world:
        listener = Node('listener')
        listener.create_subscription(
            String, 'tick', lambda tick: heard.append((round(1000.0 * world.elapsed), tick.data)), 10
        )
        world.add(listener)
        process = world.start([str(built / 'ticker'), how], wall_time='simulated')
        world.run_for(0.2)
        assert process.stop() == 0
    assert [time for time, _ in heard] == list(range(20, 201, 20))
    assert np.diff([float(said) for _, said in heard]) == pytest.approx(np.full(9, 0.02), abs=1e-9)
