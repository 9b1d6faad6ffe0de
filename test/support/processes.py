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

"""Entry points as child processes: started in a ROS domain of their own, watched, and always ended."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from functools import cached_property
from unittest import mock

from diffdrive_jacobian.ros.fastdds_profiles import VARIABLE, announce_frequently
from support.domains import domain_id
from support.harness import PATIENCE, Harness

LIMIT = 90.0
"""How long a child may live (s): then it is killed, whatever became of its test."""
PROGRAM = 'import sys; from diffdrive_jacobian.tools.entry_points import {0}; sys.exit({0}())'

# The harness is found as fast as the children. Fast DDS reads this with the first participant of a
# process, long after this module is loaded.
announce_frequently()

_numbers = itertools.count()


def python(program, *arguments):
    """Return the command `python -c PROGRAM ARGUMENTS`."""
    return [sys.executable, '-c', program, *map(str, arguments)]


def start_python(program, *arguments, **streams):
    """Start `python -c PROGRAM ARGUMENTS`."""
    return subprocess.Popen(python(program, *arguments), stdin=subprocess.DEVNULL, **streams)


def run_python(program, *arguments, timeout=LIMIT, **options):
    """Run `python -c PROGRAM ARGUMENTS` to its end; return its exit code and what it printed."""
    streams = {'stdin': subprocess.DEVNULL, 'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE}
    command = python(program, *arguments)
    return subprocess.run(command, **{**streams, **options}, text=True, timeout=timeout)


class Child:
    """A running entry point; what it prints goes into files, so that no pipe can fill up."""

    def __init__(self, name, arguments, directory, stdout=None):
        self.command = ' '.join([name, *arguments])
        number = next(_numbers)
        self._out, self._err = (directory / f'{number}_{name}.{end}' for end in ('out', 'err'))
        with self._out.open('wb') as out, self._err.open('wb') as err:
            streams = {'stdout': out if stdout is None else stdout, 'stderr': err}
            # Children choose their own profiles: this file may be that of another installation.
            streams['env'] = {name: value for name, value in os.environ.items() if name != VARIABLE}
            self._process = start_python(PROGRAM.format(name), *arguments, **streams)
        self._limit = threading.Timer(LIMIT, self._process.kill)
        self._limit.daemon = True
        self._limit.start()

    @property
    def stdout(self):
        return self._out.read_text()

    @property
    def stderr(self):
        return self._err.read_text()

    @property
    def last_line(self):
        return self.stdout.splitlines()[-1]

    @property
    def running(self):
        return self._process.poll() is None

    def signal(self, number):
        """Send a signal; nothing happens if it has exited."""
        self._process.send_signal(number)

    def until_says(self, pattern):
        """Wait until it has printed something, on stdout or stderr."""
        self._until(lambda: re.search(pattern, self.stdout + self.stderr), f'says {pattern!r}')

    def until_catches(self, number):
        """Wait until it has a handler for a signal that would end it otherwise."""

        def caught():
            with open(f'/proc/{self._process.pid}/status') as status:
                mask = next(line for line in status if line.startswith('SigCgt:')).split()[1]
            return int(mask, 16) >> (number - 1) & 1

        self._until(caught, f'catches {number!r}')

    def exit(self, patience=PATIENCE):
        """Wait for its end; gives the exit code, negative if a signal killed it."""
        try:
            return self._process.wait(patience)
        except subprocess.TimeoutExpired:
            raise AssertionError(f'not within {patience} s: {self.command} exits') from None

    def close(self):
        """End it, stopped or hung as it may be."""
        self._limit.cancel()
        try:
            # Who is killed leaves its shared memory behind.
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _until(self, condition, what):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert self.running, f'{self.command} exited with {self.exit()} before it {what}'
            assert time.monotonic() < deadline, f'not within {PATIENCE} s: {self.command} {what}'
            time.sleep(0.005)


class World:
    """A ROS domain on this machine with the processes started in it, and a harness that hears them."""

    def __init__(self, directory):
        self._directory = directory
        self._children = []
        self._stack = ExitStack()

    def start(self, name, *arguments, stdout=None):
        """Start an entry point with arguments. What goes into a given `stdout` is not seen."""
        child = Child(name, arguments, self._directory, stdout)
        self._children.append(child)
        return child

    @cached_property
    def harness(self):
        """A node in this process that the children can hear, and its executor."""
        from diffdrive_jacobian.ros.runner import make_executor, ros_context

        context = self._stack.enter_context(ros_context(['test']))
        harness = Harness(context, make_executor(context, isolated=False))
        self._stack.callback(harness.close)
        return harness

    def until_published(self, *topics):
        """Wait until each topic has a publisher."""
        for topic in topics:
            self.harness.until(lambda t=topic: self.harness.peer.count_publishers(t), f'has {topic}')

    def close(self):
        """End everything, and show what was printed: pytest hides it unless the test failed."""
        for child in self._children:
            child.signal(signal.SIGCONT)
            child.signal(signal.SIGTERM)
        for child in self._children:
            child.close()
        for child in self._children:
            print(f'--- {child.command}: {child.exit()}\n{child.stdout}{child.stderr}')
        self._stack.close()


class Drive:
    """A robot, a controller and what is heard of them."""

    def __init__(self, world, *gains):
        from action_msgs.msg import GoalStatus
        from geometry_msgs.msg import Twist
        from nav_msgs.msg import Odometry

        self.world, self.harness = world, world.harness
        self.robot = world.start('virtual_robot')
        self.controller = world.start('go_to_goal', *gains)
        self.odometry = self.harness.listen(Odometry, 'odom')
        self.commands = self.harness.listen(Twist, 'cmd_vel')
        self.status = self.harness.listen(GoalStatus, 'goal_status', latched=True)
        self.harness.until(lambda: self.odometry, 'the robot is heard')
        world.until_published('goal_status')

    def send(self, *arguments):
        """Start send_goal; returns it once the robot drives and the progress is shown."""
        sender = self.world.start('send_goal', *arguments)
        self.harness.until(lambda: self.drives() and self.commands, 'the robot drives')
        sender.until_says('m to go')
        return sender

    def drives(self):
        return bool(self.odometry) and self.odometry[-1].twist.twist.linear.x > 0.1

    def stands(self):
        twist = self.odometry[-1].twist.twist
        return twist.linear.x == twist.angular.z == 0.0

    def until_canceled(self):
        """Wait for the end of the last goal and of the robot's motion."""
        self.harness.until(
            lambda: self.status and self.status[-1].status == self.status[-1].STATUS_CANCELED, 'canceled'
        )
        self.harness.until(self.stands, 'the robot stands')


@contextmanager
def open_world(directory):
    """Hold a world of its own; files go into a directory."""
    # Domains beyond 101 collide with the ports that Linux gives to clients.
    environment = {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DOMAIN_ID': str(domain_id()),
        'ROS_LOG_DIR': str(directory),
        # Numpy starts a thread for every core otherwise: a fifth of what it costs to start a child.
        'OPENBLAS_NUM_THREADS': '1',
    }
    with mock.patch.dict(os.environ, environment):
        world = World(directory)
        try:
            yield world
        finally:
            world.close()
