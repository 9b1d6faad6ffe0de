"""Every program is ended by signals at random times: how soon it exits, with which code, what it leaves.

A time is measured from the first signal to the exit, without the time in which the process was ready to
run and waited for a core: that depends on what else the machine does.
"""

from __future__ import annotations

import os
import random
import select
import signal
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from support import processes
from support.ros_messages import goal, odometry, twist

from process_faults.outcome import Outcome, spread, unexpected
from process_faults.worlds import moves, quiet_world

LIMIT = 1.0
"""Longest time from a signal to the exit (s)."""
PATIENCE = 90.0
"""Time after which a process that does not exit is killed (s). A busy machine makes it wait."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
A_WORLD = 24
"""Ends in one ROS domain."""
SLOW_CALLBACKS = """
import time
import diffdrive_jacobian.ros.node as node
decoding = node.decoding
def slow(message, fields, callback, *others):
    def late(*values):
        time.sleep(0.05)
        callback(*values)
    return decoding(message, fields, late, *others)
node.decoding = slow
"""
"""Each callback takes 50 ms. The EventsExecutor may run as many as a queue has messages, 10, at once."""


class Program(NamedTuple):
    """A program that is ended."""

    name: str
    arguments: str
    """Its arguments, with BAG for a bag to read and NEW for the path of one to write."""
    codes: tuple[int, ...]
    """Exit codes that the documentation allows."""
    ready: str = ''
    """What it prints when it runs. '': it is a calculation, and ended at a random time."""
    command: str = ''
    """Topic that it commands, on which the last message must be a zero."""
    is_ros: bool = True


WITHOUT_TIMEOUT = '--ros-args -p cmd_vel_timeout:=0.0'
SENDS = 'm to go|waiting: '
PROGRAMS = (
    Program('virtual_robot', WITHOUT_TIMEOUT, (0,), 'subscribed to'),
    Program('go_to_goal', '--ros-args', (0,), 'subscribed to', 'cmd_vel'),
    Program('wheel_bridge', WITHOUT_TIMEOUT, (0,), 'subscribed to', 'joint_command'),
    Program('send_goal', '50 0 --ros-args', (130, 1), SENDS, 'cmd_vel'),
    Program('send_path', 'line:50 --ros-args', (130, 1), SENDS, 'cmd_vel'),
    Program('record_run', '-o NEW --ros-args', (0, 130, 1), 'recording to'),
    Program('replay_run', 'BAG --ros-args', (130, 0), '', 'cmd_vel'),
    Program('drive_to', '5 0 -o NEW --no-plot --ros-args', (130,), 'm to go|drives to|goal'),
    Program('watch_run', '--no-browser --ros-args', (0,), 'http://'),
    Program('doctor', '--ros-args', (130, 0, 1)),
    Program('verify_run', 'BAG', (130, 0, 1), is_ros=False),
    Program('plot_run', 'BAG -o NEW.png', (130, 0, 1), is_ros=False),
    Program('plot_jacobian', 'geometry -o NEW.png', (130, 0), is_ros=False),
    Program('recover_run', 'BAG -o NEW', (130, 0, 1), is_ros=False),
    Program('sweep_gains', '-o NEW.png', (130, 0), is_ros=False),
    Program('calibrate_run', 'BAG', (130, 0, 1, 2), is_ros=False),
)
SENDERS = ('send_goal', 'send_path')
"""Programs that send goals to a controller in another process."""
GOALS = '/goals'
"""Namespace of the robot to which all goals are sent."""
MODES = ('start-up', 'running', 'busy', 'callback', 'twice')


def scheduled(pid):
    """Return how long the main thread of a process ran, and was ready to run and did not (s)."""
    used, waited, _ = Path(f'/proc/{pid}/schedstat').read_text().split()
    return int(used) / 1e9, int(waited) / 1e9


def catches(pid, number):
    """Return whether a process has a handler for a signal."""
    status = Path(f'/proc/{pid}/status').read_text()
    (mask,) = (line.split()[1] for line in status.splitlines() if line.startswith('SigCgt:'))
    return bool(int(mask, 16) >> (number - 1) & 1)


def end(child, numbers, pause, meanwhile):
    """Send signals, and wait for the end; return how long it took, and the CPU time of it (s)."""
    pid = child._process.pid
    descriptor, ended = os.pidfd_open(pid), select.poll()
    ended.register(descriptor, select.POLLIN)

    def ends_before(deadline):
        # Nobody waits for it: it stays a zombie, of which Linux still has the times.
        while not ended.poll(0) and time.monotonic() < deadline:
            meanwhile()
        return ended.poll(0)

    begun, (used, waited) = time.monotonic(), scheduled(pid)
    os.kill(pid, numbers[0])
    for number in numbers[1:]:
        if not ends_before(begun + pause):
            os.kill(pid, number)
    ends_before(begun + PATIENCE)
    passed, (used_then, waited_then) = time.monotonic() - begun, scheduled(pid)
    os.close(descriptor)
    return passed - max(0.0, waited_then - waited), used_then - used


class Campaign:
    """Ends programs in a world, one after the other."""

    def __init__(self, world, folder, bag, chance, *, fresh=False):
        """Take a world. With `fresh`, programs are new interpreters, which import everything."""
        self.world, self.folder, self.bag, self.chance = world, folder, bag, chance
        self.fresh, self.harness = fresh, world.harness
        self.number, self.start_up, self._serves_goals = 0, {}, False

    def end(self, program, mode):
        """Start a program and end it; return what broke the promise, and time and CPU of the end (s)."""
        self.number += 1
        space = GOALS if program.name in SENDERS else f'/n{self.number}'
        new = self.folder / f'new{self.number}' / 'made'
        new.parent.mkdir()
        words = [*program.arguments.split(), *(('-r', f'__ns:={space}') if program.is_ros else ())]
        words = [word.replace('BAG', str(self.bag)).replace('NEW', str(new)) for word in words]
        if program.name in SENDERS and not self._serves_goals:
            # A robot and a controller for all of them.
            self._serves_goals = True
            for name in ('virtual_robot', 'go_to_goal'):
                server = self.world.start(name, '--ros-args', '-r', f'__ns:={GOALS}')
                server.until_says('subscribed to')
        traffic = Traffic(self.harness, program, space)
        begun = time.monotonic()
        slow = mode == 'callback' and program.ready == 'subscribed to'
        source = SLOW_CALLBACKS.strip() + '\n' + processes.PROGRAM if slow else processes.PROGRAM
        with mock.patch.object(processes, 'PROGRAM', source):
            child = self.world.start(program.name, *words, fresh=self.fresh)
        flood = mode == 'busy'
        if mode == 'start-up' or not program.ready:
            until = begun + self.chance.uniform(0.0, self.start_up.get(program.name, 1.0))
            while time.monotonic() < until and child.running:
                traffic.spin(False)
        else:
            try:
                child.until_says(program.ready)
            except AssertionError as error:
                stderr = child.stderr[-300:]
                return [f'{program.name}, {mode}: {error}, stderr: {stderr!r}'], 0.0, 0.0
            self.start_up[program.name] = min(time.monotonic() - begun, 3.0)
            until = time.monotonic() + self.chance.uniform(0.0, 0.5)
            while (not traffic.moving() or time.monotonic() < until) and child.running:
                if time.monotonic() > begun + PATIENCE:
                    break
                traffic.spin(flood)
        numbers = [self.chance.choice(SIGNALS) for _ in range(2 if mode == 'twice' else 1)]
        seconds = cpu = 0.0
        # A calculation may have been ready before its end came.
        caught = not child.running or catches(child._process.pid, signal.SIGHUP)
        if child.running:
            pause = self.chance.uniform(0.0, 0.5)
            seconds, cpu = end(child, numbers, pause, lambda: traffic.spin(flood))
        # Before the first line of the program only Python's own handlers are there.
        found = self._violations(program, child, traffic, new.parent, seconds) if caught else []
        what = f'{program.name}, {mode}, {[signal.Signals(one).name for one in numbers]}'
        return [f'{what}: {one}' for one in found], seconds, cpu

    def _violations(self, program, child, traffic, folder, seconds):
        try:
            code = child.exit(patience=0.5)
        except AssertionError:
            child.signal(signal.SIGKILL)
            return ['does not exit']
        found = []
        if code not in program.codes:
            found.append(f'exit code {code}, stderr: {child.stderr[-300:]!r}')
        if line := unexpected(child.stderr + child.stdout):
            found.append(f'printed {line!r}')
        if seconds > LIMIT:
            found.append(f'exits after {seconds:.2f} s')
        names = [one.name for one in folder.iterdir()]
        # What is not a result.
        left = [name for name in names if name.startswith('.') or name.endswith('.journal.mcap')]
        found += [f'left {name}' for name in left]
        if program.command and any(map(moves, traffic.commands)) and not traffic.ends_with_zero():
            found.append(f'the last message on {program.command} is not zero')
        return found


class Traffic:
    """What a program receives and sends while it is ended."""

    def __init__(self, harness, program, space):
        self.harness, self.program, self._space = harness, program, space
        self.commands, self._data = [], []
        self._next = self._next_goal = 0.0
        if program.name in ('virtual_robot', 'wheel_bridge'):
            self._add(Twist, 'cmd_vel', twist(0.2, 0.0))
        elif program.name == 'go_to_goal':
            self._add(Odometry, 'odom', odometry(0, 0, 0))
            self._goal = harness.peer.create_publisher(PoseStamped, f'{space}/goal_pose', 1)
        if program.command:
            kind = JointState if program.command == 'joint_command' else Twist
            profile = QoSProfile(depth=1000)
            topic = f'{space}/{program.command}'
            harness.peer.create_subscription(kind, topic, self.commands.append, profile)

    def _add(self, kind, topic, message):
        publisher = self.harness.peer.create_publisher(kind, f'{self._space}/{topic}', 10)
        self._data.append((publisher, serialize_message(message)))

    def spin(self, flood):
        """Send what is due, and receive."""
        now = time.monotonic()
        if now >= self._next or flood:
            self._next = now + 0.02
            for publisher, data in self._data:
                for _ in range(20 if flood else 1):
                    publisher.publish(data)
        if self.program.name == 'go_to_goal' and not self.commands and now >= self._next_goal:
            self._next_goal = now + 0.3
            self._goal.publish(goal(50, 0))
        self.harness.executor.spin_once(timeout_sec=0.005)

    def moving(self):
        """Return whether the program commands a motion. Some need not."""
        free = not self.program.command or self.program.name in ('replay_run', *SENDERS)
        return free or any(map(moves, self.commands))

    def ends_with_zero(self):
        """Wait a moment for a zero."""
        deadline = time.monotonic() + 2.0
        while moves(self.commands[-1]) and time.monotonic() < deadline:
            self.harness.executor.spin_once(timeout_sec=0.01)
        return not moves(self.commands[-1])


def make_bag(folder):
    """Record a drive in simulated time."""
    with quiet_world(folder) as world:
        child = world.run('drive_to', '1', '1', '--lockstep', '--no-plot', '-o', str(folder / 'drive'))
        assert child.exit() == 0, child.stderr
    return folder / 'drive'


def run(count, seed=0):
    """End every program so often."""
    chance = random.Random(seed)
    violations, times, cpus = [], [], []
    cases = [(program, MODES[index % len(MODES)]) for index in range(count) for program in PROGRAMS]
    with tempfile.TemporaryDirectory(prefix='ends_') as name, ExitStack() as stack:
        folder = Path(name)
        bag = make_bag(folder)
        for index, (program, mode) in enumerate(cases):
            if index % A_WORLD == 0:
                print(f'  {index} of {len(cases)}: {violations}', flush=True)
                stack.close()
                place = folder / f'world{index}'
                place.mkdir()
                made = stack.enter_context(quiet_world(place))
                campaign = Campaign(made, place, bag, chance, fresh=True)
            try:
                found, seconds, cpu = campaign.end(program, mode)
            except AssertionError as error:
                violations.append(f'{program.name}, {mode}: {error}')
            else:
                violations += found
                times.append(seconds)
                cpus.append(cpu)
    measured = f'exit after {spread(times, "s")}; CPU of the exit {spread(cpus, "s")}'
    return Outcome(len(cases), violations, measured)
