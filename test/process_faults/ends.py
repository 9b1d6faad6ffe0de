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
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from support import processes
from support.processes import Child, World
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
    arguments: Callable[[Path, Path], list[str]]
    """Its arguments, given a bag to read and the path of one to write."""
    codes: tuple[int, ...]
    """Exit codes that the documentation allows."""
    ready: str = ''
    """What it prints when it runs. '': it is a calculation, and ended at a random time."""
    command: str = ''
    """Topic that it commands, on which the last message must be a zero."""


def _paths(*words: str) -> Callable[[Path, Path], list[str]]:
    """Return the words with the paths for BAG and NEW."""
    return lambda bag, new: [word.replace('BAG', str(bag)).replace('NEW', str(new)) for word in words]


WITHOUT_TIMEOUT = ('--ros-args', '-p', 'cmd_vel_timeout:=0.0')
PROGRAMS = (
    Program('virtual_robot', _paths(*WITHOUT_TIMEOUT), (0,), 'subscribed to'),
    Program('go_to_goal', _paths(), (0,), 'subscribed to', 'cmd_vel'),
    Program('wheel_bridge', _paths(*WITHOUT_TIMEOUT), (0,), 'subscribed to', 'joint_command'),
    Program('send_goal', _paths('50', '0'), (130, 1), 'm to go|waiting: ', 'cmd_vel'),
    Program('send_path', _paths('line:50'), (130, 1), 'm to go|waiting: ', 'cmd_vel'),
    Program('record_run', _paths('-o', 'NEW'), (0, 130, 1), 'recording to'),
    Program('replay_run', _paths('BAG'), (130, 0), '', 'cmd_vel'),
    Program('drive_to', _paths('5', '0', '-o', 'NEW', '--no-plot'), (130,), 'm to go|drives to|goal'),
    Program('watch_run', _paths('--no-browser'), (0,), 'http://'),
    Program('doctor', _paths(), (130, 0, 1)),
    Program('verify_run', _paths('BAG'), (130, 0, 1)),
    Program('plot_run', _paths('BAG', '-o', 'NEW.png'), (130, 0, 1)),
    Program('plot_jacobian', _paths('geometry', '-o', 'NEW.png'), (130, 0)),
    Program('recover_run', _paths('BAG', '-o', 'NEW'), (130, 0, 1)),
    Program('sweep_gains', _paths('-o', 'NEW.png'), (130, 0)),
    Program('calibrate_run', _paths('BAG'), (130, 0, 1, 2)),
)
WITHOUT_ROS = (
    *('verify_run', 'plot_run', 'plot_jacobian', 'recover_run', 'sweep_gains', 'calibrate_run'),
)
SENDERS = ('send_goal', 'send_path')
"""Programs that send goals to a controller in another process."""
GOALS = '/goals'
"""Namespace of the robot to which all goals are sent."""
MODES = ('start-up', 'running', 'busy', 'callback', 'twice')


class Ending:
    """What one end of a process took and left."""

    def __init__(self, child: Child, meanwhile: Callable[[], object]) -> None:
        self.child = child
        self.pid = child._process.pid
        self._meanwhile = meanwhile
        self.caught = False
        self.seconds = self.cpu = 0.0

    def signal(self, *numbers: int, pause: float = 0.2) -> None:
        """Send signals, and wait for the end."""
        # Python itself catches SIGINT, before the program does.
        self.caught = self._catches(signal.SIGHUP)
        begun, waited, used = time.monotonic(), *self._scheduled()[::-1]
        os.kill(self.pid, numbers[0])
        for number in numbers[1:]:
            if not self._ended_before(begun + pause):
                os.kill(self.pid, number)
        self._ended_before(begun + PATIENCE)
        ended = time.monotonic()
        after_used, after_waited = self._scheduled()
        self.seconds = ended - begun - max(0.0, after_waited - waited)
        self.cpu = after_used - used

    def _ended_before(self, deadline: float) -> bool:
        # Nobody waits for it: it stays a zombie, of which Linux still has the times.
        process, ended = os.pidfd_open(self.pid), select.poll()
        ended.register(process, select.POLLIN)
        try:
            while time.monotonic() < deadline:
                if ended.poll(0):
                    return True
                self._meanwhile()
        finally:
            os.close(process)
        return False

    def _scheduled(self) -> tuple[float, float]:
        """Return how long the main thread ran, and was ready to run and did not (s)."""
        used, waited, _ = Path(f'/proc/{self.pid}/schedstat').read_text().split()
        return int(used) / 1e9, int(waited) / 1e9

    def _catches(self, number: int) -> bool:
        status = Path(f'/proc/{self.pid}/status').read_text()
        found = [line.split()[1] for line in status.splitlines() if line.startswith('SigCgt:')]
        return bool(int(found[0], 16) >> (number - 1) & 1)


class Campaign:
    """Ends programs in a world, one after the other."""

    def __init__(
        self, world: World, folder: Path, bag: Path, chance: random.Random, *, fresh: bool = False
    ) -> None:
        """Take a world. With `fresh`, programs are new interpreters, which import everything."""
        self.world, self.folder, self.bag, self.chance = world, folder, bag, chance
        self.fresh = fresh
        self.number = 0
        self.start_up: dict[str, float] = {}
        self.harness = world.harness
        self._serves_goals = False

    def end(self, program: Program, mode: str) -> tuple[list[str], Ending]:
        """Start a program and end it; return what broke the promise."""
        self.number += 1
        space = GOALS if program.name in SENDERS else f'/n{self.number}'
        new = self.folder / f'new{self.number}' / 'made'
        new.parent.mkdir()
        arguments = program.arguments(self.bag, new)
        if program.name not in WITHOUT_ROS:
            arguments += [
                *(() if '--ros-args' in arguments else ('--ros-args',)),
                '-r',
                f'__ns:={space}',
            ]
        if program.name in SENDERS and not self._serves_goals:
            self._serve_goals()
        traffic = Traffic(self.harness, program, space)
        begun = time.monotonic()
        slow = mode == 'callback' and program.ready == 'subscribed to'
        source = SLOW_CALLBACKS.strip() + '\n' + processes.PROGRAM if slow else processes.PROGRAM
        with mock.patch.object(processes, 'PROGRAM', source):
            child = self.world.start(program.name, *arguments, fresh=self.fresh)
        ending = Ending(child, lambda: traffic.spin(mode == 'busy'))
        if mode == 'start-up' or not program.ready:
            until = begun + self.chance.uniform(0.0, self.start_up.get(program.name, 1.0))
            while time.monotonic() < until and child.running:
                traffic.spin(False)
        else:
            try:
                child.until_says(program.ready)
            except AssertionError as error:
                return [f'{program.name}, {mode}: {error}, stderr: {child.stderr[-300:]!r}'], ending
            self.start_up[program.name] = min(time.monotonic() - begun, 3.0)
            until = time.monotonic() + self.chance.uniform(0.0, 0.5)
            while not traffic.moving() or time.monotonic() < until:
                if time.monotonic() > begun + PATIENCE or not child.running:
                    break
                traffic.spin(mode == 'busy')
        numbers = [self.chance.choice(SIGNALS) for _ in range(2 if mode == 'twice' else 1)]
        if child.running:
            ending.signal(*numbers, pause=self.chance.uniform(0.0, 0.5))
        else:
            # A calculation that was ready before its end came.
            ending.caught = True
        return self._violations(program, ending, traffic, new, numbers, mode), ending

    def _serve_goals(self) -> None:
        """Start a robot and a controller for all senders of goals."""
        self._serves_goals = True
        for name in ('virtual_robot', 'go_to_goal'):
            child = self.world.start(name, '--ros-args', '-r', f'__ns:={GOALS}')
            child.until_says('subscribed to')

    def _violations(self, program, ending, traffic, new, numbers, mode) -> list[str]:
        child, found = ending.child, []
        try:
            code = child.exit(patience=0.5)
        except AssertionError:
            child.signal(signal.SIGKILL)
            return [f'{program.name}, {mode}: does not exit after {numbers}']
        what = f'{program.name}, {mode}, {[signal.Signals(one).name for one in numbers]}'
        if not ending.caught:
            # Before the first line of the program only Python's own handlers are there.
            return []
        if code not in program.codes:
            found.append(f'{what}: exit code {code}, stderr: {child.stderr[-300:]!r}')
        if line := unexpected(child.stderr + child.stdout):
            found.append(f'{what}: printed {line!r}')
        if ending.seconds > LIMIT:
            found.append(f'{what}: exits after {ending.seconds:.2f} s (CPU {ending.cpu:.2f} s)')
        found += [f'{what}: left {one}' for one in remains(new.parent)]
        if program.command and traffic.drove() and not traffic.ends_with_zero():
            found.append(f'{what}: the last message on {program.command} is not zero')
        return found


def remains(folder: Path) -> list[str]:
    """Return what a program has left that is not a result."""
    names = [one.name for one in folder.iterdir()]
    return [name for name in names if name.startswith('.') or name.endswith('.journal.mcap')]


class Traffic:
    """What a program receives and sends while it is ended."""

    def __init__(self, harness: Any, program: Program, space: str) -> None:
        self.harness, self.program = harness, program
        self.commands: list[Any] = []
        self._data: list[tuple[Any, bytes]] = []
        peer = harness.peer

        def add(kind: Any, topic: str, message: Any) -> None:
            publisher = peer.create_publisher(kind, f'{space}/{topic}', 10)
            self._data.append((publisher, serialize_message(message)))

        if program.name in ('virtual_robot', 'wheel_bridge'):
            add(Twist, 'cmd_vel', twist(0.2, 0.0))
        elif program.name == 'go_to_goal':
            add(Odometry, 'odom', odometry(0, 0, 0))
            self._goal = peer.create_publisher(PoseStamped, f'{space}/goal_pose', 1)
        if program.command:
            kind = JointState if program.command == 'joint_command' else Twist
            self._heard = peer.create_subscription(
                kind, f'{space}/{program.command}', self.commands.append, QoSProfile(depth=1000)
            )
        self._next = self._next_goal = 0.0

    def spin(self, flood: bool) -> None:
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

    def moving(self) -> bool:
        """Return whether the program commands a motion. Programs without commands need not."""
        if self.program.name in ('replay_run', *SENDERS):
            return True
        return not self.program.command or self.drove()

    def drove(self) -> bool:
        return any(map(moves, self.commands))

    def ends_with_zero(self) -> bool:
        """Wait a moment for a zero."""
        deadline = time.monotonic() + 2.0
        while moves(self.commands[-1]) and time.monotonic() < deadline:
            self.harness.executor.spin_once(timeout_sec=0.01)
        return not moves(self.commands[-1])


def make_bag(folder: Path) -> Path:
    """Record a drive in simulated time."""
    with quiet_world(folder) as world:
        child = world.run('drive_to', '1', '1', '--lockstep', '--no-plot', '-o', str(folder / 'drive'))
        assert child.exit() == 0, child.stderr
    return folder / 'drive'


def run(count: int, seed: int = 0, programs: tuple[str, ...] = ()) -> Outcome:
    """End every program so often."""
    chance = random.Random(seed)
    violations: list[str] = []
    times, cpus, tried = [], [], 0
    with tempfile.TemporaryDirectory(prefix='ends_') as name, ExitStack() as stack:
        folder = Path(name)
        bag = make_bag(folder)
        cases = [
            (program, MODES[index % len(MODES)])
            for index in range(count)
            for program in PROGRAMS
            if not programs or program.name in programs
        ]
        for index, (program, mode) in enumerate(cases):
            if index % A_WORLD == 0:
                stack.close()
                place = folder / f'world{index}'
                place.mkdir()
                made = stack.enter_context(quiet_world(place))
                campaign = Campaign(made, place, bag, chance, fresh=True)
            try:
                found, ending = campaign.end(program, mode)
            except AssertionError as error:
                found = [f'{program.name}, {mode}: {error}']
            except KeyboardInterrupt:
                # What was tried until then counts.
                break
            else:
                times.append(ending.seconds)
                cpus.append(ending.cpu)
            tried += 1
            violations += found
            if tried % A_WORLD == 0:
                print(f'  {tried} of {len(cases)}: {violations}', flush=True)
    measured = f'exit after {spread(times, "s")}; CPU of the exit {spread(cpus, "s")}'
    return Outcome(tried, violations, measured)
