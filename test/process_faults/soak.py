"""Hours of driving with a fault every few seconds.

Two teams of robot, bridge and controller drive to goals in processes of their own, and the page of
watch_run observes them. The steady team is stopped, flooded, sent hostile messages, goals, parameters
and commands of others, but never killed: its memory must stay. The other one is also killed.
"""

from __future__ import annotations

import random
import signal
import sys
import time
from contextlib import suppress

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import Goals, Odometry
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.ros_messages import goal, placement

from diffdrive_jacobian.ros.rclpy_internals import RCLError
from process_faults.fuzzed_parameters import DECLARED, value_of
from process_faults.hostile import VALID, damaged, resident
from process_faults.outcome import Outcome
from process_faults.worlds import TEAM, Team, quiet_world, spin

PERIOD = 3.0
"""Mean time between two faults (s)."""
FIRST = 60.0
"""Time after which the memory counts (s)."""
MEMORY = 5.0
"""Most that the memory of a process may grow from then on (MB)."""
ENDS = (*[signal.SIGKILL] * 3, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a node, half of them without a chance to stop the robot."""
INPUTS = (
    ('cmd_vel', Twist),
    ('joint_command', JointState),
    ('initialpose', PoseWithCovarianceStamped),
    ('odom', Odometry),
    ('goal_pose', PoseStamped),
    ('goals', Goals),
)
EXPECTED = (
    *('subscribed to ', 'tf2_ros is not installed', 'page: ', 'whoever knows this address'),
    *('pose set to ', 'goal accepted', 'goal reached', 'goal canceled', 'goal refused', 'goal aborted'),
    *(' dropped: ', 'the wheels are stopped', 'no command on ', 'no valid odometry on '),
    *('odometry is received again', 'the goal waits for odometry', 'drives the robot by '),
    *('arrive faster than they are handled', 'their poses alternate', 'their commands alternate'),
    *('is subscribed to ', 'publishes '),
    *('was an int assigned to a float field', 'spirals', 'cannot be reached', 'the gain', 'kp', 'kv'),
    'half a turn takes more than',
    # The code that rclpy generates for a type writes this itself.
    'sequence size exceeds remaining buffer',
)
"""What the processes may log."""


class Attacked(Team):
    """A team, and publishers and clients of all of its inputs."""

    def __init__(self, world, space):
        super().__init__(world, space)
        peer = self.harness.peer
        self.ended = []
        self.publishers = {
            topic: peer.create_publisher(kind, f'{space}/{topic}', 20) for topic, kind in INPUTS
        }
        self.cancel = peer.create_client(Trigger, f'{space}/cancel_goal')
        self.set = {
            name: peer.create_client(SetParameters, f'{space}/{name}/set_parameters') for name in TEAM
        }

    def reset(self):
        """Set all parameters that can change to their defaults, or to those of the command line."""
        for name, parameters in DECLARED.items():
            messages = [
                Parameter(one, value=TEAM[name].get(one, default)).to_parameter_msg()
                for one, (specification, default) in parameters.items()
                if not specification.read_only
            ]
            # Twice: a limit may be refused while another one is still changed.
            for _ in range(2):
                future = self.set[name].call_async(SetParameters.Request(parameters=messages))
                self.harness.until(future.done, f'parameters of {name}')


class Soak:
    """Two teams, and what happens to them."""

    def __init__(self, world, chance):
        self.world, self.chance, self.harness = world, chance, world.harness
        self.steady, self.other = Attacked(world, '/steady'), Attacked(world, '/other')
        self.page = world.start('watch_run', '--no-browser')
        self.page.until_says('page: ')
        self.faults = {
            one.__name__.strip('_'): one
            for one in (
                *(self._stop, self._end, self._hostile, self._flood, self._parameter, self._join),
                *(self._goals, self._cancel, self._place, self._drive_by_hand),
            )
        }

    @property
    def lasting(self):
        """The processes whose memory is measured."""
        return {**self.steady.nodes, 'watch_run': self.page}

    # --- Faults

    def _stop(self):
        team = self.chance.choice((self.steady, self.other))
        child = self.chance.choice([*team.nodes.values(), self.page])
        child.signal(signal.SIGSTOP)
        spin(self.harness, self.chance.uniform(0.1, 2.5))
        child.signal(signal.SIGCONT)

    def _end(self):
        name = self.chance.choice(list(TEAM))
        child = self.other.nodes[name]
        child.signal(self.chance.choice(ENDS))
        child.exit()
        self.other.ended.append(child)
        self.other.start(name)

    def _hostile(self):
        topic, kind = self.chance.choice(INPUTS)
        data = serialize_message(VALID[kind])
        for _ in range(60):
            for _ in range(10):
                # It may be longer than a message of the type can be.
                with suppress(RCLError):
                    self.steady.publishers[topic].publish(damaged(self.chance, data))
            spin(self.harness, 0.005)

    def _flood(self):
        topic, kind = self.chance.choice(INPUTS)
        data = serialize_message(VALID[kind])
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            self.steady.publishers[topic].publish(data)

    def _parameter(self):
        name = self.chance.choice(list(DECLARED))
        parameter = self.chance.choice(list(DECLARED[name]))
        value = value_of(self.chance, *DECLARED[name][parameter])
        message = ParameterMessage(name=parameter, value=value)
        client = self.steady.set[name]
        client.remove_pending_request(client.call_async(SetParameters.Request(parameters=[message])))
        spin(self.harness, 1.0)
        self.steady.reset()

    def _goals(self):
        for team in (self.steady, self.other):
            team.goal.publish(goal(self.chance.uniform(-3, 3), self.chance.uniform(-3, 3)))

    def _cancel(self):
        client = self.steady.cancel
        client.remove_pending_request(client.call_async(Trigger.Request()))

    def _place(self):
        self.steady.publishers['initialpose'].publish(placement(self.chance.uniform(-2, 2)))

    def _drive_by_hand(self):
        end = time.monotonic() + self.chance.uniform(0.1, 1.0)
        while time.monotonic() < end:
            self.steady.publishers['cmd_vel'].publish(VALID[Twist])
            spin(self.harness, 0.05)

    def _join(self):
        peer = self.harness.peer
        subscription = peer.create_subscription(Odometry, '/steady/odom', lambda _: None, 10)
        spin(self.harness, self.chance.uniform(0.1, 1.0))
        peer.destroy_subscription(subscription)


def unexpected_lines(child):
    """Return the lines that are not expected of a process."""
    lines = [line for line in (child.stderr + child.stdout).splitlines() if line.strip()]
    return [one for one in lines if not any(map(one.__contains__, EXPECTED)) or '[ERROR]' in one]


def run(count, seed=0):
    """Drive for so many minutes."""
    chance = random.Random(seed)
    violations, faults, first, most = [], 0, {}, {}
    with quiet_world(life=60.0 * count + 600.0) as world:
        made = Soak(world, chance)
        begun = time.monotonic()
        while (elapsed := time.monotonic() - begun) < 60.0 * count:
            fault = chance.choice(list(made.faults))
            try:
                made.faults[fault]()
            except AssertionError as error:
                violations.append(f'{fault}: {error}')
            faults += 1
            spin(made.harness, chance.uniform(0.5, 1.5) * PERIOD)
            ended = [child.command for child in made.lasting.values() if not child.running]
            if ended:
                violations.append(f'{fault}: ended: {ended}')
                break
            memory = {name: resident(child._process.pid) for name, child in made.lasting.items()}
            if elapsed <= FIRST or not first:
                first = memory
            most = {name: max(most.get(name, 0.0), now) for name, now in memory.items()}
            if faults % 20 == 0:
                print(f'  {elapsed:.0f} s, {faults} faults, {memory}', file=sys.stderr, flush=True)
        grown = {name: most[name] - first[name] for name in first}
        violations += [f'{name}: memory +{by:.1f} MB' for name, by in grown.items() if by > MEMORY]
        for team in (made.steady, made.other):
            try:
                team.reset()
                assert team.arrives(), 'no goal is reached'
            except AssertionError as error:
                violations.append(f'{team.nodes["go_to_goal"].command}: at the end: {error}')
        for child in (*made.lasting.values(), *made.other.nodes.values(), *made.other.ended):
            violations += [f'{child.command}: {line}' for line in unexpected_lines(child)]
    grew = ', '.join(f'{name} {by:+.1f}' for name, by in grown.items())
    return Outcome(faults, violations, f'{count} minutes, memory after the first (MB): {grew}')
