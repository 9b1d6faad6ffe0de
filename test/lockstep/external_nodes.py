"""Controllers for a process of their own: `python external_nodes.py NAME ...` spins those nodes.

They use nothing of the package, except that they are discovered quickly.
"""

import sys
from contextlib import suppress

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from diffdrive_jacobian.ros.fastdds_profiles import announce_frequently

PERIOD = 0.05
"""Period of the ticker (s)."""
LAST = 3
"""Number of the message at which the mortal node exits."""


class Controller(Node):
    """Answers each odometry by commands with its x and the time of this node."""

    def __init__(self, name, *, answers=1, sim_time=True, **kwargs):
        super().__init__(name, parameter_overrides=[Parameter('use_sim_time', value=sim_time)], **kwargs)
        self.answers = answers
        self.received = 0
        self.commands = self.create_publisher(TwistStamped, f'{name}/cmd_vel', 10)
        self.create_subscription(Odometry, f'{name}/odom', self.on_odometry, 10)

    def on_odometry(self, odometry):
        self.received += 1
        for _ in range(self.answers):
            self.send(odometry.pose.pose.position.x)

    def send(self, x):
        command = TwistStamped()
        command.header.stamp = self.get_clock().now().to_msg()
        command.twist.linear.x = x
        self.commands.publish(command)


class Ticker(Controller):
    """Publishes in a timer, whatever it receives."""

    def __init__(self, name):
        super().__init__(name, answers=0)
        self.create_timer(PERIOD, lambda: self.send(float(self.received)))
        self.create_service(Trigger, f'{name}/reset', self.on_reset)

    def on_reset(self, _, response):
        self.received = 0
        response.success = True
        return response


class Follower(Controller):
    """Answers the commands of the echo by its own, of twice the speed."""

    def __init__(self, name):
        super().__init__(name, answers=0)
        self.create_subscription(TwistStamped, 'echo/cmd_vel', self.on_command, 10)

    def on_command(self, command):
        self.send(2.0 * command.twist.linear.x)


class Mortal(Controller):
    """Exits with an error."""

    def on_odometry(self, odometry):
        super().on_odometry(odometry)
        if self.received == LAST:
            sys.exit('out of memory')


NODES = {
    'echo': Controller,
    'mute': lambda name: Controller(name, answers=0),
    'double': lambda name: Controller(name, answers=2),
    'untimed': lambda name: Controller(name, sim_time=False),
    'bare': lambda name: Controller(name, start_parameter_services=False),
    'ticker': Ticker,
    'follower': Follower,
    'mortal': Mortal,
}


def main(names):
    announce_frequently()
    rclpy.init(args=sys.argv)
    executor = SingleThreadedExecutor()
    for name in names:
        executor.add_node(NODES[name](name))
    with suppress(KeyboardInterrupt):
        executor.spin()


if __name__ == '__main__':
    main([name for name in sys.argv[1:] if name in NODES])
