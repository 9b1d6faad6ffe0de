"""Simulated clocks that start at 0, jump, go back, stand still, disagree, and are not plausible.

A robot, a bridge and a controller in processes follow a /clock that runs ten times as fast as time,
until something happens to it. Whatever it is: they stay alive, what they publish is finite, and once the
clock runs evenly again, the robot arrives.
"""

from __future__ import annotations

import math
import random
import tempfile
import time
from pathlib import Path
from typing import Any

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from support.processes import World
from support.ros_messages import goal

from process_faults.outcome import Outcome, unexpected
from process_faults.worlds import finite, quiet_world, spin

STEP = 0.02
"""Time between two messages on /clock (s)."""
FACTOR = 10.0
"""Speed of the clock."""
SETTLED = 0.05
"""Time of the machine between two steps of an event (s)."""
MOST = 2**31 - 1 - 1e-9
"""Largest time of a message (s)."""


class Simulation:
    """Three nodes in processes that follow a clock."""

    def __init__(self, world: World) -> None:
        self.world, self.harness = world, world.harness
        peer = self.harness.peer
        self.clocks = [peer.create_publisher(Clock, '/clock', 10) for _ in range(2)]
        self.heard: dict[str, Any] = {}
        self.infinite: list[str] = []
        for topic, kind in (('odom', Odometry), ('cmd_vel', Twist), ('joint_command', JointState)):
            self._hear(topic, kind)
        self.statuses = self.harness.listen(GoalStatus, 'goal_status', latched=True)
        self.goal = peer.create_publisher(PoseStamped, 'goal_pose', 1)
        simulated = ('--ros-args', '-p', 'use_sim_time:=true')
        self.nodes = [
            world.start('virtual_robot', *simulated, '-p', 'command_interface:=wheels'),
            world.start('wheel_bridge', *simulated),
            world.start('go_to_goal', *simulated, '-p', 'kp:=6.0', '-p', 'kv:=2.0'),
        ]
        for node in self.nodes:
            node.until_says('subscribed to')
        for publisher in (*self.clocks, self.goal):
            self.harness.until(publisher.get_subscription_count, 'the nodes are there')
        self.now = 0.0
        self._next = 0.0

    def _hear(self, topic: str, kind: Any) -> None:
        def on_message(message: Any) -> None:
            self.heard[topic] = message
            if not finite(message):
                self.infinite.append(str(message)[:300])

        self.harness.peer.create_subscription(kind, topic, on_message, 1000)

    def publish(self, seconds: float, publisher: int = 0) -> None:
        """Publish a time, as a message can hold it."""
        nanoseconds = round(max(-(2.0**31), min(seconds, MOST)) * 1e9)
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(nanoseconds, 1_000_000_000)
        self.clocks[publisher].publish(message)

    def run(self, seconds: float) -> None:
        """Let the clock run evenly for so long (s, of the machine)."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.tick()

    def tick(self) -> None:
        """Publish the next time if it is due, and receive."""
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + STEP / FACTOR
            self.now += STEP
            self.publish(self.now)
        self.harness.executor.spin_once(timeout_sec=0.001)

    def until(self, condition: Any, what: str) -> None:
        end = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < end, f'not within 20 s: {what}'
            self.tick()

    def arrive(self) -> None:
        """Send a goal half a metre away, more than once if need be, and wait for the arrival."""
        sent = -math.inf

        def arrived() -> bool:
            nonlocal sent
            if time.monotonic() > sent + 3.0:
                sent = time.monotonic()
                self.statuses.clear()
                at = self.heard['odom'].pose.pose.position
                self.goal.publish(goal(at.x + 0.3, at.y + 0.4))
            return any(one.status == GoalStatus.STATUS_SUCCEEDED for one in self.statuses)

        self.until(lambda: 'odom' in self.heard, 'the robot publishes odometry')
        self.until(arrived, 'the robot arrives')


# --- What happens to a clock


def jump(made: Simulation, chance: random.Random) -> str:
    seconds = chance.choice((-1, 1)) * 10.0 ** chance.uniform(-3, 5)
    made.now = max(0.0, made.now + seconds)
    return f'jumps by {seconds:.3g} s'


def restart(made: Simulation, chance: random.Random) -> str:
    made.now = 0.0
    made.publish(0.0)
    return 'begins at 0 again'


def pause(made: Simulation, chance: random.Random) -> str:
    seconds = chance.uniform(0.1, 1.5)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        made.publish(made.now)
        made.harness.executor.spin_once(timeout_sec=0.01)
    return f'stands still for {seconds:.1f} s'


def silence(made: Simulation, chance: random.Random) -> str:
    spin(made.harness, chance.uniform(0.1, 1.5))
    return 'is silent'


def disagree(made: Simulation, chance: random.Random) -> str:
    ahead = chance.choice((-100.0, -0.5, -0.01, 0.01, 0.5, 100.0, 1e6))
    for _ in range(chance.randrange(3, 40)):
        made.publish(made.now)
        made.publish(made.now + ahead, 1)
        made.run(SETTLED / 5)
    return f'two of them disagree by {ahead:g} s'


def implausible(made: Simulation, chance: random.Random) -> str:
    times = [chance.choice((-1.0, -(2.0**31), MOST, 1e-9, 0.0, 2.0**30)) for _ in range(5)]
    for one in times:
        made.publish(one)
        spin(made.harness, SETTLED)
    return f'has the times {times}'


def fast(made: Simulation, chance: random.Random) -> str:
    for _ in range(200):
        made.now += chance.uniform(0.0, 1.0)
        made.publish(made.now)
    return 'runs a thousand times as fast'


EVENTS = (jump, restart, pause, silence, disagree, implausible, fast)


def run(count: int, seed: int = 0) -> Outcome:
    """Let so many things happen to the clock."""
    chance = random.Random(seed)
    violations: list[str] = []
    with tempfile.TemporaryDirectory(prefix='clocks_') as name, quiet_world(Path(name)) as world:
        made = Simulation(world)
        for index in range(count):
            made.goal.publish(goal(50, 1))
            made.run(chance.uniform(0.05, 0.3))
            # Now and then several at once.
            happened = [EVENTS[index % len(EVENTS)](made, chance)]
            while chance.random() < 0.3:
                happened.append(chance.choice(EVENTS)(made, chance))
            what = f'the clock {", ".join(happened)}'
            try:
                made.arrive()
            except AssertionError as error:
                violations.append(f'{what}: {error}')
            violations += [f'{what}: published {one}' for one in made.infinite[:1]]
            made.infinite.clear()
            ended = [node for node in made.nodes if not node.running]
            if ended:
                violations += [f'{what}: ended: {node.stderr[-300:]!r}' for node in ended]
                break
        for node in made.nodes:
            node.signal(2)
            if node.exit() != 0 or unexpected(node.stderr):
                violations.append(f'{node.command}: {node.exit()}, {unexpected(node.stderr)!r}')
    return Outcome(count, violations)
