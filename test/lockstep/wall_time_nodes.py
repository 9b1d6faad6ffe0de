"""Nodes that live by wall time, each started as a process: `python wall_time_nodes.py KIND`.

Every 20 ms they publish on `tick` for how long they have run, as their own clocks say.
"""

import asyncio
import multiprocessing
import os
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


def main():
    kind = sys.argv[1]
    if kind == 'late':
        time.sleep(3.0)
    rclpy.init()
    node = rclpy.create_node('ticker')
    publisher = node.create_publisher(String, 'tick', 100)
    begin = time.monotonic()
    said = []

    def tick():
        publisher.publish(String(data=f'{time.monotonic() - begin:.3f}'))

    def forever(wait):
        def loop():
            while rclpy.ok():
                wait()
                tick()

        threading.Thread(target=loop, daemon=True).start()

    if kind in ('steady', 'system', 'late'):
        clock = Clock(clock_type=ClockType.SYSTEM_TIME if kind == 'system' else ClockType.STEADY_TIME)
        node.create_timer(PERIOD, tick, clock=clock)
    elif kind == 'sleep':
        forever(lambda: time.sleep(PERIOD))
    elif kind == 'event':
        forever(lambda: threading.Event().wait(PERIOD))
    elif kind == 'condition':
        condition = threading.Condition()

        def wait():
            with condition:
                condition.wait(PERIOD)

        forever(wait)
    elif kind == 'queue':

        def get():
            with suppress(queue.Empty):
                queue.Queue().get(timeout=PERIOD)

        forever(get)
    elif kind == 'select':
        reader, _ = os.pipe()
        forever(lambda: select.select([reader], [], [], PERIOD))
    elif kind == 'poll':
        reader, _ = os.pipe()
        poll = select.poll()
        poll.register(reader)
        forever(lambda: poll.poll(1000.0 * PERIOD))
    elif kind == 'pipe':
        # It looks again until it is later than it was to wait.
        one, _ = multiprocessing.Pipe()
        forever(lambda: one.poll(PERIOD))
    elif kind == 'asyncio':

        async def ticking():
            while rclpy.ok():
                await asyncio.sleep(PERIOD)
                tick()

        threading.Thread(target=lambda: asyncio.run(ticking()), daemon=True).start()
    elif kind == 'posted':
        # A lock with a timeout that another thread releases before.
        lock = threading.Lock()

        def post():
            while rclpy.ok():
                time.sleep(PERIOD)
                lock.release()

        lock.acquire()
        threading.Thread(target=post, daemon=True).start()
        forever(lambda: lock.acquire(timeout=5.0))
    elif kind == 'two':
        # Due at once: the timer of the thread that is older.
        node.create_timer(PERIOD, lambda: said.append('timer'), clock=Clock())

        def both():
            said.append('thread')
            publisher.publish(String(data=' '.join(said)))
            said.clear()

        def loop():
            while rclpy.ok():
                time.sleep(PERIOD)
                both()

        threading.Thread(target=loop, daemon=True).start()
    elif kind == 'children':
        # They take what waits in this process for files by and by.
        reader, _ = os.pipe()

        def children():
            while rclpy.ok():
                time.sleep(PERIOD)
                subprocess.run([sys.executable, '-c', 'import time; time.sleep(0.001)'], check=True)
                tick()

        threading.Thread(target=children, daemon=True).start()
        threading.Thread(
            target=lambda: [select.select([reader], [], [], 0.007) for _ in range(100)], daemon=True
        ).start()
    elif kind == 'deadlock':
        mutex = threading.Lock()
        node.create_subscription(String, 'poke', lambda _: mutex.acquire(), 10)
    elif kind == 'later':

        def begin_to_wait(_):
            threading.Thread(target=lambda: threading.Event().wait(0.05)).start()

        node.create_subscription(String, 'poke', begin_to_wait, 10)
    elif kind == 'alarm':
        signal.signal(signal.SIGALRM, lambda *_: None)
        signal.setitimer(signal.ITIMER_REAL, PERIOD, PERIOD)
    if kind == 'waiting':
        client = node.create_client(Trigger, 'offered')
        while not client.wait_for_service(timeout_sec=1.0):
            pass
        node.create_timer(PERIOD, tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        while kind == 'once':
            rclpy.spin_once(node, timeout_sec=PERIOD)
            tick()
        rclpy.spin(node)


main()
