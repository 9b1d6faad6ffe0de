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

"""Discovery: how long a new listener waits for the first odometry of a running robot, and what it costs.

Run as `python test/benchmark/discovery.py`. The robot is started as its entry point does it, with
the profile of this package and with the default of Fast DDS. Each try is a new participant, a plain
node of rclpy that subscribes to odometry at 50 Hz, at a random time after the start of the robot.
Printed are the times (s) and how they are distributed. While only the robot runs, its CPU time and the
packets per second on the loopback interface are measured. The packets are those of the whole machine,
so run it in a network namespace of its own (`unshare -rn`), or on an idle machine.

`ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET` measures that range instead of LOCALHOST.
"""

from __future__ import annotations

import argparse
import os
import random
import statistics
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

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
WIDTH = 0.1
"""Width of a class of the distribution (s)."""


class Robot(NamedTuple):
    """A robot and what its listeners waited for."""

    times: list[float]
    """Times until the first odometry (s)."""
    packets: float
    """Packets per second, before there are listeners."""
    cpu: float
    """CPU time per time, before there are listeners."""


def cpu_time(pid):
    """Return the CPU time of a process and its threads (s)."""
    files = Path(f'/proc/{pid}/task').glob('*/schedstat')
    return 1e-9 * sum(int(file.read_text().split()[0]) for file in files)


def distribution(times):
    """Return how many times are in each class, as text."""
    counts = Counter(int(time / WIDTH) for time in times)
    return ', '.join(f'{counts[k]} from {k * WIDTH:.1f} s' for k in sorted(counts))


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
    """Start a robot, and listeners one after the other."""
    environment = {**os.environ, SWITCH: '1' if fast else '0'}
    robot = subprocess.Popen([sys.executable, '-c', ENTRY], env=environment, stderr=subprocess.DEVNULL)
    try:
        first_odometry()
        time.sleep(AGE)
        before, used, begin = packets(), cpu_time(robot.pid), time.monotonic()
        time.sleep(seconds)
        elapsed = time.monotonic() - begin
        rate, cpu = (packets() - before) / elapsed, (cpu_time(robot.pid) - used) / elapsed
        times = []
        for _ in range(tries):
            time.sleep(random.uniform(0.0, 0.5))
            times.append(first_odometry())
    finally:
        robot.terminate()
        robot.wait(10)
    return Robot(times, rate, cpu)


def times_of(fast, tries):
    """Return the times of so many tries (s), as a child of run.py."""
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    return measure(fast, tries, 0.5).times


def rows(quick):
    """Measure both robots one after the other."""
    tries = 2 if quick else 50
    fast, slow = (child.call('discovery', 'times_of', fast=fast, tries=tries) for fast in (True, False))
    late = [sum(time > LATE for time in times) for times in (fast, slow)]
    return [
        Row(
            group='discovery',
            ours='robot with the profile of this package',
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
        robot = measure(fast, options.tries, options.seconds)
        times = robot.times
        late = sum(time > LATE for time in times)
        print(
            f'{"profile of this package" if fast else "default of Fast DDS":23s} first odometry after '
            f'{min(times):.2f} to {max(times):.2f} s, median {statistics.median(times):.2f} s, '
            f'{late} of {len(times)} later than {LATE:g} s ({distribution(times)}); '
            f'{robot.packets:.0f} packets/s, {100.0 * robot.cpu:.2f} % of a core',
            flush=True,
        )


if __name__ == '__main__':
    main()
