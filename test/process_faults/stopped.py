"""Each of the three nodes killed, or stopped and continued, while they drive: who stops, and when.

A robot, a bridge and a controller run in processes of their own and drive to a goal. One of them gets
SIGKILL, or SIGSTOP and a few seconds later SIGCONT. The others must stop within their timeouts. When it
is back, the robot must arrive.
"""

from __future__ import annotations

import random
import signal
import time

from support.ros_messages import goal

from process_faults.outcome import Outcome, spread, unexpected
from process_faults.worlds import Team, moves, quiet_world, spin

TIMEOUT = 0.5
"""Timeout of commands and of odometry (s), the default of the nodes."""
LATE = 0.3
"""How much later than the timeout a zero may be seen here (s). Other processes use the cores, too."""
HOLD = 2 * TIMEOUT + LATE
"""Shortest time for which a node is gone (s)."""
MUST_STOP = {
    'virtual_robot': ('cmd_vel', 'joint_command'),
    'wheel_bridge': ('odom',),
    'go_to_goal': ('joint_command', 'odom'),
}
"""What must be still in time when a node is lost. Behind a bridge that is alive two timeouts add up."""


def disturb(team, name, kill, chance):
    """Disturb a node while it drives; return what broke the promise, and how soon the others stopped."""
    sent = 0.0
    while not team.drives():
        if time.monotonic() > sent + 1.0:
            sent = time.monotonic()
            team.goal.publish(goal(200, 0))
        spin(team.harness, 0.01)
    spin(team.harness, chance.uniform(0.0, 0.6))
    node, violations, delays = team.nodes[name], [], []
    node.signal(signal.SIGKILL if kill else signal.SIGSTOP)
    since = time.monotonic()
    spin(team.harness, HOLD + chance.uniform(0.3, 1.5))
    for topic in MUST_STOP[name]:
        delays.append(team.moved[topic] - since)
        if delays[-1] > TIMEOUT + LATE:
            violations.append(f'{topic} was not zero for {delays[-1]:.2f} s')
        if moves(team.last[topic]):
            violations.append(f'{topic} is not zero at the end')
    if kill:
        node.exit()
        team.start(name)
    else:
        node.signal(signal.SIGCONT)
    printed = [line for one in team.nodes.values() if (line := unexpected(one.stderr))]
    violations += [f'printed {line!r}' for line in printed[:1]]
    if not team.arrives():
        violations.append('afterwards the robot does not arrive')
    what = f'{name}, {"SIGKILL" if kill else "SIGSTOP"}'
    return [f'{what}: {one}' for one in violations], delays


def run(count, seed=0):
    """Disturb so often, each node in turn."""
    chance = random.Random(seed)
    violations, delays = [], []
    with quiet_world() as world:
        team = Team(world)
        for index in range(count):
            name = list(MUST_STOP)[index % len(MUST_STOP)]
            found, measured = disturb(team, name, index // len(MUST_STOP) % 2 == 0, chance)
            violations += found
            delays += [one for one in measured if one >= 0.0]
            print(f'  {index + 1} of {count}: {found}', flush=True)
    return Outcome(count, violations, f'the others are still after {spread(delays, "s")}')
