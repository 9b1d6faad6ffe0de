"""Drive a robot to goals and along paths: odometry, goals and paths in, body twists out."""

from __future__ import annotations

import math
import uuid
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
from action_msgs.msg import GoalInfo, GoalStatus
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry
from nav_msgs.msg import Path as PathMessage
from std_srvs.srv import Trigger
from unique_identifier_msgs.msg import UUID

from diffdrive_jacobian.control import KP, KV, Arrival, Controller, Path, PathController, Waypoints
from diffdrive_jacobian.control.goal_laws import LARGEST_TURN, by_shorter_turn
from diffdrive_jacobian.control.path_following import PathFollower
from diffdrive_jacobian.kinematics.saturation import scaled_to_limits
from diffdrive_jacobian.messages import conversion as messages
from diffdrive_jacobian.messages.codecs import (
    GOALS,
    ODOMETRY_STATE,
    PATH,
    POSE,
    TWIST,
    TWIST_STAMPED,
    Route,
)
from diffdrive_jacobian.messages.conversion import MAX_PATH_POSES, MAX_WAYPOINTS, MessageError
from diffdrive_jacobian.messages.topics import OF_SOMEBODY_ELSE, SEVERAL, UNREAD
from diffdrive_jacobian.nodes.other_drivers import PERIOD, OtherDrivers
from diffdrive_jacobian.nodes.stopping import overshoot_warnings, rolls_on
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.ros import serialization
from diffdrive_jacobian.ros.graph_faults import topic_check
from diffdrive_jacobian.ros.node import THROTTLE, ParameterizedNode
from diffdrive_jacobian.ros.watchdog import Watchdog
from diffdrive_jacobian.simulation.braking import Braking
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds

__all__ = ['GoToGoal']


Poses: TypeAlias = Sequence[Sequence[float]]
Stamps: TypeAlias = Iterable[tuple[int, int]]


@dataclass(slots=True)
class Goal:
    """A goal that was accepted: the content of one message."""

    info: GoalInfo
    frame: str
    """Frame of its poses; empty: that of the odometry."""
    waypoints: Waypoints
    whole: Path | None = None
    """The path that was sent; None: waypoints."""
    path: PathFollower | None = None
    """The path that is followed; None: the waypoints are driven to one by one, or the last pose."""
    begun: int = 0
    """Time of the first step along the path (ns)."""
    stepped: int = 0
    """Time of the last step along the path (ns)."""
    executing: bool = False
    """Whether odometry was received after it was accepted."""
    stale: bool = False
    """Whether the robot is stopped because odometry is missing."""

    def same_path(self, other: Goal) -> bool:
        """Return whether both are on the same path."""
        one, two = self.whole, other.whole
        if one is None or two is None or self.frame != other.frame:
            return False
        before, after = (np.zeros(0) if path.times is None else path.times for path in (one, two))
        return np.array_equal(one.poses, two.poses) and np.array_equal(before, after)


def read_goal(frame: str, frames: Sequence[str], poses: Poses) -> tuple[str, Waypoints]:
    """Return the frame and the poses of a goal.

    Args:
        frame: Frame of the message.
        frames: Frames of its poses; '': that of the message.
        poses: The fields of each pose, as `from_pose` takes them.

    Raises:
        MessageError: There is no pose, one is invalid, or they are in several frames.
    """
    if not poses:
        raise MessageError('goals must contain at least one pose, got none (to stop, call cancel_goal)')
    distinct = {one or frame for one in frames}
    if len(distinct) > 1:
        raise MessageError(
            f'all poses must be given in one frame, got {messages.quoted(sorted(distinct))}'
        )
    read = np.array([messages.from_pose(*pose) for pose in poses])
    return distinct.pop(), Waypoints(read)


def read_path(frame: str, frames: Sequence[str], poses: Poses, stamps: Stamps) -> tuple[str, Path]:
    """Return the frame of a path and the path, a trajectory if the stamps of the poses increase.

    The arguments are those of `read_goal`, and `sec` and `nanosec` of each pose.

    Raises:
        MessageError: As `read_goal`. Or fewer than two positions differ, or the stamps neither increase
            nor are all equal.
    """
    if len(poses) < 2:
        raise MessageError(
            f'path must contain at least two poses, got {len(poses)} (to stop, call cancel_goal; to '
            'drive to one pose, publish goal_pose)'
        )
    frame, waypoints = read_goal(frame, frames, poses)
    times = Route((0, 0), frame, (), stamps=tuple(stamps)).times
    try:
        return frame, Path(waypoints.poses, None if times is None else np.array(times))
    except ValueError as error:
        raise MessageError(f'path is invalid: {error}') from error


def _through(pose: tuple[float, float, float], waypoints: Waypoints) -> PathFollower | None:
    """Return the path from a robot through waypoints; None: they are all in one place, where it is."""
    with suppress(ValueError):
        return PathFollower(Path(np.array([pose, *waypoints.poses])), passing=True)
    return None


def _waypoint(path: PathFollower) -> int:
    """Return the index of the next pose of a goal. A path through waypoints begins at the robot."""
    return max(path.index - path.passing, 0)


def _lateness(goal: Goal, now: int) -> str:
    """Describe how much later than by its times the end of a trajectory was reached."""
    if goal.whole is None or goal.whole.times is None:
        return ''
    late = max((now - goal.begun) / NANOSECONDS - goal.whole.duration, 0.0)
    return f', {late:.1f} s later than by its times'


def described(goal: Goal) -> str:
    """Return a goal in words, for the log."""
    x, y, _ = goal.waypoints.poses[-1]
    count, words = len(goal.waypoints.poses), ''
    if goal.path is not None:
        path = goal.path.path
        time = '' if path.times is None else f' in {path.duration:.1f} s'
        words = f'path of {path.length:.2f} m{time} through {count} poses, the last at '
    elif count > 1:
        words = f'{count} waypoints, the last at '
    return f'{words}x {x:.3f}, y {y:.3f}'


STANDSTILL = (0.0, 0.0)
RATE_PERIODS = 10
"""Number of periods of the odometry from which its rate is measured."""
_read_goals = serialization.reader(Goals, GOALS.fields)
_read_path = serialization.reader(PathMessage, PATH.fields)
SLOW_TURN = 60.0
"""Time for half a turn above which a limit of the yaw rate is reported (s)."""


class GoToGoal(ParameterizedNode[GoToGoalParameters]):
    """Node go_to_goal: `odom`, `goal_pose`, `goals` and `path` in; `cmd_vel` and `goal_status` out;
    `cancel_goal` stops.

    A path is a goal, too. While a goal is active, every odometry message is answered by one command;
    without one the node is silent, so that others may drive. A command of another node that is not zero
    cancels the goal.
    """

    def __init__(
        self,
        *,
        controller: Controller | None = None,
        path_controller: PathController | None = None,
        **kwargs: Any,
    ) -> None:
        """Create the node without a goal.

        Args:
            controller: A controller that can be chosen besides the built-in and the installed ones. Its
                name becomes the default of the parameter `controller`.
            path_controller: Likewise, of the parameter `path_controller`.
            kwargs: As for `ParameterizedNode`.

        Raises:
            ValueError: `controller` is not a Controller, `path_controller` not a PathController, or one
                has the name of a built-in one.
            ParameterError: The parameters given are not a valid set.
        """
        parameters = GoToGoalParameters
        if controller is not None:
            parameters = parameters.with_controller(controller)
        if path_controller is not None:
            parameters = parameters.with_path_controller(path_controller)
        super().__init__('go_to_goal', parameters, **kwargs)
        self._goal: Goal | None = None
        self._controller = self.parameters.chosen_controller()
        self._law = self._controller.bind(self.parameters)
        self._path_law = self.parameters.chosen_path_controller().bind(self.parameters)
        self._goals_received = 0
        self._odom_frame = ''
        # Twist by the odometry.
        self._twist = STANDSTILL
        # With stop_in_time.
        self._braking: Braking | None = None
        # Rate of the odometry (Hz), and the times of the messages from which it is measured (ns).
        self._rate = math.inf
        self._times: list[int] = []
        # Whether the last command makes the robot move: it outlives a goal that is replaced.
        self._driving = False
        stamped = self.parameters.enable_stamped_cmd_vel
        self._cmd_vel = self.advertise(TwistStamped if stamped else Twist, 'cmd_vel')
        self._status = self.advertise(GoalStatus, 'goal_status', latched=True)
        self.subscribe(Odometry, 'odom', self._on_odometry, codec=ODOMETRY_STATE)
        self.subscribe(PoseStamped, 'goal_pose', self._on_goal_pose, codec=POSE)
        # As bytes, because reading a long message blocks the node for seconds.
        self.subscribe(Goals, 'goals', self._on_goals)
        self.subscribe(PathMessage, 'path', self._on_path)
        self.provide(Trigger, 'cancel_goal', self._on_cancel)
        # Without a frame: the twist is in the body frame, whose name this node does not know.
        self._serialized = TWIST_STAMPED.writer(TwistStamped()) if stamped else TWIST.writer(Twist())
        self._watchdog = Watchdog(self, self._on_stale_odometry)
        self._others = OtherDrivers(self, self._cmd_vel, self._on_other_driver)
        self._configure()

        def readers() -> int:
            return int(self._cmd_vel.get_subscription_count()) - self._others.subscriptions

        self.watch(topic_check(self, UNREAD, 'cmd_vel', readers))
        self.watch(topic_check(self, SEVERAL, 'odom'))
        self.watch(topic_check(self, SEVERAL, 'goal_status'))
        self.announce(subscribed=['goal_pose', 'goals', 'path'], publishing=['cmd_vel'])

    @property
    def waypoint(self) -> int | None:
        """Index of the pose of the active goal that is driven to; None without a goal."""
        if self._goal is None:
            return None
        path, waypoints = self._goal.path, self._goal.waypoints
        return waypoints.index if path is None else _waypoint(path)

    @property
    def arrival(self) -> Arrival:
        """Arrival criterion according to the parameters."""
        return self._arrival

    # --- Goals

    def _on_goal_pose(self, sec: int, nanosec: int, frame: str, *pose: float) -> None:
        def read(info: GoalInfo) -> Goal:
            self._warn_of_integers('goal_pose', [pose])
            return Goal(info, *read_goal(frame, [frame], [pose]))

        self._receive(Time(sec=sec, nanosec=nanosec), read)

    def _on_goals(self, data: bytes) -> None:
        def read(info: GoalInfo) -> Goal:
            _, _, frame, frames, *columns = _read_goals(data)
            poses = [*zip(*columns, strict=True)]
            self._warn_of_integers('goals', poses)
            return Goal(info, *read_goal(frame, frames, poses))

        self._receive_many('goals', data, Goals, MAX_WAYPOINTS, read)

    def _on_path(self, data: bytes) -> None:
        def read(info: GoalInfo) -> Goal:
            _, _, frame, frames, secs, nanosecs, *columns = _read_path(data)
            poses = [*zip(*columns, strict=True)]
            self._warn_of_integers('path', poses)
            frame, path = read_path(frame, frames, poses, zip(secs, nanosecs, strict=True))
            return Goal(info, frame, Waypoints(path.poses), path, PathFollower(path))

        self._receive_many('path', data, PathMessage, MAX_PATH_POSES, read)

    def _receive_many(
        self, topic: str, data: bytes, kind: type[Any], most: int, read: Callable[[GoalInfo], Goal]
    ) -> None:
        """Accept or refuse the goal in a message with many poses, whose number is checked first."""

        def read_bounded(info: GoalInfo) -> Goal:
            if count > most:
                raise MessageError(f'{topic} must contain at most {most} poses, got {count}')
            return read(info)

        try:
            stamp, count = serialization.poses_header(data, kind)
        except MessageError as error:
            self.get_logger().warning(f'{topic} dropped: {error}', throttle_duration_sec=THROTTLE)
            return
        self._receive(stamp, read_bounded)

    def _receive(self, stamp: Time, read: Callable[[GoalInfo], Goal]) -> None:
        """Accept or refuse a goal with a stamp."""
        # Its identifier follows from this, so runs in lockstep are the same each time.
        self._goals_received += 1
        origin = f'{self.get_fully_qualified_name()}/{self.now()}/{self._goals_received}'
        identifier = uuid.uuid5(uuid.NAMESPACE_URL, origin)
        info = GoalInfo(goal_id=UUID(uuid=list(identifier.bytes)), stamp=stamp)
        try:
            goal = read(info)
            self._match_frames(goal)
        except MessageError as error:
            self._refuse(info, error)
            return
        self._accept(goal)

    def _warn_of_integers(self, topic: str, poses: Iterable[Sequence[float]]) -> None:
        for pose in poses:
            self.warn_of_integers(f'a pose on {topic}', *pose)

    def _refuse(self, info: GoalInfo, error: MessageError) -> None:
        """Publish that a goal is aborted. The active goal is kept."""
        self.log_event_warning('goal refused', f'goal refused: {error}')
        self._publish_status(info, GoalStatus.STATUS_ABORTED)
        if self._goal is not None:
            # The last latched status must be that of the active goal.
            executing = self._goal.executing
            status = GoalStatus.STATUS_EXECUTING if executing else GoalStatus.STATUS_ACCEPTED
            self._publish_status(self._goal.info, status)

    def _accept(self, goal: Goal) -> None:
        """Replace the active goal, if there is one. On the same path the robot goes on where it is."""
        before = self._goal
        if before is not None:
            self._publish_status(before.info, GoalStatus.STATUS_CANCELED)
        if before is not None and before.same_path(goal):
            goal.path, goal.waypoints = before.path, before.waypoints
            goal.begun, goal.stepped = before.begun, before.stepped
        else:
            self._law.reset()
            self._path_law.reset()
            self._times.clear()
        if not self._driving:
            # While the robot moves the watchdog runs already, and a new goal is no sign of odometry.
            self._watchdog.start(nanoseconds(self.parameters.odom_timeout))
        self._goal = goal
        self._others.start()
        self._publish_status(goal.info, GoalStatus.STATUS_ACCEPTED)
        self.log_event_info('goal accepted', f'goal accepted: {described(goal)}')
        self._advise_for(goal)

    def _match_frames(self, goal: Goal) -> None:
        if goal.frame and self._odom_frame and goal.frame != self._odom_frame:
            raise MessageError(
                f"it must be given in the frame of the odometry, '{printable(self._odom_frame)}' "
                f"or '' for it, got '{printable(goal.frame)}'"
            )

    def _match_start(self, follower: PathFollower, pose: tuple[float, float, float]) -> None:
        (x, y, _), path = pose, follower.path
        start = path.at(path.nearest(x, y, follower.s), 0.0)
        distance, most = math.hypot(start.x - x, start.y - y), self.parameters.max_path_distance
        if distance > most:
            raise MessageError(
                f'the start of a path must be within max_path_distance, {most:g} m, of the robot, got '
                f'{distance:.3g} m'
            )

    def _on_cancel(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._goal is None:
            response.message = 'no goal is active'
            return response
        self._publish_command(0.0, 0.0)
        self._end(GoalStatus.STATUS_CANCELED, f'canceled{self._rolls_on()}')
        response.success, response.message = True, f'goal canceled, zero sent{self._rolls_on()}'
        return response

    def _end(self, status: int, what: str) -> None:
        """Stop the robot and end the active goal."""
        if self._driving:
            self._publish_command(0.0, 0.0)
        if self._goal is not None:
            self._publish_status(self._goal.info, status)
            self._goal = None
            self._watchdog.stop()
            self._others.stop()
            self.log_event_info(f'goal {what}', f'goal {what}')

    def _rolls_on(self) -> str:
        """Describe how far the robot rolls after zero was sent, as far as its limits are known."""
        return rolls_on(self._actuators, self._twist)

    def _publish_status(self, info: GoalInfo, status: int) -> None:
        self._status.publish(GoalStatus(goal_info=info, status=status))

    # --- Control

    def _on_odometry(self, frame: str, v: float, omega: float, *values: float) -> None:
        goal, now = self._goal, self.now()
        try:
            pose = messages.from_pose(*values)
            if frame != self._odom_frame and (self._driving or (goal is not None and goal.executing)):
                raise MessageError(
                    f"it must stay in frame '{printable(self._odom_frame)}', got '{printable(frame)}'"
                )
            if goal is not None and now == 0:
                raise MessageError('simulated time has not begun, nothing was received on /clock')
        except MessageError as error:
            self.get_logger().warning(f'odometry dropped: {error}', throttle_duration_sec=THROTTLE)
            return
        self._odom_frame, self._twist = frame, (v, omega)
        if goal is None:
            return
        self._watchdog.feed(now)
        if not 0 <= now - self._others.searched < PERIOD:
            self._others.search(now)
        if len(self._times) <= RATE_PERIODS:
            self._measure_rate(now)
        if not goal.executing and not self._begin(goal, pose):
            return
        if goal.stale:
            goal.stale = False
            # The robot has stopped.
            self._path_law.reset()
            self.log_event_info('odometry is back', 'odometry is received again: driving on')
        self._law.now = self._path_law.now = now
        try:
            command = self._step(goal, pose, now)
            if command is not None:
                command = self._limited(*command)
                if self._braking is not None:
                    command = self._braked(self._braking, goal, pose, command, now)
        except ValueError as error:
            self.log_event_warning('law', f'goal aborted: {error}')
            self._publish_command(0.0, 0.0)
            self._end(GoalStatus.STATUS_ABORTED, 'aborted')
            return
        if command is None:
            self._publish_command(0.0, 0.0)
            self._end(GoalStatus.STATUS_SUCCEEDED, f'reached{_lateness(goal, now)}')
            return
        self._publish_command(*command, now)

    def _step(
        self, goal: Goal, pose: tuple[float, float, float], now: int
    ) -> tuple[float, float] | None:
        """Return the next command towards a goal or along its path; None: the robot has arrived."""
        if goal.path is not None:
            # While the robot stands because odometry is missing, a trajectory waits.
            longest = self.parameters.odom_timeout or math.inf
            dt = min(max(0, now - (goal.stepped or now)) / NANOSECONDS, longest)
            goal.path, command = goal.path.follow(
                pose, dt, self._path_law, self._law, self._path_settings
            )
            goal.begun, goal.stepped = goal.begun or now, now
            if command is not None:
                return command
            self._leave_path(goal, goal.path)
        goal.waypoints, command = goal.waypoints.follow(
            pose, self._law, self._arrival, self.parameters.kp, self._twist
        )
        return command

    def _leave_path(self, goal: Goal, path: PathFollower) -> None:
        """Drive to the pose at the end of a path as to a goal, or to the waypoints that remain."""
        poses, index = goal.waypoints.poses, _waypoint(path)
        if index + 1 < len(poses):
            self.log_event_warning(
                'waypoint missed',
                f'waypoint {index + 1} of {len(poses)} was passed at more than waypoint_tolerance, '
                f'{self.parameters.waypoint_tolerance:g} m: driving to it and those after it one by one',
            )
        goal.path, goal.waypoints = None, Waypoints(poses, index)

    def _limited(self, v: float, omega: float) -> tuple[float, float]:
        """Return a command within the limits, without whole turns between two messages."""
        # Without wheels in the limits the geometry of the wheels does not matter.
        v, omega = scaled_to_limits.floats(v, omega, *self._limit_values, 1.0, 1.0)
        if abs(omega) > LARGEST_TURN * self._rate:
            # The other direction may be forbidden.
            omega = by_shorter_turn(omega, self._rate)
            v, omega = scaled_to_limits.floats(v, omega, *self._limit_values, 1.0, 1.0)
        return v, omega

    def _braked(
        self,
        braking: Braking,
        goal: Goal,
        pose: tuple[float, float, float],
        command: tuple[float, float],
        now: int,
    ) -> tuple[float, float]:
        """Return a command from which the robot can stop at the last goal."""
        # A turn in place moves the driven point in any case.
        straight = goal.path is not None or goal.waypoints.turning
        offset = 0.0 if straight else float(self._arrival.offset)

        def room(turn: float) -> tuple[float, float]:
            if goal.path is not None:
                return goal.path.remaining()
            return goal.waypoints.remaining(pose, self._arrival, turn)

        return braking.limited(now, self._twist, command, room, 1.0 / self._rate, offset=offset)

    def _begin(self, goal: Goal, pose: tuple[float, float, float]) -> bool:
        """Start executing a goal, now that the frame of the odometry and the pose are known."""
        try:
            self._match_frames(goal)
            if goal.path is not None:
                self._match_start(goal.path, pose)
            elif goal.whole is None and self.parameters.pass_waypoints and len(goal.waypoints.poses) > 1:
                goal.path = _through(pose, goal.waypoints)
        except MessageError as error:
            self.log_event_warning('goal refused', f'goal refused: {error}')
            self._end(GoalStatus.STATUS_ABORTED, 'refused')
            return False
        goal.executing = True
        self._publish_status(goal.info, GoalStatus.STATUS_EXECUTING)
        return True

    def _measure_rate(self, now: int) -> None:
        """Measure the rate of the odometry at the beginning of each goal."""
        self._times.append(now)
        if len(self._times) <= RATE_PERIODS:
            return
        # The median is not affected by a gap or by messages that arrive together.
        period = sorted(b - a for a, b in pairwise(self._times))[RATE_PERIODS // 2]
        rate = 1e9 / period if period > 0 else math.inf
        changed = not 0.8 < rate / self._rate < 1.25
        self._rate = rate
        if changed:
            self._warn_of_rate()

    def _on_stale_odometry(self) -> None:
        """Stop the robot because odometry is missing, and keep the goal."""
        goal = self._goal
        if goal is None:
            return
        topic, timeout = self.resolve_topic_name('odom'), self.parameters.odom_timeout
        goal.stale = goal.executing
        if self._driving:
            self._publish_command(0.0, 0.0)
            self.log_event_warning(
                'odometry is stale',
                f'no valid odometry on {topic} for {timeout:g} s: robot stopped, waiting'
                f'{self._rolls_on()}',
            )
        else:
            self.log_event_warning(
                'goal waits', f'the goal waits for odometry on {topic}: is the robot running?'
            )

    def _publish_command(self, v: float, omega: float, now: int | None = None) -> None:
        """Publish a command at a time (ns); None: now."""
        now = self.now() if now is None else now
        twist = v, omega
        if self._braking is not None:
            self._braking.sent(now, twist)
        self._driving = twist != STANDSTILL
        data = self._serialized(twist, now)
        self._others.sent(data)
        self._cmd_vel.publish(data)

    def _on_other_driver(self, names: str) -> None:
        """Cancel the goal: whoever drives by hand takes over."""
        # The zero of `_end`: or the robot might follow the last command of this node.
        topic, hint = self._cmd_vel.topic_name, ''
        if self.get_fully_qualified_name() in names:
            names, hint = f'another {names}', f'; {OF_SOMEBODY_ELSE}'
        self.log_event_warning(
            'other driver',
            f'{names} drives the robot by {topic}, so the goal is canceled: send it again later, or '
            f'remap the topic of the other one{hint}',
        )
        self._end(GoalStatus.STATUS_CANCELED, 'canceled')

    def stop(self, why: str) -> None:
        """Stop the robot and cancel the goal, if there is one."""
        if self._goal is not None:
            self._publish_command(0.0, 0.0)
            self._end(GoalStatus.STATUS_CANCELED, f'canceled: {why}{self._rolls_on()}')
            self.flush(self._cmd_vel)
            self.flush(self._status)

    # --- Parameters

    def parameters_changed(self, previous: GoToGoalParameters) -> None:
        """Apply the new parameters; an active goal is kept."""
        before = self._controller, self._arrival.offset
        self._configure()
        goal = self._goal
        if goal is None:
            self._advise()
            return
        self._advise_for(goal)
        if (self._controller, self._arrival.offset) != before:
            # The driven point or the law is another one.
            goal.waypoints = goal.waypoints.resumed()
        if self.parameters.odom_timeout != previous.odom_timeout:
            self._watchdog.change_timeout(nanoseconds(self.parameters.odom_timeout))

    def _configure(self) -> None:
        """Compute from the parameters what every step needs, and warn of values that do not suit."""
        parameters = self.parameters
        self._controller = controller = parameters.chosen_controller()
        law = controller.bind(parameters)
        law.continue_from(self._law)
        self._law = law
        path_law = parameters.chosen_path_controller().bind(parameters)
        path_law.continue_from(self._path_law)
        self._path_law, self._path_settings = path_law, parameters.path_settings()
        # Far from the goal a law may return more than what counts as a plausible command.
        self._limits = parameters.limits()
        self._limit_values = self._limits.all()
        self._arrival = parameters.arrival()
        self._actuators = actuators = parameters.actuators()
        if not parameters.stop_in_time or actuators.immediate:
            self._braking = None
        elif self._braking is None or self._braking.actuators != actuators:
            self._braking = Braking(actuators)
        if self._limits.max_v == 0.0:
            self.log_event_warning(
                'max_v',
                'linear.x.max_velocity is 0: the robot may not drive forward, goals cannot be reached',
            )
        if 0.0 in (self._limits.min_omega, self._limits.max_omega):
            self.log_event_warning(
                'omega',
                'angular.z.min_velocity or angular.z.max_velocity is 0: the robot may turn in one '
                'direction only or not at all, some goals and headings cannot be reached',
            )
        elif (slowest := min(-self._limits.min_omega, self._limits.max_omega)) * SLOW_TURN < math.pi:
            self.log_event_warning(
                'omega',
                f'the yaw rate is limited to {slowest:g} rad/s: half a turn takes more than '
                f'{SLOW_TURN:g} s',
            )
        self._advised: set[str] = set()

    def _advise(self, *, goals: bool = True, paths: bool = True) -> None:
        """Warn of gains that do not suit, each once: of the law of goals, and of that of paths."""
        parameters, controller, warnings = self.parameters, self._controller, list[str]()
        if goals:
            self._warn_of_rate()
            warnings += controller.warnings(parameters, self._limits)
            if not parameters.stop_in_time:
                kv = parameters.kv if KV.name in controller.gain_names else None
                turns = self._arrival.use_heading or KP.name in controller.gain_names
                kp = parameters.kp if turns else None
                warnings += overshoot_warnings(kv, kp, self._limits, self._actuators)
        if paths:
            warnings += parameters.chosen_path_controller().warnings(parameters, self._limits)
        for number, warning in enumerate(warnings):
            if warning not in self._advised:
                self._advised.add(warning)
                self.log_event_warning(f'advice {number}', warning)

    def _advise_for(self, goal: Goal) -> None:
        """Warn of gains that do not suit for a goal."""
        passing = self.parameters.pass_waypoints and len(goal.waypoints.poses) > 1
        self._advise(goals=goal.whole is None, paths=goal.whole is not None or passing)

    def _warn_of_rate(self) -> None:
        """Warn of gains that are too large for the rate of the odometry, unless a path is driven."""
        if self._goal is not None and self._goal.whole is not None:
            return
        for warning in self._controller.rate_warnings(
            self.parameters, self._rate, turns=self._arrival.use_heading
        ):
            if warning not in self._advised:
                self._advised.add(warning)
                self.log_event_warning('rate', warning)
