"""Quiet worlds of long-lived processes for campaigns, and the messages there."""

from __future__ import annotations

import math
import tempfile
import time
from contextlib import ExitStack, contextmanager, redirect_stdout
from functools import partialmethod
from io import StringIO
from pathlib import Path
from unittest import mock

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from support import processes
from support.harness import Harness
from support.processes import Child, open_world
from support.ros_messages import goal

LIFE = 900.0
"""How long a process may live (s)."""
OUTPUTS = {
    'virtual_robot': (Odometry, 'odom'),
    'go_to_goal': (Twist, 'cmd_vel'),
    'wheel_bridge': (JointState, 'joint_command'),
}
"""Type and topic of what each node commands or reports."""
TEAM = {
    'virtual_robot': {'command_interface': 'wheels'},
    'wheel_bridge': {},
    'go_to_goal': {'kp': 6.0, 'kv': 2.0, 'linear.x.max_velocity': 1.0},
}
"""Parameters of the nodes of a `Team`."""
PATIENCE = 120.0
"""How long a condition may take to come true (s): campaigns run beside other work, at low priority."""


@contextmanager
def quiet_world(folder=None, life=LIFE):
    """Open a world whose processes may live so long (s). It prints nothing at its end."""
    until = partialmethod(Harness.until, patience=PATIENCE)
    with (
        tempfile.TemporaryDirectory(prefix='process_faults_') as temporary,
        mock.patch.object(processes, 'LIMIT', life),
        mock.patch.object(processes, 'PATIENCE', PATIENCE),
        mock.patch.object(Harness, 'until', until),
        mock.patch.object(Child, 'exit', partialmethod(Child.exit, patience=PATIENCE)),
        ExitStack() as stack,
    ):
        world = stack.enter_context(open_world(folder or Path(temporary)))
        try:
            yield world
        finally:
            with redirect_stdout(StringIO()):
                stack.close()


def spin(harness, seconds):
    """Receive messages for a time (s)."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        harness.executor.spin_once(timeout_sec=0.005)


def speeds(message):
    """Return the speeds in an Odometry, a Twist or a JointState."""
    if isinstance(message, JointState):
        return list(message.velocity)
    twist = message.twist.twist if isinstance(message, Odometry) else message
    return [twist.linear.x, twist.angular.z]


def moves(message):
    """Return whether a message says that the robot moves."""
    return any(speeds(message))


def finite(message):
    """Return whether all numbers that a node publishes are finite."""
    numbers = speeds(message)
    if isinstance(message, Odometry):
        pose = message.pose.pose
        numbers += [pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w]
        numbers += [*message.pose.covariance, *message.twist.covariance]
    return all(map(math.isfinite, numbers))


class Team:
    """A robot, a bridge and a controller in processes, and what is heard of them."""

    def __init__(self, world, space='', **parameters):
        """Start the nodes in a namespace, with some parameters besides those of TEAM."""
        self.world, self.harness = world, world.harness
        self._space, self._parameters = space, parameters
        self.last = {}
        """The last message on each topic."""
        self.moved = {}
        """When the last message on each topic came that is not zero (s, monotonic)."""
        self.infinite = []
        """Messages with numbers that are not finite."""
        for kind, topic in OUTPUTS.values():
            self._hear(kind, topic)
        self.statuses = self.harness.listen(GoalStatus, f'{space}/goal_status', latched=True)
        self.goal = self.harness.peer.create_publisher(PoseStamped, f'{space}/goal_pose', 20)
        self.nodes = {}
        for name in TEAM:
            self.start(name)
        self.harness.until(self.goal.get_subscription_count, 'the controller is there')

    def _hear(self, kind, topic):
        def on_message(message):
            self.last[topic] = message
            if moves(message):
                self.moved[topic] = when(message)
            if not finite(message):
                self.infinite.append(str(message)[:300])

        self.harness.peer.create_subscription(kind, f'{self._space}/{topic}', on_message, 1000)

    def start(self, name):
        """Start a node, again if it has ended."""
        values = {**TEAM[name], **self._parameters}
        rules = [word for one, value in values.items() for word in ('-p', f'{one}:={value}')]
        space = ('-r', f'__ns:={self._space}') if self._space else ()
        self.nodes[name] = self.world.start(name, '--ros-args', *space, *rules)
        self.nodes[name].until_says('subscribed to')

    def drives(self):
        """Return whether the robot moves."""
        return 'odom' in self.last and moves(self.last['odom'])

    def arrives(self, tick=None):
        """Send goals near to where the robot is; return whether one is reached, and the robot stands."""
        tick = tick or (lambda: self.harness.executor.spin_once(timeout_sec=0.01))
        end, sent, reached = time.monotonic() + 40.0, -math.inf, False
        while not reached or self.drives():
            if time.monotonic() > end:
                return False
            if not reached and time.monotonic() > sent + 8.0 and 'odom' in self.last:
                # The robot may have been elsewhere, or the goal lost with a controller.
                sent, at = time.monotonic(), self.last['odom'].pose.pose.position
                self.statuses.clear()
                self.goal.publish(goal(at.x + 0.3, at.y + 0.4))
            tick()
            reached = any(one.status == GoalStatus.STATUS_SUCCEEDED for one in self.statuses)
        return True


def when(message):
    """Return the time of a message (s, monotonic): its stamp if it has that of its publication."""
    if not isinstance(message, Odometry):
        return time.monotonic()
    stamp = message.header.stamp
    return stamp.sec + stamp.nanosec / 1e9 - time.time() + time.monotonic()
