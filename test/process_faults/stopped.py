"""Each of the three nodes killed, or stopped and continued, while they drive: who stops, and when.

A robot, a bridge and a controller run in processes of their own and drive to a goal. One of them gets
SIGKILL, or SIGSTOP and a few seconds later SIGCONT. The others must stop within their timeouts. When it
is back, the robot must arrive.
"""

from __future__ import annotations

import random
import signal
import tempfile
import time
from pathlib import Path
from typing import Any

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.processes import Child, World
from support.ros_messages import goal

from process_faults.outcome import Outcome, spread, unexpected
from process_faults.worlds import moves, quiet_world, spin

TIMEOUT = 0.5
"""Timeout of commands and of odometry (s), the default of the nodes."""
LATE = 0.3
"""How much later than the timeout a zero may be seen here (s). Other processes use the cores, too."""
HOLD = 2 * TIMEOUT + LATE
"""Shortest time for which a node is gone (s)."""
ARGUMENTS = {
    'virtual_robot': ('--ros-args', '-p', 'command_interface:=wheels'),
    'wheel_bridge': (),
    'go_to_goal': ('--ros-args', '-p', 'kp:=6.0', '-p', 'kv:=2.0', '-p', 'linear.x.max_velocity:=1.0'),
}


class Team:
    """Three nodes in processes, and what is heard of them with its time (s)."""

    def __init__(self, world: World) -> None:
        self.world, self.harness = world, world.harness
        peer = self.harness.peer
        self.heard: dict[str, list[tuple[float, Any]]] = {}
        for topic, kind in (('odom', Odometry), ('cmd_vel', Twist), ('joint_command', JointState)):
            self._hear(topic, kind)
        self.statuses = self.harness.listen(GoalStatus, 'goal_status', latched=True)
        self.goal = peer.create_publisher(PoseStamped, 'goal_pose', 1)
        self.reset = peer.create_client(Trigger, 'reset_odometry')
        self.nodes: dict[str, Child] = {}
        for name in ARGUMENTS:
            self.start(name)
        self.harness.until(lambda: self.goal.get_subscription_count(), 'the controller is there')

    def _hear(self, topic: str, kind: Any) -> None:
        found = self.heard[topic] = []
        self.harness.peer.create_subscription(
            kind, topic, lambda message: found.append((when(message), message)), 1000
        )

    def start(self, name: str) -> None:
        self.nodes[name] = child = self.world.start(name, *ARGUMENTS[name])
        child.until_says('subscribed to')

    def drive(self, x: float) -> None:
        """Send a goal until the robot moves."""
        sent = 0.0

        def drives() -> bool:
            nonlocal sent
            if time.monotonic() > sent + 1.0:
                sent = time.monotonic()
                self.goal.publish(goal(x, 0))
            return self.drives()

        self.harness.until(drives, 'the robot drives')

    def drives(self) -> bool:
        return bool(self.heard['odom']) and moves(self.heard['odom'][-1][1])

    def clear(self) -> None:
        for one in self.heard.values():
            del one[:-1]

    def stopped_after(self, topic: str, since: float) -> float:
        """Return how long after a time the last moving message came (s); negative: there was none."""
        times = [at for at, message in self.heard[topic] if moves(message) and at > since]
        return times[-1] - since if times else -1.0


def when(message: Any) -> float:
    """Return the time of a message (s, monotonic): its stamp if it has that of its publication."""
    if not isinstance(message, Odometry):
        return time.monotonic()
    stamp = message.header.stamp
    return stamp.sec + stamp.nanosec / 1e9 - time.time() + time.monotonic()


MUST_STOP = {
    'virtual_robot': ('cmd_vel', 'joint_command'),
    'wheel_bridge': ('odom',),
    'go_to_goal': ('joint_command', 'odom'),
}
"""What must be still in time when a node is lost. Behind a bridge that is alive two timeouts add up."""


def disturb(team: Team, name: str, kill: bool, chance: random.Random) -> tuple[list[str], list[float]]:
    """Disturb a node while it drives; return what broke the promise, and how soon the others stopped."""
    what = f'{name}, {"SIGKILL" if kill else "SIGSTOP"}'
    team.drive(200.0)
    spin(team.harness, chance.uniform(0.0, 0.6))
    team.clear()
    node = team.nodes[name]
    node.signal(signal.SIGKILL if kill else signal.SIGSTOP)
    since = time.monotonic()
    spin(team.harness, HOLD + chance.uniform(0.3, 1.5))
    violations, delays = [], []
    for topic in MUST_STOP[name]:
        delay = team.stopped_after(topic, since)
        delays.append(delay)
        if delay > TIMEOUT + LATE:
            violations.append(f'{what}: {topic} was not zero for {delay:.2f} s')
        if moves(team.heard[topic][-1][1]):
            violations.append(f'{what}: {topic} is not zero at the end')
    if kill:
        node.exit()
        team.start(name)
        team.harness.until(lambda: team.goal.get_subscription_count() > 0, 'the controller is there')
    else:
        node.signal(signal.SIGCONT)
    if line := next((found for one in team.nodes.values() if (found := unexpected(one.stderr))), ''):
        violations.append(f'{what}: printed {line!r}')
    x = team.heard['odom'][-1][1].pose.pose.position.x
    try:
        team.drive(x + 0.3)
        arrive(team)
    except AssertionError as error:
        violations.append(f'{what}: afterwards the robot does not arrive: {error}')
    return violations, delays


def arrive(team: Team) -> None:
    """Wait until the robot has arrived at a goal near to where it is, and stands."""

    def arrived() -> bool:
        return bool(team.statuses) and team.statuses[-1].status == GoalStatus.STATUS_SUCCEEDED

    begun = time.monotonic()
    while not arrived():
        # The robot may have been elsewhere, or the goal lost with a controller.
        x = team.heard['odom'][-1][1].pose.pose.position.x
        team.goal.publish(goal(x + 0.2, 0))
        end = time.monotonic() + 4.0
        team.harness.until(lambda end=end: arrived() or time.monotonic() > end, 'arrival')
        assert time.monotonic() < begun + 20.0, f'not within 20 s: {team.statuses[-1:]}'
    team.harness.until(lambda: not team.drives(), 'the robot stands')


def run(count: int, seed: int = 0) -> Outcome:
    """Disturb so often, each node in turn."""
    chance = random.Random(seed)
    violations: list[str] = []
    delays: list[float] = []
    with tempfile.TemporaryDirectory(prefix='stopped_') as name, quiet_world(Path(name)) as world:
        team = Team(world)
        for index in range(count):
            node = list(ARGUMENTS)[index % len(ARGUMENTS)]
            found, measured = disturb(team, node, kill=index // len(ARGUMENTS) % 2 == 0, chance=chance)
            violations += found
            print(f'  {index + 1} of {count}: {found}', flush=True)
            delays += [one for one in measured if one >= 0.0]
    return Outcome(count, violations, f'the others are still after {spread(delays, "s")}')
