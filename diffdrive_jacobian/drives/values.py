"""A drive without ROS: robot, wheel bridge and controller as values, in simulated time.

Time goes from one event to the next: the robot publishes, or an input stays away for too long. What is
published is received at the same time, in the order in which the nodes receive it in lockstep. So the
robot drives as there, to the last bit. Messages are the values of `messages.codecs`. Nobody else is
there, so nothing gets lost, arrives late or comes from somewhere else.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any

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
from diffdrive_jacobian.drives.recorded import ValueRecorder
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.messages.codecs import (
    GOALS,
    ODOMETRY,
    ODOMETRY_STATE,
    PATH,
    Command,
    Motion,
    Place,
    Route,
    State,
    Status,
    Wheels,
)
from diffdrive_jacobian.messages.conversion import (
    MessageError,
    command_time,
    from_pose,
    from_twist,
    plausible_twist,
)
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes.odometry_rate import OdometryRate
from diffdrive_jacobian.nodes.steering import STANDSTILL, Goal, Pursuit, Steering
from diffdrive_jacobian.parameters.arguments import check_names, given_parameters
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.parameters.wheel_bridge import WheelBridgeParameters
from diffdrive_jacobian.parameters.wheels import SAME_WHEELS, different_wheels
from diffdrive_jacobian.simulation.actuators import ramp
from diffdrive_jacobian.simulation.robot import Robot
from diffdrive_jacobian.simulation.speeds import Profile
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds

START = NANOSECONDS
"""Time at the start, as in lockstep (ns)."""
NODES = ('/virtual_robot', '/wheel_bridge', '/go_to_goal')
OF_MESSAGES = {'enable_stamped_cmd_vel', 'joint_command_type'}
"""Parameters that would have no effect."""
LONGEST_STEP = NANOSECONDS
"""Largest advance of the time, as in lockstep (ns)."""
Publish = Callable[[str, Any], None]
"""Receives the topic and the value of a message."""
LOG = logging.getLogger(__name__)


class Deadline:
    """The time at which an input has stayed away for too long, as `ros.watchdog.Watchdog` has it."""

    def __init__(self, timeout: float) -> None:
        """Wait for nothing until it is fed. The timeout is in s; 0: it never expires."""
        self.at = math.inf
        """When to look (ns); infinity: nothing is waited for."""
        self._timeout = nanoseconds(timeout)
        self._fed = 0

    def feed(self, now: int) -> None:
        """Restart the timeout at a time (ns)."""
        self._fed = now
        if self._timeout and self.at == math.inf:
            self.at = now + self._timeout

    def stop(self) -> None:
        """Wait for nothing until it is fed again."""
        self.at = math.inf

    def expires(self, now: int) -> bool:
        """Return whether the timeout is over at a time (ns), and then wait for nothing."""
        if now < self.at:
            return False
        end = self._fed + self._timeout
        self.at = end if now < end else math.inf
        return now >= end


class DrivenRobot:
    """What the node virtual_robot does, driven by its wheels."""

    def __init__(self, parameters: VirtualRobotParameters, now: int, publish: Publish) -> None:
        """Place it at the pose of its parameters, at a time (ns)."""
        place = np.array([parameters.x, parameters.y, se2.wrap_angle(parameters.theta)])
        self.parameters = parameters
        self._robot = Robot(model=parameters.model(), stamp=now, pose=place)
        self._publish = publish
        self._names = parameters.wheel_names
        self._interval = 1.0 / parameters.publish_rate
        # As rclpy has timers: the period is rounded down, and a clock that starts later skips some.
        self._period = int(self._interval * NANOSECONDS)
        self.next = (now // self._period + 1) * self._period
        """When it publishes next (ns)."""
        robot = self._robot
        publish('start_pose', Place(robot.stamp, robot.pose_tuple, robot.covariance_tuple))

    def true_pose(self, now: int) -> NDArray[np.float64]:
        """Return `[x, y, theta]` where it truly is, shape (3,) (m, m, rad)."""
        return self._robot.at(now).true_pose

    def publish(self, now: int) -> None:
        """Publish the odometry and the wheels of a time (ns)."""
        self.next += self._period
        self._stop_in_silence(now)
        robot = self._robot.at(now)
        covariances = robot.covariance_tuple, robot.twist_covariance_tuple(self._interval)
        self._publish('odom', Motion(now, robot.pose_tuple, robot.twist, *covariances))
        wheels = Wheels.of(now, self._names, robot.wheel_speeds, robot.wheel_angles)
        self._publish('joint_states', wheels)
        if robot.model.drift is not None:
            self._publish('ground_truth', Motion(now, robot.true_pose_tuple, robot.true_twist))

    def follow(self, wheels: Wheels, now: int) -> None:
        """Follow a command, or raise MessageError."""
        v, omega = self._robot.model.twist(*wheels.speeds(self._names))
        twist = plausible_twist(v, omega)
        self._stop_in_silence(now)
        robot = self._robot
        time = command_time(wheels.stamp, now, robot.stamp, robot.model.command_timeout)
        self._robot = robot.commanded(twist, time)
        self._publish_applied()

    def _stop_in_silence(self, now: int) -> None:
        expiry = self._robot.expiry
        if expiry is not None and expiry <= now:
            self._robot = self._robot.at(expiry)
            self._publish_applied()

    def _publish_applied(self) -> None:
        self._publish('cmd_vel_out', Command(self._robot.target, self._robot.stamp))


class Bridge:
    """What the node wheel_bridge does."""

    def __init__(self, parameters: WheelBridgeParameters, publish: Publish) -> None:
        """Start with wheels that stand."""
        self.silence = Deadline(parameters.cmd_vel_timeout)
        self.next = math.inf
        """When it publishes next, while the wheels accelerate within limits (ns)."""
        self._period = nanoseconds(1.0 / parameters.publish_rate)
        self._model, self._names = parameters.model(), parameters.wheel_names
        self._acceleration = parameters.acceleration_limits()
        self._publish = publish
        self._twist = self._target = STANDSTILL
        self._profile: Profile | None = None

    def follow(self, command: Command, now: int) -> None:
        """Publish the wheel speeds of a command, or start to approach them within the limits."""
        self.silence.feed(now)
        self._follow(command.twist, now)

    def stop_in_silence(self, now: int) -> None:
        """Stop the wheels, unless they stand: no command was received for the timeout."""
        if self._twist != STANDSTILL or self._target != STANDSTILL:
            self._follow(STANDSTILL, now)

    def approach(self, now: int) -> None:
        """Publish the present speeds, which approach the commanded ones."""
        assert self._profile is not None
        self.next += self._period
        self._send(self._profile.twist(self._profile.seconds(now)), now)
        if now >= self._profile.settled_at:
            self.next = math.inf

    def _follow(self, command: tuple[float, float], now: int) -> None:
        self._target = target = self._model.limited(command)
        if self._acceleration.unlimited:
            self._send(target, now)
            return
        start = self._twist
        if self._profile is not None:
            start = self._profile.twist(self._profile.seconds(now))
        self._profile = Profile(now, [*ramp(start, target, self._acceleration, self._model)])
        self.next = now
        self.approach(now)

    def _send(self, twist: tuple[float, float], now: int) -> None:
        self._twist = twist
        self._publish('joint_command', Wheels.of(now, self._names, self._model.wheel_speeds(*twist)))


class Driver:
    """What the node go_to_goal does with one goal, and with odometry in order."""

    def __init__(self, parameters: GoToGoalParameters, publish: Publish) -> None:
        """Start without a goal."""
        self.parameters = parameters
        self.silence = Deadline(parameters.odom_timeout)
        self.pursuit: Pursuit | None = None
        """The goal and how far the robot has got. None: there is no goal."""
        self._publish = publish
        self._steering = Steering(parameters)
        self.arrival = self._steering.arrival
        self._rate = OdometryRate()
        self._stamp = (0, 0)
        self._driving = self._executing = self._stale = False

    def accept(self, sent: Route, along_path: bool, now: int) -> None:
        """Take a goal, or refuse it."""
        self._stamp = sent.stamp
        try:
            route = read_route(sent, along_path=along_path)
            goal = Goal.along_path(route) if along_path else Goal.through(route)
        except ValueError as error:
            self._refuse(error)
            return
        self.silence.feed(now)
        self.pursuit = Pursuit.of(goal)
        self._report(GoalState.ACCEPTED)

    def steer(self, state: State, now: int) -> None:
        """Answer odometry with the next command towards the goal."""
        if self.pursuit is None:
            return
        self.silence.feed(now)
        if not self._rate.measured:
            self._rate.receive(now)
        if not self._executing:
            try:
                self.pursuit = self._steering.begin(self.pursuit, state.pose)
            except ValueError as error:
                self.pursuit = None
                self._refuse(error)
                return
            self._executing = True
            self._report(GoalState.EXECUTING)
        if self._stale:
            self._stale = False
            self._steering.reset()
        missed = self.pursuit.missed
        try:
            self.pursuit, command = self._steering.command(self.pursuit, state, now, self._rate.hz)
        except ValueError as error:
            LOG.warning('goal aborted: %s', error)
            self.end(GoalState.ABORTED, now)
            return
        if self.pursuit.missed and not missed:
            LOG.warning('a waypoint was missed: driving to it and those after it one by one')
        if command is None:
            self.end(GoalState.SUCCEEDED, now)
        else:
            self._send(command)

    def wait(self, now: int) -> None:
        """Stop the robot because no odometry was received for the timeout, and keep the goal."""
        self._stale = self._stale or self._executing
        if self._driving:
            self._stop_robot(now)

    def end(self, state: GoalState, now: int) -> None:
        """Stop the robot, and end the goal."""
        self._stop_robot(now)
        self.silence.stop()
        self.pursuit = None
        self._report(state)

    def _refuse(self, error: ValueError) -> None:
        LOG.warning('goal refused: %s', error)
        self.silence.stop()
        self._report(GoalState.ABORTED)

    def _stop_robot(self, now: int) -> None:
        self._steering.stopped(now)
        self._send(STANDSTILL)

    def _send(self, twist: tuple[float, float]) -> None:
        self._driving = twist != STANDSTILL
        self._publish('cmd_vel', Command(twist))

    def _report(self, state: GoalState) -> None:
        self._publish('goal_status', Status(int(state), self._stamp))


class Client:
    """What the goal client does: it sends the goals with the first odometry, and follows them."""

    def __init__(self, goals: NDArray[np.float64] | Path, relative: bool, publish: Publish) -> None:
        """Start before the goals are sent."""
        self.path = PathProgress(goals) if isinstance(goals, Path) else None
        self.goals = goals.poses if isinstance(goals, Path) else goals
        self.robot: State | None = None
        self.stamp = 0
        """Stamp of the last odometry (ns)."""
        self.state = GoalState.UNKNOWN
        self._relative, self._publish = relative, publish
        self._sent = False
        self._begun = self._latest = 0

    def follow(self, state: State, stamp: int) -> None:
        """Take odometry with a stamp (ns)."""
        self.robot, self.stamp = state, stamp
        if not self._sent:
            self._sent = True
            self._send(state, stamp)
        if self.path is not None and self.state is GoalState.EXECUTING:
            self.path.moved(np.array(state.pose))
            self._begun, self._latest = self._begun or stamp, stamp

    def _send(self, state: State, now: int) -> None:
        times = None if self.path is None else self.path.path.times
        if self._relative:
            self.goals = se2.compose(state.pose, self.goals)
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


def read_route(route: Route, *, along_path: bool) -> Route:
    """Return goals as they are read from their message, a path or goals.

    Raises:
        GoalError: A receiver refuses them.
    """
    zeros, frames = (0.0,) * len(route.poses), ('',) * len(route.poses)
    x, y, headings = zip(*route.poses, strict=True)
    z, w = ((*(of(theta / 2.0) for theta in headings),) for of in (math.sin, math.cos))
    columns = x, y, zeros, zeros, z, w
    if not along_path:
        return GOALS.value(*route.stamp, '', frames, *columns)
    stamps = [(0, 0)] * len(route.poses)
    if route.times is not None:
        times = (route.time + nanoseconds(time) for time in route.times)
        stamps = [divmod(time, NANOSECONDS) for time in times]
    return PATH.value(*route.stamp, '', frames, *zip(*stamps, strict=True), *columns)


def as_read(topic: str, value: Any) -> Any:
    """Return the value of a message as it is read from it, whose headings are rounded as quaternions.

    Raises:
        MessageError: A receiver refuses it.
    """
    if isinstance(value, Route):
        return read_route(value, along_path=topic == 'path')
    if not isinstance(value, (Motion, Place)):
        return value
    x, y, theta = value.pose
    sine, cosine = math.sin(theta / 2.0), math.cos(theta / 2.0)
    return value._replace(pose=from_pose(x, y, 0.0, 0.0, sine, cosine))


def read_state(motion: Motion, frame: str) -> State:
    """Return what is read from an odometry message, whose heading is rounded as a quaternion."""
    sec, nanosec, x, y, z, w, *_ = ODOMETRY.numbers(motion)
    return ODOMETRY_STATE.value(frame, sec, nanosec, *motion.twist, x, y, 0.0, 0.0, z, w)


class World:
    """Robot, bridge, controller and client, and their time.

    Attributes:
        now: The time (ns).
        published: Time (ns), topic and value of each message; who takes them clears the list.
        speeds: Speeds of the right and the left wheel, as they were reported last (rad/s).
    """

    def __init__(self, request: Request, ros_arguments: Sequence[str], start: int) -> None:
        """Start at a time (ns), with the parameters that ROS arguments give.

        Raises:
            UserError: The parameters or the ROS arguments are invalid.
        """
        self.now = self._start = start
        self.published: list[tuple[int, str, Any]] = []
        self.speeds = (0.0, 0.0)
        self._queue: list[tuple[str, Any]] = []
        given = given_parameters(ros_arguments, NODES)
        interface = {'command_interface': 'wheels'}
        values = {
            '/virtual_robot': {**given['/virtual_robot'], **request.robot_parameters, **interface},
            '/wheel_bridge': given['/wheel_bridge'],
            '/go_to_goal': {**given['/go_to_goal'], **request.parameters},
        }
        of_robot = VirtualRobotParameters().at_start(values['/virtual_robot'])
        of_bridge = WheelBridgeParameters().at_start(values['/wheel_bridge'])
        of_driver = GoToGoalParameters().at_start(values['/go_to_goal'])
        self._frame = of_robot.odom_frame_id
        self.parameters = {
            '/virtual_robot': of_robot.by_name(),
            '/wheel_bridge': of_bridge.by_name(),
            '/go_to_goal': of_driver.by_name(),
        }
        """Values of the parameters by the names of the nodes."""
        known = {name for one in self.parameters.values() for name in one}
        check_names(ros_arguments, known)
        for node in (of_robot, of_bridge, of_driver):
            for name in OF_MESSAGES & node.declared().keys():
                if node.by_name()[name] != node.declared()[name].default:
                    raise UserError(f'{name} chooses a type of messages, and needs rclpy')
        wheels = of_bridge.dimensions, 'virtual_robot', of_robot.dimensions
        if found := different_wheels(*wheels):
            LOG.warning('%s; %s', found, SAME_WHEELS)
        self.robot = DrivenRobot(of_robot, self.now, self._publish)
        self.bridge = Bridge(of_bridge, self._publish)
        self.driver = Driver(of_driver, self._publish)
        self.client = Client(request.goals, request.relative, self._publish)
        self._receivers: dict[str, Callable[[Any], None]] = {
            'odom': self._on_odometry,
            'joint_states': self._on_joint_states,
            'cmd_vel': self._on_command,
            'joint_command': lambda wheels: self.robot.follow(wheels, self.now),
            'goals': lambda route: self.driver.accept(route, False, self.now),
            'path': lambda route: self.driver.accept(route, True, self.now),
            'goal_status': self._on_status,
        }

    @property
    def seconds(self) -> float:
        """Time since the start (s)."""
        return (self.now - self._start) / NANOSECONDS

    def advance(self, pace: Callable[[float], None]) -> None:
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
            receive = self._receivers.get(topic)
            if receive is None:
                continue
            try:
                receive(value)
            except MessageError as error:
                LOG.warning('%s dropped: %s', topic, error)
        self._queue.clear()

    def stop(self) -> None:
        """End the goal, if there is one."""
        if self.driver.pursuit is not None:
            self.driver.end(GoalState.CANCELED, self.now)

    def _publish(self, topic: str, value: Any) -> None:
        self.published.append((self.now, topic, value))
        self._queue.append((topic, value))

    def _on_odometry(self, motion: Motion) -> None:
        state = read_state(motion, self._frame)
        self.client.follow(state, motion.stamp)
        self.driver.steer(state, self.now)

    def _on_joint_states(self, wheels: Wheels) -> None:
        self.speeds = wheels.speeds(self.robot.parameters.wheel_names)

    def _on_command(self, command: Command) -> None:
        v, omega = command.twist
        self.bridge.follow(Command(from_twist(v, 0.0, 0.0, 0.0, 0.0, omega)), self.now)

    def _on_status(self, status: Status) -> None:
        self.client.state = GoalState(status.status)


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
    world = World(request, ros_arguments, START if lockstep else time.time_ns())
    pace = (lambda _: None) if lockstep else in_real_time()
    kept: list[tuple[int, str, Any]] = []
    recorder = None
    if request.recording is not None:
        recorder = ValueRecorder(request.recording, world.parameters)

    def take() -> None:
        """Take what was published, so that a recording has it soon."""
        for now, topic, value in world.published:
            if recorder is not None:
                recorder.add(now, topic, value)
            if request.keep:
                with suppress(MessageError):
                    kept.append((now, topic, as_read(topic, value)))
        world.published.clear()

    client, driver, robot = world.client, world.driver, world.robot
    if progress is not None:
        progress.nodes_created([*world.parameters])

    def turns(longest: float, handled: int = 0) -> Iterator[None]:
        """As `NodeRunner.turns`."""
        deadline = world.seconds + longest
        world.settle()
        while True:
            take()
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
            progress.driving(world.seconds, index, client.distance(index, driver), world.speeds)
    seconds, state = world.seconds, client.state
    client.withdraw()
    world.stop()
    settled = world.now + nanoseconds(SETTLING)
    for _ in turns(STOP_PATIENCE + 1.0 / robot.parameters.publish_rate, signals.count):
        if client.robot is not None and client.stamp >= settled and client.robot.twist == STANDSTILL:
            break
    arrival, last = driver.arrival, client.goals[-1, :2].tolist()
    true_distance = math.nan
    if robot.parameters.drift() is not None:
        true_distance = float(arrival.distance(*robot.true_pose(world.now).tolist(), *last))
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
        kept=run_of('drive', kept, world.parameters) if request.keep else None,
    )


def in_real_time() -> Callable[[float], None]:
    """Return a function that waits until so much time (s) has passed since this call."""
    begin = time.monotonic()
    return lambda seconds: time.sleep(max(0.0, begin + seconds - time.monotonic()))
