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

"""Nodes that live by wall time, each started as a process: `python wall_time_nodes.py KIND ...`.

Every 20 ms each kind publishes on `tick` its name and for how long it has run, as its own clock says.
Several kinds begin together, with a message.
"""

import asyncio
import multiprocessing
import queue
import select
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import String
from std_srvs.srv import Trigger

PERIOD = 0.02
CLOCKS = {
    **dict.fromkeys(('steady', 'late', 'waiting'), ClockType.STEADY_TIME),
    'system': ClockType.SYSTEM_TIME,
}
"""Kinds that are a timer, with its clock."""


# --- Kinds that are a thread, which waits again and again

pipe, other_pipe = multiprocessing.Pipe()
lock = threading.Lock()
lock.acquire()


def get_from_queue():
    with suppress(queue.Empty):
        queue.Queue().get(timeout=PERIOD)


def wait_for_files():
    poll = select.poll()
    poll.register(pipe, select.POLLIN)
    poll.poll(1000.0 * PERIOD)


def wait_for_lock():
    """Another thread releases it before."""
    lock.acquire(timeout=5.0)


def wait_for_child():
    """Its end interrupts what waits in this process for files."""
    time.sleep(PERIOD)
    subprocess.run([sys.executable, '-c', 'import time; time.sleep(0.001)'], check=True)


WAITS = {
    'sleep': lambda: time.sleep(PERIOD),
    'event': lambda: threading.Event().wait(PERIOD),
    'queue': get_from_queue,
    'select': lambda: select.select([pipe], [], [], PERIOD),
    'poll': wait_for_files,
    'posted': wait_for_lock,
    'children': wait_for_child,
    # It looks again until it is later than it was to wait.
    'pipe': lambda: other_pipe.poll(PERIOD),
}


def in_a_thread(function):
    threading.Thread(target=function, daemon=True).start()


def post():
    while rclpy.ok():
        time.sleep(PERIOD)
        lock.release()


async def tick_in_event_loop(tick):
    while rclpy.ok():
        await asyncio.sleep(PERIOD)
        tick()


def start(kind, node, tick):
    """Start one kind of a node."""
    if kind in WAITS:

        def loop():
            while rclpy.ok():
                WAITS[kind]()
                tick()

        in_a_thread(loop)
    if kind in CLOCKS:
        node.create_timer(PERIOD, tick, clock=Clock(clock_type=CLOCKS[kind]))
    elif kind == 'posted':
        in_a_thread(post)
    elif kind == 'asyncio':
        in_a_thread(lambda: asyncio.run(tick_in_event_loop(tick)))
    elif kind == 'deadlock':
        mutex = threading.Lock()
        node.create_subscription(String, 'poke', lambda _: mutex.acquire(), 10)
    elif kind == 'later':

        def begin_to_wait(_):
            in_a_thread(lambda: threading.Event().wait(0.05))

        node.create_subscription(String, 'poke', begin_to_wait, 10)
    elif kind == 'alarm':
        signal.signal(signal.SIGALRM, lambda *_: None)
        signal.setitimer(signal.ITIMER_REAL, PERIOD, PERIOD)


def start_two(node, publisher):
    """Start a timer and a thread that are due at once: the timer, of the older thread, comes first."""
    said = []
    node.create_timer(PERIOD, lambda: said.append('timer'), clock=Clock())

    def loop():
        while rclpy.ok():
            time.sleep(PERIOD)
            publisher.publish(String(data=' '.join(['two', *said, 'thread'])))
            said.clear()

    in_a_thread(loop)


def main(kinds):
    if kinds == ['late']:
        time.sleep(3.0)
    rclpy.init()
    node = rclpy.create_node('ticker')
    publisher = node.create_publisher(String, 'tick', 100)
    if kinds == ['waiting']:
        client = node.create_client(Trigger, 'offered')
        while not client.wait_for_service(timeout_sec=1.0):
            pass
    begin = time.monotonic()

    def tick(kind):
        publisher.publish(String(data=f'{kind} {time.monotonic() - begin:.3f}'))

    def start_all(_=None):
        for kind in kinds:
            start(kind, node, lambda kind=kind: tick(kind))

    if len(kinds) > 1:
        node.create_subscription(String, 'poke', start_all, 10)
    else:
        start_all()
    if kinds == ['two']:
        start_two(node, publisher)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        while kinds == ['once']:
            rclpy.spin_once(node, timeout_sec=PERIOD)
            tick('once')
        rclpy.spin(node)


main(sys.argv[1 : sys.argv.index('--ros-args')])
