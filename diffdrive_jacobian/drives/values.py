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

"""A drive without ROS: robot, wheel bridge and controller as values, in simulated time.

Time goes from one event to the next: the robot publishes, or an input stays away for too long. What is
published is received at the same time, in the order in which the nodes receive it in lockstep. So the
robot drives as there, to the last bit. Messages are the values of `messages.codecs`. Nobody else is
there, so nothing gets lost, arrives late or comes from somewhere else.
"""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.run import run_of
from diffdrive_jacobian.control import Path
from diffdrive_jacobian.control.path import PathProgress
from diffdrive_jacobian.drives.outcome import (
    SETTLING,
    STANDING,
    STOP_PATIENCE,
    Outcome,
    Request,
)
from diffdrive_jacobian.drives.read_values import as_read, read_state
from diffdrive_jacobian.drives.recorded import ValueRecorder
from diffdrive_jacobian.drives.value_nodes import Bridge, DrivenRobot, Driver
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.messages.codecs import Changes, Command, Motion, Route
from diffdrive_jacobian.messages.conversion import MessageError, from_twist
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.messages.names import full_name
from diffdrive_jacobian.nodes.steering import STANDSTILL
from diffdrive_jacobian.parameters.arguments import check_names, given_parameters
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.parameters.wheel_bridge import WheelBridgeParameters
from diffdrive_jacobian.parameters.wheels import SAME_WHEELS, different_wheels
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds

if TYPE_CHECKING:
    from diffdrive_jacobian.recording.recording import Recording

START = NANOSECONDS
"""Time at the start, as in lockstep (ns)."""
NODES = ('virtual_robot', 'wheel_bridge', 'go_to_goal')
"""Names of the nodes that are replaced, without namespace."""
OF_MESSAGES = {'enable_stamped_cmd_vel', 'joint_command_type'}
"""Parameters that would have no effect."""
LONGEST_STEP = NANOSECONDS
"""Largest advance of the time, as in lockstep (ns)."""
LOG = logging.getLogger(__name__)


class Client:
    """What the goal client does: it sends the goals with the first odometry, and follows them."""

    def __init__(self, goals: NDArray[np.float64] | Path, relative: bool, world: World) -> None:
        """Start before the goals are sent."""
        self._names = world.robot.parameters.wheel_names
        self.path = PathProgress(goals) if isinstance(goals, Path) else None
        self.goals = goals.poses if isinstance(goals, Path) else goals
        self.robot: Motion | None = None
        """The last odometry."""
        self.speeds = (0.0, 0.0)
        """Speeds of the right and the left wheel, as they were reported last (rad/s)."""
        self.state = GoalState.UNKNOWN
        self._relative, self._publish = relative, world.publish
        self._sent = False
        self._begun = self._latest = 0

    def observe(self, topic: str, value: Any) -> None:
        """Take the value of a message."""
        if topic == 'odom':
            # What a receiver drops is dropped here, too.
            with suppress(MessageError):
                self._follow(as_read(topic, value))
        elif topic == 'joint_states':
            self.speeds = value.speeds(self._names)
        elif topic == 'goal_status':
            self.state = GoalState(value.status)

    def _follow(self, motion: Motion) -> None:
        self.robot, stamp = motion, motion.stamp
        if not self._sent:
            self._sent = True
            self._send(motion, stamp)
        if self.path is not None and self.state is GoalState.EXECUTING:
            self.path.moved(np.array(motion.pose))
            self._begun, self._latest = self._begun or stamp, stamp

    def _send(self, motion: Motion, now: int) -> None:
        times = None if self.path is None else self.path.path.times
        if self._relative:
            self.goals = se2.compose(motion.pose, self.goals)
            if self.path is not None:
                self.path = PathProgress(Path(self.goals, times))
        poses = tuple((x, y, theta) for x, y, theta in self.goals.tolist())
        seconds = None if times is None else tuple(times.tolist())
        topic = 'goals' if self.path is None else 'path'
        self._publish(topic, Route(divmod(now, NANOSECONDS), '', poses, seconds))

    def withdraw(self) -> None:
        """Send no goals that wait for odometry."""
        self._sent = True

    def distance(self, index: int, driver: Driver) -> float:
        """Return the distance to a goal; of a path what remains of it (m)."""
        if self.robot is None:
            return math.inf
        if self.path is not None and self.state is not GoalState.SUCCEEDED:
            return self.path.remaining
        index = -1 if self.path is not None else index
        return float(driver.arrival.distance(*self.robot.pose, *self.goals[index, :2]))

    @property
    def late(self) -> float:
        """How much later than by its times the end of a trajectory was reached (s), or NaN."""
        if self.path is None or self.path.path.times is None or self.state is not GoalState.SUCCEEDED:
            return math.nan
        return max((self._latest - self._begun) / NANOSECONDS - self.path.path.duration, 0.0)


class World:
    """Robot, bridge and controller, and their time."""

    def __init__(
        self,
        parameters: Mapping[str, Any],
        robot_parameters: Mapping[str, Any],
        ros_arguments: Sequence[str],
        start: int,
        laws: Mapping[str, Any] = MappingProxyType({}),
        namespace: str = '/',
    ) -> None:
        """Start at a time (ns), with parameters of controller and robot, and those of ROS arguments.

        `laws` are those of a `Request`. The nodes would be in the namespace.

        Raises:
            UserError: The parameters or the ROS arguments are invalid.
        """
        self.now = self._start = start
        """The time (ns)."""
        self.observers: list[Callable[[str, Any], None]] = []
        """Each receives topic and value of every message, before the nodes do, when time `now` is."""
        self._queue: list[tuple[str, Any]] = []
        self.namespace = namespace
        self.nodes = {name: full_name(namespace, name) for name in NODES}
        """Full names of the nodes, by their names."""
        by_node = given_parameters(ros_arguments, self.nodes.values())
        given = {name: by_node[node] for name, node in self.nodes.items()}
        interface = {'command_interface': 'wheels'}
        try:
            of_robot = VirtualRobotParameters().at_start(
                {**given['virtual_robot'], **robot_parameters, **interface}
            )
            of_bridge = WheelBridgeParameters().at_start(given['wheel_bridge'])
            defaults = GoToGoalParameters().with_laws(**laws)
            of_driver = defaults.at_start({**given['go_to_goal'], **parameters})
        except ParameterError as error:
            raise UserError(str(error)) from None
        parts = of_robot, of_bridge, of_driver
        check_names(ros_arguments, {name for node in parts for name in node.declared()})
        for node in parts:
            for name in OF_MESSAGES & node.declared().keys():
                if node.by_name()[name] != node.declared()[name].default:
                    raise UserError(f'{name} chooses a type of messages, and needs rclpy')
        wheels = of_bridge.dimensions, 'virtual_robot', of_robot.dimensions
        if found := different_wheels(*wheels):
            LOG.warning('%s; %s', found, SAME_WHEELS)
        self._frame = of_robot.odom_frame_id
        self.robot = DrivenRobot(of_robot, self.now, self.publish)
        self.bridge = Bridge(of_bridge, self.publish)
        self.driver = Driver(of_driver, self.publish)
        self._receivers: dict[str, Callable[[Any], None]] = {
            'odom': lambda motion: self.driver.steer(read_state(motion, self._frame), self.now),
            'cmd_vel': self._on_command,
            'joint_command': lambda wheels: self.robot.follow(wheels, self.now),
            'goals': lambda route: self.driver.accept(route, False, self.now),
            'path': lambda route: self.driver.accept(route, True, self.now),
            'initialpose': lambda place: self.robot.place(as_read('initialpose', place), self.now),
        }

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Values of the parameters by the full names of the nodes."""
        parts = self.robot, self.bridge, self.driver
        values = (part.parameters.by_name() for part in parts)
        return dict(zip(self.nodes.values(), values, strict=True))

    @property
    def seconds(self) -> float:
        """Time since the start (s)."""
        return (self.now - self._start) / NANOSECONDS

    def advance(self, pace: Callable[[float], None] = lambda _: None) -> None:
        """Advance to the next event, and do what is due then.

        Args:
            pace: Called before with the time since the start (s).
        """
        longest = self.now + LONGEST_STEP
        bridge, driver = self.bridge, self.driver
        times = self.robot.next, bridge.next, bridge.silence.at, driver.silence.at, longest
        self.now = now = int(min(times))
        pace(self.seconds)
        if self.robot.next <= now:
            self.robot.publish(now)
            self.settle()
        if bridge.next <= now:
            bridge.approach(now)
            self.settle()
        if bridge.silence.expires(now):
            bridge.stop_in_silence(now)
            self.settle()
        if driver.silence.expires(now):
            driver.wait(now)
            self.settle()

    def settle(self) -> None:
        """Receive what was published, and what is published in answer."""
        for topic, value in self._queue:
            for observe in self.observers:
                observe(topic, value)
            receive = self._receivers.get(topic)
            if receive is None:
                continue
            try:
                receive(value)
            except MessageError as error:
                LOG.warning('%s dropped: %s', topic, error)
        self._queue.clear()

    def publish(self, topic: str, value: Any) -> None:
        """Publish a message now. It is received when the world settles."""
        self._queue.append((topic, value))

    def set_parameter(self, node: str, name: str, value: Any) -> None:
        """Set a parameter of the controller or of the robot, of those that `live.settings` offers.

        Raises:
            ParameterError: The value is invalid.
        """
        changed = self.driver if node == 'go_to_goal' else self.robot
        before = changed.parameters.by_name()
        parameters = changed.parameters.changed({name: value})
        # A law may have gains that were no parameters before. NaN, which is none, differs from itself.
        after = parameters.by_name().items()
        new = {one: value for one, value in after if repr(value) != repr(before.get(one))}
        self.publish('parameter_events', Changes(self.nodes[node], new, self.now))
        self.settle()
        if isinstance(parameters, GoToGoalParameters):
            self.driver.change(parameters)
        elif isinstance(parameters, VirtualRobotParameters):
            self.robot.change(parameters, self.now)

    def _on_command(self, command: Command) -> None:
        v, omega = command.twist
        self.bridge.follow(Command(from_twist(v, 0.0, 0.0, 0.0, 0.0, omega)), self.now)


def drive(request: Request, *, lockstep: bool, ros_arguments: Sequence[str] = ()) -> Outcome:
    """Drive without nodes.

    Args:
        request: What is asked for.
        lockstep: Whether simulated time does not wait for real time.
        ros_arguments: Parameters, as `parameters.arguments` takes them.

    Raises:
        UserError: The parameters or the ROS arguments are invalid.
    """
    signals, progress = request.signals, request.progress
    start = START if lockstep else time.time_ns()
    world = World(request.parameters, request.robot_parameters, ros_arguments, start, request.laws)
    pace = (lambda _: None) if lockstep else in_real_time()
    parameters, kept = world.parameters, list[tuple[int, str, Any]]()
    if request.recording is not None:
        record(world, request.recording)

    def keep(topic: str, value: Any) -> None:
        with suppress(MessageError):
            kept.append((world.now, topic, as_read(topic, value)))

    if request.keep:
        world.observers.append(keep)
    client, driver, robot = Client(request.goals, request.relative, world), world.driver, world.robot
    world.observers.append(client.observe)
    if progress is not None:
        progress.nodes_created([*world.nodes.values()])

    def turns(longest: float, handled: int = 0) -> Iterator[None]:
        """As `NodeRunner.turns`."""
        deadline = world.seconds + longest
        world.settle()
        while True:
            yield
            if signals.count > handled or world.seconds > deadline:
                return
            world.advance(pace)

    index = 0
    for _ in turns(request.timeout):
        if client.state.ended:
            break
        if driver.pursuit is not None:
            index = min(driver.pursuit.index, len(client.goals) - 1)
        if progress is not None and client.robot is not None:
            progress.driving(world.seconds, index, client.distance(index, driver), client.speeds)
    seconds, state = world.seconds, client.state
    client.withdraw()
    driver.cancel(world.now)
    settled = world.now + nanoseconds(SETTLING)
    for _ in turns(STOP_PATIENCE + 1.0 / robot.parameters.publish_rate, signals.count):
        last = client.robot
        if last is not None and last.stamp >= settled and last.twist == STANDSTILL:
            break
    arrival, goal = driver.arrival, client.goals[-1, :2].tolist()
    true_distance = math.nan
    if robot.parameters.drift() is not None:
        true_distance = float(arrival.distance(*robot.true_pose(world.now).tolist(), *goal))
    at = client.robot
    return Outcome(
        status=int(state),
        interrupted=signals.count > 0,
        pose=None if at is None else np.array(at.pose),
        moving=at is not None and max(map(abs, at.twist)) > STANDING,
        distance=client.distance(len(client.goals) - 1, driver),
        true_distance=true_distance,
        across=math.nan if client.path is None else client.path.greatest,
        late=client.late,
        tolerance=arrival.xy_tolerance,
        offset=arrival.offset,
        seconds=seconds,
        kept=run_of('drive', kept, parameters) if request.keep else None,
    )


def record(world: World, recording: Recording, numbers: Iterator[int] | None = None) -> None:
    """Record what is published from now on. Several worlds of one recording share `numbers`."""
    parameters, numbers = world.parameters, numbers or itertools.count(1)
    recorder = ValueRecorder(recording, parameters, world.namespace, numbers)
    world.observers.append(lambda topic, value: recorder.add(world.now, topic, value))


def in_real_time() -> Callable[[float], None]:
    """Return a function that waits until so much time (s) has passed since this call."""
    begin = time.monotonic()
    return lambda seconds: time.sleep(max(0.0, begin + seconds - time.monotonic()))
