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

"""Start-up: time and CPU time from the start of a process to the first odometry that it publishes.

Beside the console script `virtual_robot`: a script of a bare node (odometry at 50 Hz, `rclpy.spin`).
Both are run in the same way, by `first_odometry.py`, in two environments:

- this one, where the package may be an editable installation (`pip install -e`). The finder of such an
  installation is imported by every Python process of the environment;
- one with a copy of the package, as `pip install` makes it.
"""

from __future__ import annotations

import compileall
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from table import Goal, Row, interleave

PATIENCE = 30.0
"""A process is killed if it prints nothing, or does not end, for this long (s)."""
BARE = """
import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node


class Robot(Node):
    def __init__(self):
        super().__init__('bare')
        self.odom = self.create_publisher(Odometry, 'odom', 10)
        self.create_timer(0.02, self.tick)

    def tick(self):
        message = Odometry()
        message.header.stamp = self.get_clock().now().to_msg()
        self.odom.publish(message)


rclpy.init()
rclpy.spin(Robot())
"""
OBSERVER = Path(__file__).with_name('first_odometry.py')
PACKAGE = Path(__file__).parents[2] / 'diffdrive_jacobian'
INSTALLATIONS = ('this environment', 'a copy of the package')
QUANTITIES = (
    'process start to first odometry (ms)',
    'CPU time until the first odometry (ms)',
)


@contextmanager
def installed() -> Iterator[str]:
    """Create an environment with a copy of the package and the packages of this one.

    Yields:
        Its interpreter.
    """
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, symlinks=True)
        site = Path(sysconfig.get_path('purelib', 'posix_prefix', {'base': folder}))
        shutil.copytree(PACKAGE, site / PACKAGE.name, ignore=shutil.ignore_patterns('__pycache__'))
        compileall.compile_dir(site, quiet=1)
        # The finders of editable installations there are not used: only their own directory's are.
        (site / 'dependencies.pth').write_text(sysconfig.get_path('purelib') + '\n')
        yield str(Path(folder, 'bin', 'python'))


def start(interpreter: str, script: str) -> tuple[float, float]:
    """Start a process; return the time and the CPU time until the first odometry (ms)."""
    # A domain of its own: nothing else is discovered.
    domain = str(os.getpid() % 100 + 1)
    environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_DOMAIN_ID': domain}
    command = [interpreter, str(OBSERVER), script]
    begun = time.monotonic_ns()
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        line = _first_line(process)
        process.terminate()
        process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
        process.communicate()
    if not line:
        raise RuntimeError(f'no odometry from {command} within {PATIENCE:g} s')
    published, cpu = map(int, line.split())
    return (published - begun) * 1e-6, cpu * 1e-6


def _first_line(process: subprocess.Popen) -> str:
    """Wait for a line; a process that writes none is killed, which ends its output."""
    assert process.stdout is not None
    killer = threading.Timer(PATIENCE, process.kill)
    killer.start()
    try:
        return process.stdout.readline()
    finally:
        killer.cancel()


def rows(quick: bool) -> list[Row]:
    """Start both sides in both environments in turn."""
    # Users have the compiled modules, also those of an editable installation.
    compileall.compile_dir(PACKAGE, quiet=1)
    with installed() as interpreter, tempfile.NamedTemporaryFile('w', suffix='.py') as bare:
        bare.write(BARE)
        bare.flush()
        ours = str(Path(sys.executable).with_name('virtual_robot'))
        interpreters = dict(zip(INSTALLATIONS, (sys.executable, interpreter), strict=True))
        sides = [(where, script) for where in INSTALLATIONS for script in (ours, bare.name)]
        figures = interleave(
            sides, 1 if quick else 15, lambda side: start(interpreters[side[0]], side[1])
        )
        return [
            Row(
                group='start-up',
                ours=f'virtual_robot, {where}',
                beside='bare node, rclpy.spin',
                quantity=quantity,
                pairs=[
                    (one[number], other[number])
                    for one, other in zip(figures[where, ours], figures[where, bare.name], strict=True)
                ],
                goal=Goal(1.1),
            )
            for where in INSTALLATIONS
            for number, quantity in enumerate(QUANTITIES)
        ]
