"""Nodes for a process of their own: `python external_nodes.py NAME ...` spins those nodes.

They use nothing of the package.
"""

import importlib
import os
import signal
import subprocess
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import Point, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.action import ActionServer
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

PERIOD = 0.05
"""Period of the ticker (s)."""
LAST = 3
"""Number of the message at which the mortal nodes end."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Controller(Node):
    """Answers each odometry by commands with its x and the time of this node."""

    def __init__(self, name, *, answers=1, **kwargs):
        super().__init__(name, **kwargs)
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
        self.declare_parameter('gain', 2.0)
        self.create_timer(PERIOD, lambda: self.send(float(self.received)))
        self.create_service(Trigger, f'{name}/reset', self.on_reset)
        self.create_publisher(String, f'{name}/description', LATCHED).publish(String(data='first'))
        self.create_subscription(String, f'{name}/map', self.on_map, LATCHED)

    def on_reset(self, _, response):
        self.received = 0
        response.success = True
        return response

    def on_map(self, message):
        self.received += len(message.data)


class Stage(Node):
    """One of three that talk to one another: a answers odometry, b has a timer, c combines both."""

    def __init__(self, name):
        super().__init__(name)
        self.state = 0.0
        if name == 'a':
            out = self.create_publisher(Point, 'intent', 10)
            self.create_subscription(
                Odometry, 'odom', lambda m: out.publish(Point(x=1.0 - m.pose.pose.position.x)), 10
            )
        elif name == 'b':
            out = self.create_publisher(Point, 'bias', 10)

            def tick(_=None):
                self.state += 1.0
                out.publish(Point(x=self.state % 7.0))

            self.create_timer(0.02, tick)
            self.create_subscription(Odometry, 'odom', tick, 10)
        else:
            out = self.create_publisher(Float64, 'combined', 10)

            def bias(m):
                self.state = 0.7 * self.state + 0.3 * m.x

            def intent(m):
                out.publish(Float64(data=m.x * (1.0 + 0.2 * self.state)))
                self.state *= 0.9

            self.create_subscription(Point, 'bias', bias, 10)
            self.create_subscription(Point, 'intent', intent, 10)


class Hearing(Controller):
    """Hears its own commands, as a node that looks after the commands of others does."""

    def __init__(self, name):
        super().__init__(name)
        self.heard = []
        self.sums = self.create_publisher(Float64, f'{name}/sum', 10)
        self.create_subscription(TwistStamped, f'{name}/cmd_vel', self.on_command, 10)

    def on_command(self, command):
        self.heard.append(command.twist.linear.x)
        self.sums.publish(Float64(data=sum(self.heard)))


class Caller(Controller):
    """Calls a service of the world for each odometry, and publishes when it has responded."""

    def __init__(self, name):
        super().__init__(name, answers=0)
        self.client = self.create_client(Trigger, f'{name}/ask')

    def on_odometry(self, odometry):
        future = self.client.call_async(Trigger.Request())
        future.add_done_callback(lambda done: self.send(float(done.result().message)))


class Late(Controller):
    """Creates its publisher when it receives the first odometry."""

    def __init__(self, name):
        super().__init__(name)
        self.destroy_publisher(self.commands)

    def on_odometry(self, odometry):
        if not self.received:
            self.commands = self.create_publisher(TwistStamped, f'{self.get_name()}/late', 10)
            self.received = 1
        else:
            super().on_odometry(odometry)


class Counting(Node):
    """Has an action, and publishes its feedback."""

    def __init__(self, name):
        super().__init__(name)
        self.action = importlib.import_module('test_msgs.action').Fibonacci
        self.server = ActionServer(self, self.action, f'{name}/count', self.execute)

    def execute(self, goal):
        feedback = self.action.Feedback(sequence=[0, 1])
        while len(feedback.sequence) < goal.request.order:
            feedback.sequence.append(feedback.sequence[-1] + feedback.sequence[-2])
            goal.publish_feedback(feedback)
        goal.succeed()
        return self.action.Result(sequence=feedback.sequence)


class Repeater(Node):
    """Publishes what it receives, as often as its parameter says."""

    def __init__(self, name, profile=10):
        super().__init__(name)
        self.declare_parameter('times', 1)
        self.out = self.create_publisher(String, f'{name}/out', profile)
        self.create_subscription(String, f'{name}/in', self.repeat, profile)

    def repeat(self, message):
        for _ in range(self.get_parameter('times').value):
            self.out.publish(message)


# --- Attacks


class Changing(Repeater):
    """Publishes with another quality of service after the first message."""

    def repeat(self, message):
        super().repeat(message)
        self.destroy_publisher(self.out)
        self.out = self.create_publisher(String, f'{self.get_name()}/out', qos_profile_sensor_data)


class Shared(Controller):
    """Numbers what it hears on topics that other nodes of its process have, too."""

    def __init__(self, name):
        super().__init__(name, answers=0)
        self.heard = 0
        self.sums = self.create_publisher(String, 'heard', 10)
        self.create_subscription(String, 'words', self.on_word, 10)

    def on_word(self, word):
        self.heard += 1
        self.sums.publish(String(data=f'{self.get_name()} {self.heard} {word.data}'))


class Sharing(Shared):
    """Publishes what the others hear."""

    def __init__(self, name):
        super().__init__(name)
        self.words = self.create_publisher(String, 'words', 10)

    def on_odometry(self, odometry):
        self.words.publish(String(data=f'{odometry.pose.pose.position.x:g}'))


class Twice(Controller):
    """Hears one topic twice."""

    def __init__(self, name):
        super().__init__(name)
        self.create_subscription(Odometry, f'{name}/odom', self.on_odometry, 10)


class Asking(Controller):
    """Waits in its callbacks for the responses of a service, with a timeout."""

    def __init__(self, name):
        super().__init__(name)
        self.helper = Node(f'{name}_helper', start_parameter_services=False)
        self.client = self.helper.create_client(Trigger, f'{name}/ask')

    def on_odometry(self, odometry):
        future = self.client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self.helper, future, timeout_sec=0.4)
        self.send(float(future.result().message) if future.done() else -1.0)


class AskingFirst(Controller):
    """Calls a service before it spins."""

    def __init__(self, name):
        super().__init__(name)
        self.first = self.create_publisher(String, f'{name}/first', LATCHED)
        client = self.create_client(Trigger, f'{name}/ask')
        client.wait_for_service()
        client.call_async(Trigger.Request()).add_done_callback(
            lambda future: self.first.publish(String(data=future.result().message))
        )


class Growing(Controller):
    """Creates another node at its first odometry."""

    def on_odometry(self, odometry):
        super().on_odometry(odometry)
        if self.received == 1:
            self.child = Ticker('child')
            self.executor.add_node(self.child)


class Spied(Controller):
    """Creates a node that hears the same topic."""

    def on_odometry(self, odometry):
        super().on_odometry(odometry)
        self.spy = Node('spy')
        self.spy.create_subscription(Odometry, 'spied/odom', print, 10)


class Sleeping(Controller):
    def on_odometry(self, odometry):
        time.sleep(0.004)
        super().on_odometry(odometry)


class Blocking(Controller):
    """Waits in its callback for something that nobody sends."""

    def on_odometry(self, odometry):
        threading.Event().wait(0.05)
        super().on_odometry(odometry)


class Starting(Controller):
    """Starts a process in its callback."""

    def on_odometry(self, odometry):
        subprocess.run(['sh', '-c', 'sleep 0.003'], check=True)
        super().on_odometry(odometry)


class WallTimer(Controller):
    """Publishes in a timer on wall time, once it has received anything."""

    def __init__(self, name):
        super().__init__(name)
        clock = rclpy.clock.Clock(clock_type=rclpy.clock.ClockType.STEADY_TIME)
        self.create_timer(0.03, lambda: self.received and self.send(-1.0), clock=clock)


class Threaded(Controller):
    """Publishes in a thread of its own, once it has received anything."""

    def __init__(self, name):
        super().__init__(name)
        threading.Thread(target=self.work, daemon=True).start()

    def work(self):
        turn = threading.Event()
        while not turn.wait(0.02):
            if self.received:
                self.send(-1.0)


class Busy(Controller):
    """Never stops to work, once it has received anything."""

    def on_odometry(self, odometry):
        while True:
            pass


class Napping(Controller):
    """A thread that polls on wall time."""

    def __init__(self, name):
        super().__init__(name)
        threading.Thread(target=self.poll, daemon=True).start()

    def poll(self):
        while True:
            time.sleep(0.01)


class Mortal(Controller):
    """Ends at a message, as it is told."""

    def on_odometry(self, odometry):
        super().on_odometry(odometry)
        if self.received == LAST:
            self.end()

    def end(self):
        print('out of memory', file=sys.stderr, flush=True)
        os._exit(1)


class Killed(Mortal):
    def end(self):
        os.kill(os.getpid(), signal.SIGSEGV)


class Done(Mortal):
    def end(self):
        os._exit(0)


NODES = {
    'repeater': Repeater,
    'best_effort': lambda name: Repeater(name, qos_profile_sensor_data),
    'changing': Changing,
    'echo': Controller,
    'mute': lambda name: Controller(name, answers=0),
    'double': lambda name: Controller(name, answers=2),
    'bare': lambda name: Controller(name, start_parameter_services=False),
    'untimed': lambda name: Controller(
        name, parameter_overrides=[Parameter('use_sim_time', value=False)]
    ),
    'ticker': Ticker,
    'a': Stage,
    'b': Stage,
    'c': Stage,
    'hearing': Hearing,
    'caller': Caller,
    'late': Late,
    'counting': Counting,
    'shared': Shared,
    'other': Shared,
    'sharing': Sharing,
    'twice': Twice,
    'asking': Asking,
    'asking_first': AskingFirst,
    'growing': Growing,
    'spied': Spied,
    'sleeping': Sleeping,
    'blocking': Blocking,
    'starting': Starting,
    'wall_timer': WallTimer,
    'threaded': Threaded,
    'busy': Busy,
    'napping': Napping,
    'mortal': Mortal,
    'killed': Killed,
    'done': Done,
}


def main(arguments):
    if 'elsewhere' in arguments:
        os.environ['ROS_DOMAIN_ID'] = str(int(os.environ['ROS_DOMAIN_ID']) % 100 + 1)
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    stopped = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: stopped.set())
    nodes = [NODES[name](name) for name in arguments if name in NODES]
    threads = 4 if 'several_threads' in arguments else 1
    executor = MultiThreadedExecutor(threads) if threads > 1 else SingleThreadedExecutor()
    if 'several_executors' in arguments:
        other = SingleThreadedExecutor()
        other.add_node(nodes.pop())
        threading.Thread(target=other.spin, daemon=True).start()
    for node in nodes:
        executor.add_node(node)
    while not stopped.is_set():
        executor.spin_once(timeout_sec=0.1)
    if 'polite' in arguments:
        # A last command.
        nodes[0].send(-9.0)


if __name__ == '__main__':
    main(sys.argv[1:])
