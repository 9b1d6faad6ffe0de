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

"""The nodes as the tests put them into a lockstep world."""

from __future__ import annotations

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry, Path
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from support.ros_messages import odometry, twists

NANOSECOND = 1e-9
SECOND = 1_000_000_000
QUICK = {'kp': 24.0, 'kv': 12.0}
"""Gains that save time."""

ACCEPTED, EXECUTING = GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING
SUCCEEDED, CANCELED = GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED
ABORTED = GoalStatus.STATUS_ABORTED


def _parameters(values):
    return [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]


LEAN = {'start_parameter_services': False, 'enable_rosout': False}
"""Arguments of nodes without what few tests use, and what costs a third of the time to create a node."""


def make(node_class, namespace='', **parameters):
    """Make a LEAN node with these parameters; `__` stands for a dot in their names."""
    return node_class(namespace=namespace, parameter_overrides=_parameters(parameters), **LEAN)


def make_complete(node_class, namespace='', **parameters):
    """Make a node with these parameters, as `make`, with its services for parameters and /rosout."""
    return node_class(namespace=namespace, parameter_overrides=_parameters(parameters))


def change(node, **parameters):
    """Change parameters of a node, all or none."""
    return node.set_parameters_atomically(_parameters(parameters))


def comes_after(world, messages, seconds):
    """Let time pass, and hold that one message comes exactly at the end of it and none before."""
    before = len(messages)
    world.run_for(seconds - NANOSECOND)
    assert len(messages) == before
    world.run_for(NANOSECOND)
    assert len(messages) == before + 1
    return messages[-1]


class Topics:
    """What a robot and who drives it say."""

    def __init__(self, world, namespace='', *, command=Twist):
        def listen(message_type, topic, *, latched=False):
            return world.listen(message_type, f'{namespace}/{topic}', latched=latched)

        self.commands = listen(command, 'cmd_vel')
        self.odom = listen(Odometry, 'odom')
        self.states = listen(JointState, 'joint_states')
        self.applied = listen(TwistStamped, 'cmd_vel_out')
        self.starts = listen(PoseWithCovarianceStamped, 'start_pose')
        self.status = listen(GoalStatus, 'goal_status')

    @property
    def statuses(self):
        return [one.status for one in self.status]


def add_team(world, namespace='', *, pose=(0.0, 0.0, 0.0), rate=50.0, **gains):
    """Add a robot driven by its wheels, its bridge and its controller; give the three."""
    x, y, theta = map(float, pose)
    robot = make(
        VirtualRobot,
        namespace,
        command_interface='wheels',
        publish_rate=rate,
        x=x,
        y=y,
        theta=theta,
    )
    nodes = (robot, make(WheelBridge, namespace), make(GoToGoal, namespace, **gains))
    return tuple(world.add(node) for node in nodes)


def arrives(world, topics, timeout=30.0):
    """Let time pass until the goal is reached, and a tick more."""
    world.run_until(lambda: topics.statuses[-1:] == [SUCCEEDED], timeout, 'arrival')
    world.run_for(0.1)


class Controller:
    """A controller whose odometry is ours."""

    def __init__(self, world, command=Twist, **parameters):
        self._world = world
        self.commands = world.listen(command, 'cmd_vel')
        self.status = world.listen(GoalStatus, 'goal_status')
        self.node = world.add(make(GoToGoal, **parameters))

    @property
    def statuses(self):
        """Seconds of the stamp that the goal came with, and its status."""
        return [(one.goal_info.stamp.sec, one.status) for one in self.status]

    def send(self, message):
        """Send a goal, several or a path."""
        topics = {Goals: 'goals', Path: 'path'}
        self._world.publish(topics.get(type(message), 'goal_pose'), message)

    def sees(self, message):
        """Send odometry; give the commands that answer it."""
        before = len(self.commands)
        self._world.publish('odom', message)
        return twists(self.commands[before:])

    def at(self, x, y, theta=0.0, frame='odom'):
        """Send odometry and give the one command that answers it."""
        (command,) = self.sees(odometry(x, y, theta, frame))
        return command
