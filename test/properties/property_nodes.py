"""Small nodes and messages for the tests of properties."""

from __future__ import annotations

from math import cos, sin

from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_srvs.srv import Trigger
from support.lockstep_nodes import LEAN


class Sender:
    """Publishers of a test that need no subscription."""

    def __init__(self, world):
        self._world = world
        self._publishers = {}

    def __call__(self, topic, message):
        key = type(message), topic
        if key not in self._publishers:
            self._publishers[key] = self._world.node.create_publisher(*key, 10)
        self._publishers[key].publish(message)


def twist(v, omega=0.0):
    message = Twist()
    message.linear.x, message.angular.z = float(v), float(omega)
    return message


class Student(Node):
    """A controller that answers odometry with the command that it is told."""

    def __init__(self, name='student', timeout=0.0):
        super().__init__(name, **LEAN)
        self.command = twist(0.2)
        self.commands = self.create_publisher(Twist, 'cmd_vel', 10)
        self.create_subscription(Odometry, 'odom', self.on_odometry, 10)
        self.create_subscription(PoseStamped, 'goal_pose', lambda _: None, 10)
        self.create_service(Trigger, 'cancel_goal', self.on_cancel)
        self.watchdog = self.create_timer(timeout, self.on_stale) if timeout else None

    def on_odometry(self, _):
        self.commands.publish(self.command)
        if self.watchdog:
            self.watchdog.reset()

    def on_stale(self):
        self.commands.publish(twist(0.0))

    def on_cancel(self, _, response):
        return response


def odometry_at(x, y=0.0, v=0.0, theta=0.0):
    message = Odometry()
    message.pose.pose.position.x, message.pose.pose.position.y = float(x), float(y)
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = sin(theta / 2), cos(theta / 2)
    message.twist.twist.linear.x = float(v)
    return message


def goal_at(x, y=0.0, stamp=0):
    message = PoseStamped()
    message.pose.position.x, message.pose.position.y = float(x), float(y)
    message.pose.orientation.w = 1.0
    message.header.stamp.sec = stamp
    return message


class Scene:
    """Sends goals and odometry, with time between them, and finishes."""

    def __init__(self, world):
        self._world, self._send = world, Sender(world)

    def __call__(self, *events):
        for event in events:
            if isinstance(event, float):
                self._world.run_for(event)
            else:
                self._send('goal_pose' if isinstance(event, PoseStamped) else 'odom', event)
        self._world.finish()
