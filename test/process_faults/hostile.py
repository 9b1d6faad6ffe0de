"""Hostile messages at every input of every node that runs as a process.

Messages are damaged in many ways: numbers that are not finite or huge, lengths up to 2^32, bytes
flipped, cut off or added, other encapsulations, long texts with control characters, random bytes. Each
is another one. They are published as bytes, a few at a time, so that the node receives most of them.
"""

from __future__ import annotations

import math
import random
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.srv import GetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from support.ros_messages import (
    goal,
    goals,
    joint_command,
    odometry,
    path,
    placement,
    twist,
    twist_stamped,
)

from diffdrive_jacobian.ros.rclpy_internals import RCLError
from process_faults.outcome import Outcome, unexpected
from process_faults.worlds import OUTPUTS, finite, moves, quiet_world, spin

BURST = 8
"""Messages at once; the queues of the nodes have room for 10."""
PAUSE = 0.002
"""Shortest time between bursts (s)."""
MEMORY = 5.0
"""Most that the memory of a node may grow from the first tenth of the messages on (MB)."""
LINES = 0.02
"""Most lines that a node may log, per message; and a few always."""
DOUBLES = (
    *(math.nan, math.inf, -math.inf, 5e-324, -5e-324, 1.7e308, -1.7e308, 1e9, -1e9, 0.0, -0.0),
    *(math.pi, 1e-9, 1e-160, 1e160),
)
LENGTHS = (0, 1, 2, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1)
TEXTS = (b'\x1b[2J\x1b]0;x\x07', b'\xff\xfe', b'a' * 5000, b'\n\r\0', '\u202e'.encode(), b'=1+1', b'')


class Input(NamedTuple):
    """An input of a node."""

    node: str
    topic: str
    kind: Any
    arguments: tuple[str, ...] = ()


STAMPED = ('-p', 'enable_stamped_cmd_vel:=true')
SIMULATED = ('-p', 'use_sim_time:=true')
INPUTS = (
    Input('virtual_robot', 'cmd_vel', Twist),
    Input('virtual_robot', 'cmd_vel', TwistStamped, STAMPED),
    Input('virtual_robot', 'joint_command', JointState, ('-p', 'command_interface:=wheels')),
    Input('virtual_robot', 'initialpose', PoseWithCovarianceStamped),
    Input('virtual_robot', '/clock', Clock, SIMULATED),
    Input('wheel_bridge', 'cmd_vel', Twist),
    Input('wheel_bridge', 'cmd_vel', TwistStamped, STAMPED),
    Input('wheel_bridge', '/clock', Clock, SIMULATED),
    Input('go_to_goal', 'odom', Odometry),
    Input('go_to_goal', 'goal_pose', PoseStamped),
    Input('go_to_goal', 'goals', Goals),
    Input('go_to_goal', 'path', PathMessage),
    Input('go_to_goal', '/clock', Clock, SIMULATED),
    Input('send_goal', 'goal_status', GoalStatus),
    Input('send_goal', 'odom', Odometry),
    Input('watch_run', 'odom', Odometry),
    Input('watch_run', 'goals', Goals),
    Input('watch_run', 'path', PathMessage),
    Input('watch_run', 'goal_status', GoalStatus),
)
TOOLS = {
    'send_goal': (('50', '0', '--wait', '1e5'), 'waiting: ', 130),
    'watch_run': (('--no-browser',), 'page: ', 0),
}
"""Arguments of programs that are not nodes, what they print when they run, and their exit codes."""


VALID = {
    Twist: twist(0.2, 0.3),
    TwistStamped: twist_stamped(0.2, 0.3, 0),
    JointState: joint_command(1, 2),
    Clock: Clock(),
    GoalStatus: GoalStatus(),
    PoseStamped: goal(3, 0),
    Goals: goals(goal(3, 0), goal(3, 0)),
    PathMessage: path((0, 0), (3, 0)),
    PoseWithCovarianceStamped: placement(3),
    Odometry: odometry(3, 0, 0),
}
"""Messages that every node accepts."""


def damaged(chance, data):
    """Return a message damaged in one or a few ways."""
    found = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 4))):
        size = len(found)
        what = chance.randrange(8)
        if what <= 1 and size >= 12:
            # Doubles lie at multiples of 8 behind the encapsulation.
            at = 4 + 8 * chance.randrange((size - 4) // 8)
            struct.pack_into('<d', found, at, chance.choice(DOUBLES))
        elif what == 2 and size >= 8:
            at = 4 * chance.randrange(1, size // 4)
            struct.pack_into('<I', found, at, chance.choice(LENGTHS))
        elif what == 3 and size:
            for _ in range(chance.choice((1, 3, 30))):
                found[chance.randrange(size)] ^= 1 << chance.randrange(8)
        elif what == 4:
            del found[chance.randrange(size + 1) :]
        elif what == 5:
            found += chance.randbytes(chance.choice((1, 4, 100, 5000)))
        elif what == 6 and size >= 4:
            found[:4] = chance.choice((b'\0\0\0\0', b'\0\1\0\0', b'\0\2\0\0', b'\0\3\0\0', b'\xff' * 4))
        elif size >= 8:
            text = chance.choice(TEXTS)
            at = 4 * chance.randrange(1, size // 4)
            found[at:at] = struct.pack('<I', len(text) + 1) + text + b'\0'
    if chance.random() < 0.02:
        return chance.randbytes(chance.choice((0, 1, 3, 4, 8, 60, 1000)))
    return bytes(found)


def resident(pid):
    """Return the resident memory of a process (MB)."""
    return int(Path(f'/proc/{pid}/status').read_text().split('VmRSS:')[1].split()[0]) / 1024.0


class Attack:
    """One input of a running node, and what is heard of the node."""

    def __init__(self, world, one, chance):
        self.input, self.chance, self.harness = one, chance, world.harness
        own, ready, self.code = TOOLS.get(one.node, ((), 'subscribed to', 0))
        # Each has a clock of its own.
        clock = ('-r', f'/clock:=/{one.node}/clock')
        arguments = ('--ros-args', '-r', f'__ns:=/{one.node}', *clock, *one.arguments)
        self.child = world.start(one.node, *own, *arguments)
        self.child.until_says(ready)
        self.publisher = self._talk(one.kind, one.topic)
        # It makes watch_run find a robot.
        self._odometry = self._talk(Odometry, 'odom') if one.node == 'watch_run' else None
        self.heard, self.infinite = [], []
        if one.node in OUTPUTS:
            kind, topic = OUTPUTS[one.node]
            profile = QoSProfile(depth=1000)
            name = f'/{one.node}/{topic}'
            self.harness.peer.create_subscription(kind, name, self._on_output, profile)
        self.harness.until(self.publisher.get_subscription_count, f'{one.node} reads {one.topic}')

    def _talk(self, kind, topic):
        profile = QoSProfile(depth=100)
        if kind is GoalStatus:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        name = f'/{self.input.node}/{topic.lstrip("/")}'
        return self.harness.peer.create_publisher(kind, name, profile)

    def _on_output(self, message):
        self.heard[:] = [message]
        if not finite(message):
            self.infinite.append(str(message)[:300])

    def run(self, count):
        """Send so many messages; return what broke the promise, and numbers."""
        data, pid = serialize_message(VALID[self.input.kind]), self.child._process.pid
        first, sent, violations = resident(pid), 0, []
        while sent < count and self.child.running:
            before = sent
            for _ in range(BURST):
                # Fast DDS publishes none that are empty, or longer than a message of the type can be.
                with suppress(RCLError):
                    self.publisher.publish(damaged(self.chance, data))
                    sent += 1
            if before < count // 10 <= sent:
                first = resident(pid)
            spin(self.harness, PAUSE)
        grown = resident(pid) - first if self.child.running else 0.0
        if grown > MEMORY:
            violations.append(f'memory grew by {grown:.1f} MB')
        said = self.child.stderr
        if line := unexpected(said):
            violations.append(f'printed {line!r}')
        if (lines := len(said.splitlines())) > 50 + LINES * count:
            violations.append(f'{lines} lines were logged')
        if not said.replace('\n', '').isprintable():
            violations.append('control characters were logged')
        violations += [f'published {one}' for one in self.infinite[:1]]
        if self.input.node in OUTPUTS and self.child.running:
            try:
                self._works()
            except AssertionError as error:
                violations.append(f'afterwards: {error}')
        self.child.signal(2)
        if self.child.exit() != self.code:
            violations.append(f'exit code {self.child.exit()}: {said[-300:]!r}')
        name = f'{self.input.node} {self.input.topic} ({self.input.kind.__name__})'
        numbers = f'{sent} messages, {grown:+.1f} MB, {lines} log lines'
        return [f'{name}: {one}' for one in violations], numbers

    def _works(self):
        """Call a service, and send valid messages until the node acts on them."""
        one = self.input
        name = f'/{one.node}/{one.node}/get_parameters'
        client = self.harness.peer.create_client(GetParameters, name)
        self.harness.until(client.service_is_ready, 'there is a service')
        future = client.call_async(GetParameters.Request(names=['use_sim_time']))
        self.harness.until(future.done, 'a service is answered')
        clock = Clock()
        # A clock may be years ahead.
        clock.clock.sec = 100
        wanted = [(self.publisher, clock)] if one.arguments == SIMULATED else []
        if one.node == 'go_to_goal':
            wanted.append((self._talk(Odometry, 'odom'), odometry(0, 0, 0)))
            wanted.append((self._talk(PoseStamped, 'goal_pose'), VALID[PoseStamped]))
        else:
            wheels = one.topic == 'joint_command'
            kind = TwistStamped if one.arguments == STAMPED else JointState if wheels else Twist
            wanted.append((self._talk(kind, 'joint_command' if wheels else 'cmd_vel'), VALID[kind]))
        self.heard.clear()

        def acts():
            clock.clock.sec += 1
            for publisher, message in wanted:
                publisher.publish(message)
            return bool(self.heard) and moves(self.heard[-1])

        self.harness.until(acts, 'it acts on valid messages')


def run(count, seed=0, inputs=INPUTS):
    """Send so many hostile messages to each input."""
    chance = random.Random(seed)
    violations = []
    for one in inputs:
        with quiet_world() as world:
            found, numbers = Attack(world, one, chance).run(count)
        violations += found
        print(f'  {one.node} {one.topic}: {numbers}', flush=True)
    return Outcome(count * len(inputs), violations, f'{len(inputs)} inputs')
