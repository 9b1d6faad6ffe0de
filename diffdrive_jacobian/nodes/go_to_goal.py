"""Drive a robot to goals by one of three laws: odometry and goals in, body twists out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalInfo, GoalStatus
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry
from std_srvs.srv import Trigger

from diffdrive_jacobian.control import (
    Arrival,
    go_to_goal,
    go_to_pose,
    offset_point,
    saturate,
)
from diffdrive_jacobian.control.waypoints import Law
from diffdrive_jacobian.messages import conversion as messages
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.nodes.goal import MAX_WAYPOINTS, Goal, goal_info, read_goal
from diffdrive_jacobian.parameters.nodes import GoToGoalParameters
from diffdrive_jacobian.ros import serialization
from diffdrive_jacobian.ros.node import THROTTLE, ParameterizedNode
from diffdrive_jacobian.ros.watchdog import Watchdog
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import nanoseconds

LAWS: dict[str, Callable[[GoToGoalParameters], Law]] = {
    'go_to_goal': lambda gains: lambda pose, goal: go_to_goal(pose, goal[:2], gains.kp, gains.kv),
    'offset_point': lambda gains: (
        lambda pose, goal: offset_point(pose, goal[:2], gains.kv, gains.offset)
    ),
    'pose': lambda gains: lambda pose, goal: go_to_pose(pose, goal, gains.kp, gains.kv),
}
"""Parameter `controller` to the law with its gains."""


class GoToGoal(ParameterizedNode[GoToGoalParameters]):
    """Node go_to_goal: `odom`, `goal_pose` and `goals` in; `cmd_vel` and `goal_status` out;
    `cancel_goal` stops.

    While a goal is active, every odometry message is answered by one command; without one the node is
    silent, so that others may drive.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Create the controller without a goal; `kwargs` as for `ParameterizedNode`."""
        super().__init__('go_to_goal', GoToGoalParameters, **kwargs)
        self._goal: Goal | None = None
        self._odom_frame = ''
        # Whether the last command makes the robot move: it outlives a goal that is replaced.
        self._driving = False
        stamped = self.parameters.enable_stamped_cmd_vel
        self._cmd_vel = self.advertise(TwistStamped if stamped else Twist, 'cmd_vel')
        self._status = self.advertise(GoalStatus, 'goal_status', latched=True)
        self.subscribe(Odometry, 'odom', self._on_odometry)
        self.subscribe(PoseStamped, 'goal_pose', self._on_goal_pose)
        # As bytes: to make Python objects of a long message blocks the node for seconds.
        self.subscribe(Goals, 'goals', self._on_goals, raw=True)
        self.provide(Trigger, 'cancel_goal', self._on_cancel)
        self._message: Twist | TwistStamped = TwistStamped() if stamped else Twist()
        self._watchdog = Watchdog(self, self._on_stale_odometry)
        self._configure()
        self.announce(subscribed=['goal_pose', 'goals'], publishing=['cmd_vel'])

    @property
    def waypoint(self) -> int | None:
        """Which pose of the active goal is driven to; None without a goal."""
        return None if self._goal is None else self._goal.waypoints.index

    @property
    def arrival(self) -> Arrival:
        """What counts as having arrived, by the parameters."""
        return self._arrival

    # --- Goals

    def _on_goal_pose(self, message: PoseStamped) -> None:
        info = goal_info(message.header.stamp)
        try:
            goal = Goal(info, *read_goal(message.header.frame_id, [message]))
            self._match_frames(goal)
        except MessageError as error:
            self._refuse(info, error)
            return
        self._accept(goal)

    def _on_goals(self, data: bytes) -> None:
        try:
            stamp, count = serialization.goals_header(data)
        except MessageError as error:
            self.get_logger().warning(f'goals dropped: {error}', throttle_duration_sec=THROTTLE)
            return
        info = goal_info(stamp)
        try:
            if count > MAX_WAYPOINTS:
                raise MessageError(f'goals must hold at most {MAX_WAYPOINTS} poses, got {count}')
            message = serialization.deserialized(data, Goals)
            goal = Goal(info, *read_goal(message.header.frame_id, message.goals))
            self._match_frames(goal)
        except MessageError as error:
            self._refuse(info, error)
            return
        self._accept(goal)

    def _refuse(self, info: GoalInfo, error: MessageError) -> None:
        """Report a goal as aborted; the active one goes on."""
        self.log_event_warning('goal refused', f'goal refused: {error}')
        self._publish_status(info, GoalStatus.STATUS_ABORTED)
        if self._goal is not None:
            # What is latched last must be what goes on.
            self._publish_status(self._goal.info, self._goal_status(self._goal))

    def _accept(self, goal: Goal) -> None:
        """Replace the active goal, if there is one."""
        if self._goal is not None:
            self._publish_status(self._goal.info, GoalStatus.STATUS_CANCELED)
        if not self._driving:
            # A robot that moves is watched already; a new goal is no sign of life of its odometry.
            self._watchdog.start(nanoseconds(self.parameters.odom_timeout))
        self._goal = goal
        self._publish_status(goal.info, GoalStatus.STATUS_ACCEPTED)
        x, y, _ = goal.waypoints.poses[-1]
        more = f' by way of {count} more' if (count := len(goal.waypoints.poses) - 1) else ''
        self.log_event_info('goal accepted', f'goal accepted: x {x:.3f}, y {y:.3f}{more}')

    def _match_frames(self, goal: Goal) -> None:
        if goal.frame and self._odom_frame and goal.frame != self._odom_frame:
            raise MessageError(
                f"it must be given in the frame of the odometry, '{printable(self._odom_frame)}' "
                f"or '' for it, got '{printable(goal.frame)}'"
            )

    def _on_cancel(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._goal is None:
            response.message = 'no goal is active'
            return response
        self._publish_command(0.0, 0.0)
        self._end(GoalStatus.STATUS_CANCELED, 'canceled')
        response.success, response.message = True, 'goal canceled, zero sent'
        return response

    def _end(self, status: int, what: str) -> None:
        """Let go of the active goal, the robot standing."""
        if self._driving:
            self._publish_command(0.0, 0.0)
        if self._goal is not None:
            self._publish_status(self._goal.info, status)
            self._goal = None
            self._watchdog.stop()
            self.log_event_info(f'goal {what}', f'goal {what}')

    def _publish_status(self, info: GoalInfo, status: int) -> None:
        self._status.publish(GoalStatus(goal_info=info, status=status))

    @staticmethod
    def _goal_status(goal: Goal) -> int:
        return int(GoalStatus.STATUS_EXECUTING if goal.executing else GoalStatus.STATUS_ACCEPTED)

    # --- Control

    def _on_odometry(self, message: Odometry) -> None:
        goal = self._goal
        try:
            pose = messages.from_pose(message.pose.pose)
            underway = self._driving or (goal is not None and goal.executing)
            if underway and message.header.frame_id != self._odom_frame:
                raise MessageError(
                    f"it must stay in frame '{printable(self._odom_frame)}', "
                    f"got '{printable(message.header.frame_id)}'"
                )
            if goal is not None and self.now() == 0:
                raise MessageError('simulated time has not begun, nothing came on /clock')
        except MessageError as error:
            self.get_logger().warning(f'odometry dropped: {error}', throttle_duration_sec=THROTTLE)
            return
        self._odom_frame = message.header.frame_id
        if goal is None:
            return
        self._watchdog.feed(self.now())
        if not goal.executing and not self._begin(goal):
            return
        if goal.stale:
            goal.stale = False
            self.log_event_info('odometry is back', 'odometry is back: driving on')
        goal.waypoints, command = goal.waypoints.follow(
            pose, self._law, self._arrival, self.parameters.kp
        )
        if command is None:
            self._publish_command(0.0, 0.0)
            self._end(GoalStatus.STATUS_SUCCEEDED, 'reached')
            return
        # Without wheels in the limits the geometry of the wheels does not matter.
        self._publish_command(*saturate(*command, self._limits))

    def _begin(self, goal: Goal) -> bool:
        """Begin to drive, now that the odometry's frame is known."""
        try:
            self._match_frames(goal)
        except MessageError as error:
            self.log_event_warning('goal refused', f'goal refused: {error}')
            self._end(GoalStatus.STATUS_ABORTED, 'refused')
            return False
        goal.executing = True
        self._publish_status(goal.info, GoalStatus.STATUS_EXECUTING)
        return True

    def _on_stale_odometry(self) -> None:
        """Stop the robot that is no longer seen; the goal stays, and odometry may come back."""
        goal = self._goal
        if goal is None:
            return
        topic, timeout = self.resolve_topic_name('odom'), self.parameters.odom_timeout
        goal.stale = goal.executing
        if self._driving:
            self._publish_command(0.0, 0.0)
            self.log_event_warning(
                'odometry is stale',
                f'no valid odometry on {topic} for {timeout:g} s: zero sent, waiting',
            )
        else:
            self.log_event_warning(
                'goal waits', f'the goal waits for odometry on {topic}: is the robot running?'
            )

    def _publish_command(self, v: float, omega: float) -> None:
        self._driving = (v, omega) != (0.0, 0.0)
        if isinstance(self._message, TwistStamped):
            # No frame: the twist is the robot's own, and its name is not ours to know.
            messages.set_twist_stamped(self._message, (v, omega), self.now())
        else:
            messages.set_twist(self._message, (v, omega))
        self._cmd_vel.publish(self._message)

    def stop(self, why: str) -> None:
        """Send zero and give the goal up, if there is one."""
        if self._goal is not None:
            self._publish_command(0.0, 0.0)
            self._end(GoalStatus.STATUS_CANCELED, f'given up: {why}')
            self.flush(self._cmd_vel)
            self.flush(self._status)

    # --- Parameters

    def parameters_changed(self, previous: GoToGoalParameters) -> None:
        """Control on with the new parameters."""
        driven = previous.controller, self._arrival.offset
        self._configure()
        goal = self._goal
        if goal is None:
            return
        if (self.parameters.controller, self._arrival.offset) != driven:
            # Another point of the robot may have to arrive, or another law decides how.
            goal.waypoints = goal.waypoints.resumed()
        if self.parameters.odom_timeout != previous.odom_timeout:
            self._watchdog.start(nanoseconds(self.parameters.odom_timeout))

    def _configure(self) -> None:
        """Make from the parameters what every step needs."""
        parameters = self.parameters
        self._law = LAWS[parameters.controller](parameters)
        # Far from the goal the law may ask for more than any robot believes.
        self._limits = parameters.limits()
        self._arrival = Arrival(
            xy_tolerance=parameters.xy_goal_tolerance,
            yaw_tolerance=parameters.yaw_goal_tolerance,
            # A law that takes the heading on its way must not stop short of it.
            use_heading=parameters.use_goal_heading or parameters.controller == 'pose',
            offset=parameters.offset if parameters.controller == 'offset_point' else 0.0,
        )
        if self._limits.max_v == 0.0:
            self.log_event_warning(
                'max_v',
                'linear.x.max_velocity is 0: the robot may not drive forward, goals stay out of reach',
            )
        if self._limits.min_v == 0.0 and parameters.controller == 'offset_point':
            self.log_event_warning(
                'min_v',
                'linear.x.min_velocity is 0: the robot may not back up, which controller offset_point '
                'does where the goal lies behind; it may come to rest before the goal',
            )
        if 0.0 in (self._limits.min_omega, self._limits.max_omega):
            self.log_event_warning(
                'omega',
                'angular.z.min_velocity or max_velocity is 0: the robot may turn one way only or not at '
                'all, goals and headings may stay out of reach',
            )
        self._judge_gains()

    def _judge_gains(self) -> None:
        kp, kv = self.parameters.kp, self.parameters.kv
        if self.parameters.controller == 'pose' and kp <= 2.0 * kv:
            self.log_event_warning(
                'gains',
                f'kp {kp:g} is not larger than twice kv {kv:g}: the robot is at the position before it '
                'has the heading, and turns in place there; choose kp > 2 kv',
            )
        elif self.parameters.controller == 'go_to_goal' and kp <= kv:
            self.log_event_warning(
                'gains',
                f'kp {kp:g} is not larger than kv {kv:g}: the robot approaches faster than it turns '
                'and spirals in; choose kp > kv',
            )
