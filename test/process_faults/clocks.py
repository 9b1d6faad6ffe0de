"""Simulated clocks that start at 0, jump, go back, stand still, disagree, and are not plausible.

A robot, a bridge and a controller in processes follow a /clock that runs ten times as fast as time,
until something happens to it. Whatever it is: they stay alive, what they publish is finite, and once the
clock runs evenly again, the robot arrives.
"""

from __future__ import annotations

import random
import time

from rosgraph_msgs.msg import Clock
from support.ros_messages import goal

from process_faults.outcome import Outcome, unexpected
from process_faults.worlds import Team, quiet_world, spin

STEP = 0.02
"""Time between two messages on /clock (s)."""
FACTOR = 10.0
"""Speed of the clock."""
SETTLED = 0.05
"""Time of the machine between two steps of an event (s)."""
MOST = 2**31 - 1 - 1e-9
"""Largest time of a message (s)."""


class Simulation:
    """A team that follows a clock."""

    def __init__(self, world):
        self.harness = world.harness
        self.clocks = [self.harness.peer.create_publisher(Clock, '/clock', 10) for _ in range(2)]
        self.team = Team(world, use_sim_time='true')
        for publisher in self.clocks:
            self.harness.until(publisher.get_subscription_count, 'the nodes are there')
        self.now = self._next = 0.0

    def publish(self, seconds, publisher=0):
        """Publish a time, as a message can hold it."""
        nanoseconds = round(max(-(2.0**31), min(seconds, MOST)) * 1e9)
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(nanoseconds, 1_000_000_000)
        self.clocks[publisher].publish(message)

    def run(self, seconds):
        """Let the clock run evenly for so long (s, of the machine)."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.tick()

    def tick(self):
        """Publish the next time if it is due, and receive."""
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + STEP / FACTOR
            self.now += STEP
            self.publish(self.now)
        self.harness.executor.spin_once(timeout_sec=0.001)


# --- What happens to a clock


def jump(made, chance):
    seconds = chance.choice((-1, 1)) * 10.0 ** chance.uniform(-3, 5)
    made.now = max(0.0, made.now + seconds)
    return f'jumps by {seconds:.3g} s'


def restart(made, chance):
    made.now = 0.0
    made.publish(0.0)
    return 'begins at 0 again'


def pause(made, chance):
    for _ in range(chance.randrange(10, 150)):
        made.publish(made.now)
        spin(made.harness, 0.01)
    return 'stands still'


def silence(made, chance):
    spin(made.harness, chance.uniform(0.1, 1.5))
    return 'is silent'


def disagree(made, chance):
    ahead = chance.choice((-100.0, -0.5, -0.01, 0.01, 0.5, 100.0, 1e6))
    for _ in range(chance.randrange(3, 40)):
        made.publish(made.now)
        made.publish(made.now + ahead, 1)
        made.run(SETTLED / 5)
    return f'two of them disagree by {ahead:g} s'


def implausible(made, chance):
    times = [chance.choice((-1.0, -(2.0**31), MOST, 1e-9, 0.0, 2.0**30)) for _ in range(5)]
    for one in times:
        made.publish(one)
        spin(made.harness, SETTLED)
    return f'has the times {times}'


def fast(made, chance):
    for _ in range(200):
        made.now += chance.uniform(0.0, 1.0)
        made.publish(made.now)
    return 'runs a thousand times as fast'


EVENTS = (jump, restart, pause, silence, disagree, implausible, fast)


def disturb(made, event, chance):
    """Let an event happen to the clock, and now and then several at once; return what broke it."""
    made.team.goal.publish(goal(50, 1))
    made.run(chance.uniform(0.05, 0.3))
    happened = [event(made, chance)]
    while chance.random() < 0.3:
        happened.append(chance.choice(EVENTS)(made, chance))
    violations = []
    if not made.team.arrives(made.tick):
        violations.append('the robot does not arrive')
    violations += [f'published {one}' for one in made.team.infinite[:1]]
    made.team.infinite.clear()
    ended = [node for node in made.team.nodes.values() if not node.running]
    violations += [f'ended: {node.command}: {node.stderr[-300:]!r}' for node in ended]
    return [f'the clock {", ".join(happened)}: {one}' for one in violations]


def run(count, seed=0):
    """Let so many things happen to the clock."""
    chance = random.Random(seed)
    violations = []
    with quiet_world() as world:
        made = Simulation(world)
        nodes = made.team.nodes.values()
        for index in range(count):
            violations += disturb(made, EVENTS[index % len(EVENTS)], chance)
            if not all(node.running for node in nodes):
                break
        for node in nodes:
            node.signal(2)
            if node.exit() != 0 or unexpected(node.stderr):
                violations.append(f'{node.command}: {node.exit()}, {unexpected(node.stderr)!r}')
    return Outcome(count, violations)
