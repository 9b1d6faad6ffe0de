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

"""Nodes that run for long under faults: `python test/benchmark/soak.py [--minutes M] [--seed S]`.

Two teams of robot, bridge and controller drive to goals in processes of their own, and the page of
watch_run observes them. Every few seconds there is a fault. The steady team is stopped, flooded, sent
hostile messages, goals, parameters and commands of others, but never killed: its memory must stay. Nodes
of the other one also end by signals, and are started again. Nothing may end by itself, print a line that
is not expected, or grow by more than MEMORY. At the end both robots must reach a goal.

Prints what was violated, and the growth of the memory. Exit code 1: something was violated.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import signal
import sys
import tempfile
import time
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[1]))

from action_msgs.msg import GoalStatus
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger
from support import processes
from support.damaged_messages import damaged
from support.ros_messages import at_rest, goal, goals, joint_command, odometry, placement, twist

from diffdrive_jacobian.parameters.nodes import (
    GoToGoalParameters,
    VirtualRobotParameters,
    WheelBridgeParameters,
)
from diffdrive_jacobian.ros.rclpy_internals import RCLError

PERIOD = 3.0
"""Mean time between two faults (s)."""
PATIENCE = 120.0
"""Longest wait for a condition (s): the machine may be busy."""
FIRST = 60.0
"""Time after which the memory counts (s)."""
MEMORY = 5.0
"""Most that the memory of a process may grow from then on (MB)."""
ENDS = (*[signal.SIGKILL] * 3, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a node, half of them without a chance to stop the robot."""
TEAM = {
    'virtual_robot': {'command_interface': 'wheels'},
    'wheel_bridge': {},
    'go_to_goal': {'kp': 6.0, 'kv': 2.0, 'linear.x.max_velocity': 1.0},
}
"""The nodes of a team and their parameters."""
DECLARED = {
    'virtual_robot': VirtualRobotParameters,
    'wheel_bridge': WheelBridgeParameters,
    'go_to_goal': GoToGoalParameters,
}
VALUES = (0.0, 1e-3, 0.5, 1.0, -1.0, 1e9, math.nan, math.inf, 0, 3, 2**31, True, '', 'pose', 'a' * 257)
"""Values to which parameters are set, most of them invalid."""
INPUTS = {
    'cmd_vel': twist(0.2, 0.3),
    'joint_command': joint_command(1, 2),
    'initialpose': placement(3),
    'odom': odometry(3, 0, 0),
    'goal_pose': goal(3, 0),
    'goals': goals(goal(3, 0), goal(3, 0)),
}
"""A valid message for each input."""
EXPECTED = (
    *('subscribed to ', 'tf2_ros is not installed', 'page: ', 'whoever knows this address'),
    *('pose set to ', 'goal accepted', 'goal reached', 'goal canceled', 'goal refused', 'goal aborted'),
    *(' dropped: ', 'the wheels are stopped', 'no command on ', 'no valid odometry on '),
    *('odometry is received again', 'the goal waits for odometry', 'drives the robot by '),
    *('arrive faster than they are handled', 'are handled in time again'),
    *('their poses alternate', 'their commands alternate', 'is subscribed to ', 'publishes '),
    *('was an int assigned to a float field', 'spirals', 'cannot be reached', 'the gain', 'kp', 'kv'),
    'half a turn takes more than',
    # The code that rclpy generates for a type writes this itself.
    'sequence size exceeds remaining buffer',
)
"""What the processes may log."""


class Team:
    """A robot, a bridge and a controller in processes, with publishers and clients of their inputs."""

    def __init__(self, world, space):
        self.world, self.harness, self.space = world, world.harness, space
        self.nodes, self.ended, self.odometry = {}, [], None
        peer = self.harness.peer
        peer.create_subscription(Odometry, f'{space}/odom', self._on_odometry, 100)
        self.statuses = self.harness.listen(GoalStatus, f'{space}/goal_status', latched=True)
        self.publishers = {
            topic: peer.create_publisher(type(message), f'{space}/{topic}', 20)
            for topic, message in INPUTS.items()
        }
        self.cancel = peer.create_client(Trigger, f'{space}/cancel_goal')
        self.set = {
            name: peer.create_client(SetParameters, f'{space}/{name}/set_parameters') for name in TEAM
        }
        for name in TEAM:
            self.start(name)

    def _on_odometry(self, message):
        self.odometry = message

    def start(self, name):
        """Start a node, again if it has ended."""
        rules = [word for one, value in TEAM[name].items() for word in ('-p', f'{one}:={value}')]
        self.nodes[name] = self.world.start(name, '--ros-args', '-r', f'__ns:={self.space}', *rules)
        self.nodes[name].until_says('subscribed to')

    def reset(self):
        """Set all parameters that can change to their defaults, or to those of TEAM."""
        for name, declared in DECLARED.items():
            messages = [
                Parameter(one, value=TEAM[name].get(one, parameter.default)).to_parameter_msg()
                for one, parameter in declared().declared().items()
                if not parameter.read_only
            ]
            # Twice: a limit may be refused while another one is still changed.
            for _ in range(2):
                future = self.set[name].call_async(SetParameters.Request(parameters=messages))
                self.harness.until(future.done, f'parameters of {name}', PATIENCE)

    def arrive(self):
        """Send goals near to where the robot is until one is reached and the robot stands."""
        sent = -math.inf

        def arrived():
            nonlocal sent
            reached = any(one.status == GoalStatus.STATUS_SUCCEEDED for one in self.statuses)
            if not reached and time.monotonic() > sent + 8.0:
                # The robot may have been elsewhere, or the goal lost with a controller.
                sent, at = time.monotonic(), self.odometry.pose.pose.position
                self.statuses.clear()
                self.publishers['goal_pose'].publish(goal(at.x + 0.3, at.y + 0.4))
            return reached and at_rest(self.odometry)

        self.harness.until(arrived, f'{self.space}: a goal is reached', PATIENCE)


class Soak:
    """The teams, the page, and the faults."""

    def __init__(self, world, chance):
        self.chance, self.harness = chance, world.harness
        self.steady, self.other = Team(world, '/steady'), Team(world, '/other')
        self.page = world.start('watch_run', '--no-browser')
        self.page.until_says('page: ')
        self.faults = (
            *(self.stop, self.end, self.hostile, self.flood, self.parameter, self.join),
            *(self.goals, self.cancel, self.place, self.drive_by_hand),
        )

    @property
    def lasting(self):
        """The processes whose memory is measured."""
        return {**self.steady.nodes, 'watch_run': self.page}

    def spin(self, seconds):
        """Receive messages for a time (s)."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.harness.executor.spin_once(timeout_sec=0.005)

    # --- Faults

    def stop(self):
        team = self.chance.choice((self.steady, self.other))
        child = self.chance.choice([*team.nodes.values(), self.page])
        child.signal(signal.SIGSTOP)
        self.spin(self.chance.uniform(0.1, 2.5))
        child.signal(signal.SIGCONT)

    def end(self):
        name = self.chance.choice(list(TEAM))
        child = self.other.nodes[name]
        child.signal(self.chance.choice(ENDS))
        child.exit(PATIENCE)
        self.other.ended.append(child)
        self.other.start(name)

    def hostile(self):
        topic, message = self.chance.choice(list(INPUTS.items()))
        data = serialize_message(message)
        for _ in range(60):
            for _ in range(10):
                # It may be longer than a message of the type can be.
                with suppress(RCLError):
                    self.steady.publishers[topic].publish(damaged(self.chance, data))
            self.spin(0.005)

    def flood(self):
        topic, message = self.chance.choice(list(INPUTS.items()))
        data = serialize_message(message)
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            self.steady.publishers[topic].publish(data)

    def parameter(self):
        name = self.chance.choice(list(DECLARED))
        parameter = self.chance.choice(list(DECLARED[name]().declared()))
        message = Parameter(parameter, value=self.chance.choice(VALUES)).to_parameter_msg()
        client = self.steady.set[name]
        client.remove_pending_request(client.call_async(SetParameters.Request(parameters=[message])))
        self.spin(1.0)
        self.steady.reset()

    def join(self):
        peer = self.harness.peer
        subscription = peer.create_subscription(Odometry, '/steady/odom', lambda _: None, 10)
        self.spin(self.chance.uniform(0.1, 1.0))
        peer.destroy_subscription(subscription)

    def goals(self):
        for team in (self.steady, self.other):
            team.publishers['goal_pose'].publish(
                goal(self.chance.uniform(-3, 3), self.chance.uniform(-3, 3))
            )

    def cancel(self):
        client = self.steady.cancel
        client.remove_pending_request(client.call_async(Trigger.Request()))

    def place(self):
        self.steady.publishers['initialpose'].publish(placement(self.chance.uniform(-2, 2)))

    def drive_by_hand(self):
        end = time.monotonic() + self.chance.uniform(0.1, 1.0)
        while time.monotonic() < end:
            self.steady.publishers['cmd_vel'].publish(INPUTS['cmd_vel'])
            self.spin(0.05)


def resident(pid):
    """Return the resident memory of a process (MB)."""
    return int(Path(f'/proc/{pid}/status').read_text().split('VmRSS:')[1].split()[0]) / 1024.0


def unexpected_lines(child):
    """Return the lines that are not expected of a process."""
    lines = [line for line in (child.stderr + child.stdout).splitlines() if line.strip()]
    return [one for one in lines if not any(map(one.__contains__, EXPECTED)) or '[ERROR]' in one]


def run(minutes, chance, world):
    """Drive for so long; return the number of faults, violations, and growth of the memory (MB)."""
    violations, faults, first, most = [], 0, {}, {}
    soak = Soak(world, chance)
    begun = time.monotonic()
    while (elapsed := time.monotonic() - begun) < 60.0 * minutes:
        fault = chance.choice(soak.faults)
        try:
            fault()
        except AssertionError as error:
            violations.append(f'{fault.__name__}: {error}')
        faults += 1
        soak.spin(chance.uniform(0.5, 1.5) * PERIOD)
        ended = [child.command for child in soak.lasting.values() if not child.running]
        if ended:
            violations.append(f'{fault.__name__}: ended: {ended}')
            break
        memory = {name: resident(child._process.pid) for name, child in soak.lasting.items()}
        if elapsed <= FIRST or not first:
            first, most = memory, memory
        most = {name: max(most[name], now) for name, now in memory.items()}
        if faults % 20 == 0:
            print(f'  {elapsed:.0f} s, {faults} faults, {memory}', file=sys.stderr, flush=True)
    grown = {name: most[name] - first[name] for name in first}
    violations += [f'{name}: memory +{by:.1f} MB' for name, by in grown.items() if by > MEMORY]
    for team in (soak.steady, soak.other):
        try:
            team.reset()
            team.arrive()
        except AssertionError as error:
            violations.append(f'at the end: {error}')
    for child in (*soak.lasting.values(), *soak.other.nodes.values(), *soak.other.ended):
        violations += [f'{child.command}: {line}' for line in unexpected_lines(child)]
    return faults, violations, grown


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--minutes', type=float, default=12.0, help='how long (default: 12)')
    parser.add_argument('--seed', type=int, default=0, help='of the faults (default: 0)')
    options = parser.parse_args()
    os.nice(10)
    with (
        tempfile.TemporaryDirectory(prefix='soak_') as folder,
        mock.patch.object(processes, 'LIMIT', 60.0 * options.minutes + 600.0),
        mock.patch.object(processes, 'PATIENCE', PATIENCE),
        # What the processes printed.
        redirect_stdout(StringIO()),
        processes.open_world(Path(folder)) as world,
    ):
        faults, violations, grown = run(options.minutes, random.Random(options.seed), world)
    grew = ', '.join(f'{name} {by:+.1f}' for name, by in grown.items())
    print(f'{faults} faults in {options.minutes:g} minutes, memory (MB): {grew}')
    print(f'{len(violations)} violations', *violations, sep='\n')
    return 1 if violations else 0


if __name__ == '__main__':
    sys.exit(main())
