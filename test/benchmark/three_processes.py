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

"""Three processes: CPU time of robot, bridge and controller that drive at 50 Hz, one process each.

Ours are the console scripts as they are installed, with a goal from `send_goal` that they never reach.
Beside them bare nodes on `rclpy.spin` that send the same messages (sides.py). CPU time is that of the
three processes together, from /proc, while they drive. Ours are measured a second time without frequent
announcements (`DIFFDRIVE_JACOBIAN_FAST_DISCOVERY=0`), to show what these cost.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import child
from table import Goal, Row, interleave

from diffdrive_jacobian.ros.fastdds_profiles import SWITCH

WARM_UP = 3.0
"""Time to discover each other and to begin to drive (s)."""
PATIENCE = 30.0
SLOW = ['--ros-args', '-p', 'linear.x.max_velocity:=0.2']
WHEELS = ['--ros-args', '-p', 'command_interface:=wheels']
OURS = (['virtual_robot', *WHEELS], ['wheel_bridge'], ['go_to_goal', *SLOW])
BARE = ('BareRobot', 'BareController', 'BareBridge')
IDLE = 0.001
"""A process that used less of a core did not drive."""
_domains = itertools.count(os.getpid() % 50 + 1)


def spin(node: str) -> None:
    """Run a bare node until the process ends."""
    import rclpy
    import sides

    rclpy.init()
    rclpy.spin(getattr(sides, node)(**({'wheels': True} if node == 'BareRobot' else {})))


def cpu(side: str, seconds: float) -> float:
    """Return the CPU time of all three processes per time (% of a core)."""
    environment = {
        **os.environ,
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DOMAIN_ID': str(next(_domains) % 100),
        SWITCH: '0' if side == 'quiet' else '1',
    }
    if side == 'bare':
        commands = [[sys.executable, __file__, node] for node in BARE]
    else:
        commands = [[_script(name), *arguments] for name, *arguments in OURS]
    with _running(commands, environment) as processes:
        if side != 'bare':
            goal = [_script('send_goal'), str(5e5), '0', '--no-wait']
            subprocess.run(goal, env=environment, check=True, timeout=PATIENCE, capture_output=True)
        time.sleep(WARM_UP)
        before, begun = [_cpu_time(one.pid) for one in processes], time.monotonic()
        time.sleep(seconds)
        taken = time.monotonic() - begun
        shares = [
            (_cpu_time(one.pid) - earlier) / taken
            for one, earlier in zip(processes, before, strict=True)
        ]
    if min(shares) < IDLE:
        raise RuntimeError(f'a process of the side {side} did not drive: {shares}')
    return 100.0 * sum(shares)


def _script(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


@contextmanager
def _running(
    commands: list[list[str]], environment: dict[str, str]
) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Start processes, and end them."""
    quiet = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL}
    processes = [subprocess.Popen(command, env=environment, **quiet) for command in commands]
    try:
        yield processes
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            try:
                process.wait(2.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _cpu_time(pid: int) -> float:
    """Return the CPU time of a process and its threads (s)."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def rows(quick: bool) -> list[Row]:
    """Measure the three sides in turn."""
    seconds, rounds = (2.0, 1) if quick else (15.0, 7)
    figures = interleave(
        ('our', 'quiet', 'bare'),
        rounds,
        lambda side: child.call('three_processes', 'cpu', side=side, seconds=seconds),
    )
    sides = {'our': 'robot, bridge and controller', 'quiet': 'the same without frequent announcements'}
    return [
        Row(
            group='three processes',
            ours=what,
            beside='bare nodes of the same traffic, rclpy.spin',
            quantity='CPU of three processes driving at 50 Hz (% of a core)',
            pairs=list(zip(figures[side], figures['bare'], strict=True)),
            goal=Goal(0.5) if side == 'our' else None,
            digits=1,
        )
        for side, what in sides.items()
    ]


if __name__ == '__main__':
    spin(sys.argv[1])
