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

"""Floods: other processes send on one input of a node as fast as they can.

Run as `python test/benchmark/flood.py` on an idle machine (40 minutes), or with `--quick` to see whether
it works (a minute and a half). Each node runs as its entry point starts it, and once more on rclpy's
SingleThreadedExecutor. For each input of each node are printed, during the flood:

- the rate of the odometry and the longest time between two messages, by their stamps;
- how late the timeout of commands or odometry stops the robot, the longest of several times. If that
  input itself is flooded, the stop after the end of the flood counts;
- the longest time until a request of `get_parameters` is answered;
- the growth of the resident memory.

What misses a goal (`LEAST`, `MOST`) is repeated at the end of its line and counted. The exit code is 1
if our nodes miss one.

Under a flood the middleware drops packets before they reach a node, and repeats them at the next
heartbeat. The observer sends heartbeats every 0.1 s. A client with the default of Fast DDS may wait 3 s.

`--processes 2` floods from two processes.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from flooding import message
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from diffdrive_jacobian.ros.fastdds_profiles import announce_frequently, fast_heartbeats
from diffdrive_jacobian.ros.runner import ros_context

FLOODING = str(Path(__file__).with_name('flooding.py'))
SHORTEST = 4.0
"""Shortest flood (s). It takes two seconds to begin."""
TIMEOUT = 0.5
"""Timeout of commands and of odometry (s)."""
ON = {
    'ours': '',
    'single': (
        'import diffdrive_jacobian.ros.runner as runner, rclpy.executors as executors; '
        'runner.make_executor = lambda context, **_: '
        'executors.SingleThreadedExecutor(context=context); '
    ),
}
ENTRY = 'import sys; {0}from diffdrive_jacobian.tools.entry_points import {1}; sys.exit({1}())'
STAMPED = ('-p', 'enable_stamped_cmd_vel:=true')
WHEELS = ('-p', 'command_interface:=wheels')


class Case(NamedTuple):
    """A node, and the input that is flooded."""

    node: str
    flooded: str
    arguments: tuple[str, ...] = ()
    own: bool = False
    """Whether the timeout applies to this input."""


CASES = (
    Case('virtual_robot', 'cmd_vel', own=True),
    Case('virtual_robot', 'cmd_vel_stamped', STAMPED, own=True),
    Case('virtual_robot', 'joint_command', WHEELS, own=True),
    Case('virtual_robot', 'initialpose'),
    Case('virtual_robot', 'clock', ('-p', 'use_sim_time:=true')),
    Case('virtual_robot', 'set_parameters'),
    Case('virtual_robot', 'reset_odometry'),
    Case('wheel_bridge', 'cmd_vel', own=True),
    Case('wheel_bridge', 'cmd_vel_stamped', STAMPED, own=True),
    Case('wheel_bridge', 'clock', ('-p', 'use_sim_time:=true')),
    Case('wheel_bridge', 'set_parameters'),
    Case('go_to_goal', 'odom', own=True),
    Case('go_to_goal', 'goal_pose'),
    Case('go_to_goal', 'goals'),
    Case('go_to_goal', 'clock', ('-p', 'use_sim_time:=true')),
    Case('go_to_goal', 'set_parameters'),
    Case('go_to_goal', 'cancel_goal'),
)
QUICK = ('virtual_robot/initialpose', 'wheel_bridge/cmd_vel_', 'go_to_goal/cancel')
"""Beginnings of the cases of a short run."""
QUICK_SECONDS = 6.0

LEAST = {'odometry': 49.5}
MOST = {'stop': 100.0, 'service': 100.0, 'memory': 2.0}
"""Goals by the name of the figure: rate of the odometry (Hz), lateness, response (ms), growth (MB)."""
FORMATS = {
    'flood': '{:7.0f}/s:',
    'odometry': '{:5.2f} Hz,',
    'gap': 'gap {:4.0f} ms,',
    'stop': 'stop {:4.0f} ms late,',
    'service': 'service {:4.0f} ms,',
    'memory': '{:+5.1f} MB',
}


# --- What is measured


class Observer:
    """Measures a node from another process."""

    def __init__(self, context: Any, case: Case) -> None:
        self.case = case
        self.node = Node('observer', context=context, start_parameter_services=False)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.client = self.node.create_client(GetParameters, f'{case.node}/get_parameters')
        self.stamps: list[float] = []
        self.moving, self.since = False, 0.0
        stamped = case.arguments == STAMPED
        kinds = {
            'virtual_robot': ('joint_command' if case.arguments == WHEELS else 'cmd_vel', 'odom'),
            'wheel_bridge': ('cmd_vel', 'joint_command'),
            'go_to_goal': ('odom', 'cmd_vel'),
        }
        command, output = kinds[case.node]
        self.sample = message(f'{command}_stamped' if stamped and command == 'cmd_vel' else command)
        self.command = self.node.create_publisher(type(self.sample), command, 10)
        self.goal = self.node.create_publisher(PoseStamped, 'goal_pose', 10)
        types = {'odom': Odometry, 'joint_command': JointState, 'cmd_vel': Twist}
        self.node.create_subscription(types[output], output, self._on_output, 100)

    def _on_output(self, output: Any) -> None:
        if isinstance(output, JointState):
            moving = any(output.velocity)
        else:
            twist = output if isinstance(output, Twist) else output.twist.twist
            moving = twist.linear.x != 0.0 or twist.angular.z != 0.0
            if isinstance(output, Odometry):
                self.stamps.append(output.header.stamp.sec + output.header.stamp.nanosec * 1e-9)
        if moving != self.moving:
            self.moving, self.since = moving, time.monotonic()

    def spin(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Spin for at most a time (s); return whether the condition became true."""
        end = time.monotonic() + seconds
        while not until():
            if time.monotonic() > end:
                return False
            self.executor.spin_once(timeout_sec=0.01)
        return True

    def response(self) -> float:
        """Time until a request is answered (s)."""
        begin = time.monotonic()
        future = self.client.call_async(GetParameters.Request(names=['use_sim_time']))
        return time.monotonic() - begin if self.spin(5.0, future.done) else math.inf

    def stop(self, sent: float) -> float:
        """How much later than the timeout after a time of sending (s) the motion ends (s)."""
        if not self.spin(TIMEOUT + 5.0, lambda: not self.moving):
            return math.inf
        return self.since - sent - TIMEOUT

    def watchdog(self) -> float:
        """Let the node move, and return how late it stops when nothing more comes (s)."""
        if self.case.node == 'go_to_goal':
            self.goal.publish(message('goal_pose'))
        self.command.publish(self.sample)
        sent = time.monotonic()
        while not self.spin(0.02, lambda: self.moving):
            if self.case.node == 'go_to_goal':
                self.command.publish(self.sample)
                sent = time.monotonic()
            elif time.monotonic() > sent + 5.0:
                return math.inf
        return self.stop(sent)


def resident(process: subprocess.Popen) -> float:
    """Resident memory of a process (MB)."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    return int(status.split('VmRSS:')[1].split()[0]) / 1024.0


def measure(case: Case, executor: str, seconds: float, processes: int) -> dict[str, float]:
    """Flood a node; return what was measured, by the names of `FORMATS`."""
    timeout = 'odom_timeout' if case.node == 'go_to_goal' else 'cmd_vel_timeout'
    arguments = ['--ros-args', '-p', f'{timeout}:={TIMEOUT}', *case.arguments]
    program = ENTRY.format(ON[executor], case.node)
    node = subprocess.Popen([sys.executable, '-c', program, *arguments], stderr=subprocess.DEVNULL)
    floods: list[subprocess.Popen] = []
    try:
        with fast_heartbeats(), ros_context(['observer']) as context:
            observer = Observer(context, case)
            if not observer.spin(20.0, observer.client.service_is_ready):
                raise RuntimeError(f'not ready within 20 s: {case.node} {" ".join(arguments)}')
            observer.spin(2.0)
            observer.response()
            observer.goal.publish(message('goal_pose'))
            before = resident(node)
            command = [sys.executable, FLOODING, case.node, case.flooded, str(seconds)]
            floods += [
                subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)
            ]
            # The flood begins.
            observer.spin(2.0)
            observer.stamps.clear()
            responses, stops, grown = [], [], 0.0
            end = time.monotonic() + seconds - 2.0
            while time.monotonic() < end:
                responses.append(observer.response())
                if not (case.own or case.flooded == 'cancel_goal'):
                    stops.append(observer.watchdog())
                grown = max(grown, resident(node) - before)
                observer.spin(0.1)
            stamps = list(observer.stamps)
            results = [flood.communicate(timeout=60)[0].split() for flood in floods]
            if case.own and observer.spin(2.0, lambda: observer.moving):
                stops.append(observer.stop(max(float(ended) for _, ended in results)))
            grown = max(grown, resident(node) - before)
            observer.executor.shutdown()
            observer.node.destroy_node()
    finally:
        for process in (*floods, node):
            process.kill()
            process.wait()
    figures = {
        'flood': sum(float(rate) for rate, _ in results),
        'service': max(responses) * 1e3,
        'memory': grown,
    }
    if case.node == 'virtual_robot':
        gaps = [b - a for a, b in pairwise(stamps)] or [math.inf]
        figures |= {'odometry': len(gaps) / sum(gaps), 'gap': max(gaps) * 1e3}
    if stops:
        figures['stop'] = max(stops) * 1e3
    return figures


def missed(figures: dict[str, float]) -> list[str]:
    """Return the names of the figures that miss their goal."""
    few = [name for name, least in LEAST.items() if figures.get(name, least) < least]
    return few + [name for name, most in MOST.items() if figures.get(name, 0.0) > most]


def line(figures: dict[str, float]) -> str:
    """Return figures as a line."""
    parts = [form.format(figures[name]) for name, form in FORMATS.items() if name in figures]
    if failures := missed(figures):
        parts.append(f'MISSED: {", ".join(failures)}')
    return ' '.join(parts)


def main() -> int:
    """Flood the nodes, and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--quick', action='store_true', help='short and noisy, to try it')
    parser.add_argument('--seconds', type=float, help='duration of each flood (s) (default: 60.0)')
    parser.add_argument('--processes', type=int, default=1, help='processes that flood (default: 1)')
    parser.add_argument('cases', nargs='*', help='beginnings of NODE/INPUT (default: all)')
    options = parser.parse_args()
    seconds = options.seconds or (QUICK_SECONDS if options.quick else 60.0)
    wanted = tuple(options.cases) or (QUICK if options.quick else ('',))
    cases = [case for case in CASES if f'{case.node}/{case.flooded}'.startswith(wanted)]
    if not cases or seconds < SHORTEST:
        parser.error(f'cases must name inputs, and --seconds must be at least {SHORTEST:g}')
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ.setdefault('ROS_DOMAIN_ID', str(os.getpid() % 100 + 1))
    announce_frequently()
    failures = dict.fromkeys(ON, 0)
    for case in cases:
        for executor in ON:
            figures = measure(case, executor, seconds, options.processes)
            failures[executor] += len(missed(figures))
            name = f'{case.node}/{case.flooded}'
            print(f'{name:30s} {executor:6s} {line(figures)}', flush=True)
    counts = ', '.join(f'{executor} {count}' for executor, count in failures.items())
    print(f'goals missed in {len(cases)} floods of {seconds:g} s: {counts}')
    return int(failures['ours'] > 0)


if __name__ == '__main__':
    sys.exit(main())
