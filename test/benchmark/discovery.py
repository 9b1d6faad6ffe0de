"""Discovery: how long a new listener waits for the first odometry of a running robot, and what it costs.

Run as `python test/benchmark/discovery.py`. The robot is started as its entry point does it, with
frequent announcements and without them. Each try is a new participant, a plain node of rclpy that
subscribes to odometry at 50 Hz, at a random time after the start of the robot. Printed are the times
(s), and the packets per second on the loopback interface while only the robot runs. They are those of
the whole machine, so run it in a network namespace of its own (`unshare -rn`), or on an idle machine.
"""

from __future__ import annotations

import argparse
import os
import random
import statistics
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('ROS_DOMAIN_ID', str(os.getpid() % 100 + 1))

import child
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from table import Row

from diffdrive_jacobian.ros.fastdds_profiles import SWITCH
from diffdrive_jacobian.ros.runner import ros_context

ENTRY = (
    'import sys; from diffdrive_jacobian.tools.entry_points import virtual_robot as run; sys.exit(run())'
)
AGE = 1.5
"""The robot is older than this when the first listener comes (s)."""
LATE = 0.5
"""What counts as late (s)."""
PATIENCE = 10.0
"""Longest wait for odometry (s)."""


def packets():
    """Packets that the loopback interface has received."""
    for line in Path('/proc/net/dev').read_text().splitlines():
        if line.strip().startswith('lo:'):
            return int(line.split(':')[1].split()[1])
    raise RuntimeError('there is no loopback interface')


def first_odometry():
    """Create a participant with a subscription; return the time until its first message (s)."""
    with ros_context(['listener']) as context:
        node = Node('listener', context=context, start_parameter_services=False)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        received = []
        begin = time.monotonic()
        node.create_subscription(Odometry, 'odom', received.append, 10)
        while not received and time.monotonic() < begin + PATIENCE:
            executor.spin_once(timeout_sec=0.05)
        elapsed = time.monotonic() - begin
        executor.shutdown()
        node.destroy_node()
    return elapsed


def measure(fast, tries, seconds):
    """Start a robot; return the times (s) and its packets per second."""
    environment = {**os.environ, SWITCH: '1' if fast else '0'}
    robot = subprocess.Popen([sys.executable, '-c', ENTRY], env=environment, stderr=subprocess.DEVNULL)
    try:
        first_odometry()
        time.sleep(AGE)
        before = packets()
        time.sleep(seconds)
        rate = (packets() - before) / seconds
        times = []
        for _ in range(tries):
            time.sleep(random.uniform(0.0, 0.5))
            times.append(first_odometry())
    finally:
        robot.terminate()
        robot.wait(10)
    return times, rate


def times_of(fast, tries):
    """Return the times of so many tries (s), as a child of run.py."""
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    return measure(fast, tries, 0.5)[0]


def rows(quick):
    """Measure both robots one after the other."""
    tries = 5 if quick else 50
    fast, slow = (child.call('discovery', 'times_of', fast=fast, tries=tries) for fast in (True, False))
    late = [sum(time > LATE for time in times) for times in (fast, slow)]
    return [
        Row(
            group='discovery',
            ours='robot that is announced every 0.2 s',
            beside='the same robot with the default of Fast DDS',
            quantity='time until the first odometry at a new listener (s)',
            pairs=list(zip(fast, slow, strict=True)),
            digits=2,
            notes=[
                f'Discovery: {late[0]} and {late[1]} of {tries} new listeners waited for more than '
                f'{LATE:g} s.'
            ],
        )
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--tries', type=int, default=50)
    parser.add_argument('--seconds', type=float, default=10.0, help='for which packets are counted')
    options = parser.parse_args()
    for fast in (False, True):
        times, rate = measure(fast, options.tries, options.seconds)
        late = sum(time > LATE for time in times)
        print(
            f'{"announced every 0.2 s" if fast else "default of Fast DDS":22s} first odometry after '
            f'{min(times):.2f} to {max(times):.2f} s, median {statistics.median(times):.2f} s, '
            f'{late} of {len(times)} later than 0.5 s; {rate:.0f} packets/s',
            flush=True,
        )


if __name__ == '__main__':
    main()
