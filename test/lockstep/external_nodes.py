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

"""Nodes for a process of their own: `python external_nodes.py NAME ...` spins those nodes.

They use nothing of the package. Each receives numbers on NAME/in. What they publish on NAME/out has a
number, as text, and the time of the node.
"""

import importlib
import os
import signal
import subprocess
import sys
import threading
import time

import rclpy
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64, Header, String
from std_srvs.srv import Trigger

PERIOD = 0.05
"""Period of the ticker (s)."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
stopped = threading.Event()
"""Set by SIGINT."""


class Echo(Node):
    """Answers each number by the same number."""

    def __init__(self, name, **kwargs):
        super().__init__(name, **kwargs)
        self.out = self.create_publisher(Header, f'{name}/out', 10)
        self.create_subscription(Float64, f'{name}/in', self.on_number, 10)

    def on_number(self, number):
        self.send(number.data)

    def send(self, number):
        self.out.publish(Header(stamp=self.get_clock().now().to_msg(), frame_id=f'{number:g}'))


class Ticker(Echo):
    """Publishes in a timer how many messages it has received."""

    def __init__(self, name):
        super().__init__(name)
        self.received = 0
        self.declare_parameter('gain', 2.0)
        self.create_timer(PERIOD, lambda: self.send(self.received))
        self.create_service(Trigger, f'{name}/reset', self.on_reset)
        self.create_publisher(String, f'{name}/description', LATCHED).publish(String(data='first'))
        self.create_subscription(String, f'{name}/map', self.on_number, LATCHED)

    def on_number(self, number):
        self.received += 1

    def on_reset(self, _, response):
        self.received = 0
        response.success = True
        return response


class Growing(Echo):
    """Creates another node at its first number."""

    child = None

    def on_number(self, number):
        if self.child is None:
            self.child = Ticker('child')
            self.executor.add_node(self.child)


class Late(Echo):
    """Creates its publisher when it receives the first number."""

    def __init__(self, name):
        super().__init__(name)
        self.destroy_publisher(self.out)
        self.out = None

    def on_number(self, number):
        if self.out is not None:
            super().on_number(number)
        else:
            self.out = self.create_publisher(Header, f'{self.get_name()}/late', 10)


class Hearing(Echo):
    """Hears what it publishes itself, as a node that looks after the commands of others does."""

    def __init__(self, name):
        super().__init__(name)
        self.sum = 0.0
        self.sums = self.create_publisher(Float64, f'{name}/sum', 10)
        self.create_subscription(Header, f'{name}/out', self.on_out, 10)

    def on_out(self, message):
        self.sum += float(message.frame_id)
        self.sums.publish(Float64(data=self.sum))


class Shared(Echo):
    """Numbers what it hears on topics that other nodes of its process have, too."""

    def __init__(self, name):
        super().__init__(name)
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

    def on_number(self, number):
        self.words.publish(String(data=f'{number.data:g}'))


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


# --- Services and actions


class Caller(Echo):
    """Calls a service of the world for each number, and publishes when it has responded."""

    def __init__(self, name):
        super().__init__(name)
        self.client = self.create_client(Trigger, f'{name}/ask')

    def on_number(self, number):
        future = self.client.call_async(Trigger.Request())
        future.add_done_callback(lambda done: self.send(float(done.result().message)))


class Asking(Echo):
    """Waits in its callbacks for the responses of a service, with a timeout."""

    def __init__(self, name):
        super().__init__(name)
        self.helper = Node(f'{name}_helper', start_parameter_services=False)
        self.client = self.helper.create_client(Trigger, f'{name}/ask')

    def on_number(self, number):
        future = self.client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self.helper, future, timeout_sec=0.4)
        self.send(float(future.result().message) if future.done() else -1.0)


class AskingFirst(Node):
    """Takes its time, and calls a service before it spins."""

    def __init__(self, name):
        super().__init__(name)
        time.sleep(0.7)
        self.first = self.create_publisher(String, f'{name}/first', LATCHED)
        client = self.create_client(Trigger, f'{name}/ask')
        client.wait_for_service()
        client.call_async(Trigger.Request()).add_done_callback(
            lambda future: self.first.publish(String(data=future.result().message))
        )


class Counting(Node):
    """Has an action, and publishes its feedback."""

    def __init__(self, name):
        super().__init__(name)
        self.action = importlib.import_module('test_msgs.action').Fibonacci
        actions = importlib.import_module('rclpy.action')
        self.server = actions.ActionServer(self, self.action, f'{name}/count', self.execute)

    def execute(self, goal):
        feedback = self.action.Feedback(sequence=[0, 1])
        while len(feedback.sequence) < goal.request.order:
            feedback.sequence.append(feedback.sequence[-1] + feedback.sequence[-2])
            goal.publish_feedback(feedback)
        goal.succeed()
        return self.action.Result(sequence=feedback.sequence)


# --- Attacks


class Waiting(Echo):
    """Sleeps in its callback at 0, starts a process at 2, or waits for what nobody sends."""

    def on_number(self, number):
        if number.data == 0.0:
            time.sleep(0.004)
        elif number.data == 2.0:
            subprocess.run(['sh', '-c', 'sleep 0.003'], check=True)
        else:
            threading.Event().wait(0.05)
        super().on_number(number)


class Creating(Echo):
    """Creates at a number what cannot take part, and destroys that, unless it is a node, at 0."""

    def on_number(self, number):
        super().on_number(number)
        name, which = self.get_name(), number.data
        if which == 0.0:
            self.destroy_subscription(self.created) or self.destroy_publisher(self.created)
        elif which == 1.0:
            self.created = self.create_subscription(Float64, f'{name}/in', lambda message: None, 10)
        elif which == 2.0:
            self.created = self.create_publisher(String, f'{name}/text', 10)
        elif which == 3.0:
            self.created = self.create_publisher(Header, f'{name}/out', qos_profile_sensor_data)
        else:
            self.created = Node(name, start_parameter_services=False)


class Threaded(Echo):
    """Publishes in a thread of its own, once it has received anything."""

    def __init__(self, name):
        super().__init__(name)
        self.received = False
        threading.Thread(target=self.work, daemon=True).start()

    def on_number(self, number):
        self.received = True

    def work(self):
        while not stopped.wait(0.02):
            if self.received:
                self.send(-1.0)


class Busy(Echo):
    """Does not stop to work, once it has received anything."""

    def on_number(self, number):
        while not stopped.is_set():
            pass


class Mortal(Echo):
    """Ends with the exit code that it receives."""

    def on_number(self, number):
        super().on_number(number)
        print('out of memory', file=sys.stderr, flush=True)
        os._exit(int(number.data))


CLASSES = [one for one in list(globals().values()) if isinstance(one, type) and issubclass(one, Node)]
NODES = {
    **{one.__name__.lower(): one for one in CLASSES},
    'bare': lambda name: Echo(name, start_parameter_services=False),
    'kept': Echo,
    'untimed': lambda name: Echo(name, parameter_overrides=[Parameter('use_sim_time', value=False)]),
    'best_effort': lambda name: Repeater(name, qos_profile_sensor_data),
    'other': Shared,
}


def spin(executor):
    while not stopped.is_set():
        executor.spin_once(timeout_sec=0.1)


def main(arguments):
    if 'elsewhere' in arguments:
        os.environ['ROS_DOMAIN_ID'] = str(int(os.environ['ROS_DOMAIN_ID']) % 100 + 1)
    names = [name for name in arguments if name in NODES]
    if 'forked' in arguments and os.fork() == 0:
        names = [names.pop()]
    elif 'forked' in arguments:
        names.pop()
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGINT, lambda *_: stopped.set())
    nodes = [NODES[name](name) for name in names]
    executor = MultiThreadedExecutor(4) if 'threads' in arguments else SingleThreadedExecutor()
    if 'threads' in arguments:
        other = SingleThreadedExecutor()
        other.add_node(nodes.pop())
        threading.Thread(target=spin, args=(other,), daemon=True).start()
    for node in nodes:
        executor.add_node(node)
    spin(executor)
    if 'polite' in arguments:
        # A last message. If it ended at once, its end might be discovered before that is received.
        nodes[0].send(-9.0)
        time.sleep(0.5)


if __name__ == '__main__':
    main(sys.argv[1:])
