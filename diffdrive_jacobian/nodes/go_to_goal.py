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

"""Drive a robot to goals and along paths: odometry, goals and paths in, body twists out."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from action_msgs.msg import GoalInfo, GoalStatus
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry
from nav_msgs.msg import Path as PathMessage
from std_srvs.srv import Trigger
from unique_identifier_msgs.msg import UUID

from diffdrive_jacobian.control import Arrival, Controller, PathController
from diffdrive_jacobian.messages.codecs import (
    GOALS,
    ODOMETRY_STATE,
    PATH,
    POSE,
    TWIST,
    TWIST_STAMPED,
    Command,
    GoalError,
    Route,
    State,
)
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.topic_faults import OF_SOMEBODY_ELSE, SEVERAL, UNREAD
from diffdrive_jacobian.nodes.advice import (
    gain_warnings,
    limit_warnings,
    path_warnings,
    rate_warnings,
)
from diffdrive_jacobian.nodes.odometry_rate import OdometryRate
from diffdrive_jacobian.nodes.other_drivers import PERIOD, OtherDrivers
from diffdrive_jacobian.nodes.steering import STANDSTILL, Goal, Pursuit, Steering
from diffdrive_jacobian.nodes.stopping import rolls_on
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.ros.graph_faults import topic_check
from diffdrive_jacobian.ros.node import NO_CLOCK, ParameterizedNode
from diffdrive_jacobian.ros.watchdog import Watchdog
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import nanoseconds

__all__ = ['GoToGoal']


@dataclass(slots=True)
class ActiveGoal:
    """A goal that was accepted."""

    info: GoalInfo
    """By what its status is known."""
    pursuit: Pursuit
    executing: bool = False
    """Whether odometry was received after it was accepted."""
    stale: bool = False
    """Whether the robot is stopped because odometry is missing."""


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
        defaults = GoToGoalParameters().with_laws(controller, path_controller)
        super().__init__('go_to_goal', defaults, **kwargs)
        self._goal: ActiveGoal | None = None
        self._goals_received = 0
        self._state = State((0, 0), '', (0.0, 0.0, 0.0), STANDSTILL)
        # Whether the last odometry was ignored because it was older than the previous one.
        self._was_older = False
        self._rate = OdometryRate()
        # Whether the last command makes the robot move: it outlives a goal that is replaced.
        self._driving = False
        stamped = self.parameters.enable_stamped_cmd_vel
        self._cmd_vel = self.advertise(TwistStamped if stamped else Twist, 'cmd_vel')
        self._status = self.advertise(GoalStatus, 'goal_status', latched=True)
        self.subscribe(Odometry, 'odom', self._on_odometry, codec=ODOMETRY_STATE, called='odometry')
        refused = self._on_invalid_goals
        self.subscribe(PoseStamped, 'goal_pose', self._on_pose, codec=POSE, refused=refused)
        self.subscribe(Goals, 'goals', self._on_goals, codec=GOALS, refused=refused)
        self.subscribe(PathMessage, 'path', self._on_path, codec=PATH, refused=refused)
        self.provide(Trigger, 'cancel_goal', self._on_cancel)
        # Without a frame: the twist is in the body frame, whose name this node does not know.
        self._write_command = TWIST_STAMPED.writer(TwistStamped()) if stamped else TWIST.writer(Twist())
        self._watchdog = Watchdog(self, self._on_stale_odometry)
        self._others = OtherDrivers(self, self._cmd_vel, self._on_other_driver)
        self._advised: set[str] = set()
        self._steering = self._steer(None)

        def readers() -> int:
            return int(self._cmd_vel.get_subscription_count()) - self._others.subscriptions

        self.watch(topic_check(self, UNREAD, 'cmd_vel', readers))
        self.watch(topic_check(self, SEVERAL, 'odom'))
        self.watch(topic_check(self, SEVERAL, 'goal_status'))
        self.announce(subscribed=['goal_pose', 'goals', 'path'], publishing=['cmd_vel'])

    @property
    def waypoint(self) -> int | None:
        """Index of the pose of the active goal that is driven to; None without a goal."""
        return None if self._goal is None else self._goal.pursuit.index

    @property
    def arrival(self) -> Arrival:
        """Arrival criterion according to the parameters."""
        return self._steering.arrival

    # --- Odometry

    def _on_odometry(self, state: State) -> None:
        """Answer with the next command towards the goal."""
        goal, now = self._goal, self.now()
        if state.frame != self._state.frame and (self._driving or (goal is not None and goal.executing)):
            raise MessageError(
                f"it must stay in frame '{printable(self._state.frame)}', got '{printable(state.frame)}'"
            )
        if goal is not None and now == 0:
            raise MessageError(NO_CLOCK)
        if state.stamp <= self._state.stamp and self._repeats(state):
            return
        self._state, self._was_older = state, False
        if goal is None:
            return
        self._watchdog.feed(now)
        if not 0 <= now - self._others.searched < PERIOD:
            self._others.search(now)
        if not self._rate.measured and self._rate.receive(now):
            self._advise_of_rate()
        if not goal.executing and not self._begin(goal, state):
            return
        if goal.stale:
            goal.stale = False
            self._steering.reset()
            self.log_event_info('odometry is back', 'odometry is received again: driving on')
        before = goal.pursuit
        try:
            goal.pursuit, command = self._steering.command(before, state, now, self._rate.hz)
        except ValueError as error:
            self.log_event_warning('law', f'goal aborted: {error}')
            self._end(GoalStatus.STATUS_ABORTED, 'aborted')
            return
        if goal.pursuit.missed and not before.missed:
            self._warn_of_waypoint(goal.pursuit)
        if command is None:
            self._end(GoalStatus.STATUS_SUCCEEDED, f'reached{goal.pursuit.lateness(now)}')
            return
        self._publish_command(command, now)

    def _repeats(self, state: State) -> bool:
        """Return whether odometry is a repetition or out of order, and log and note the latter.

        Stamps of zero, and equal stamps with different poses, tell nothing. A repetition may begin a
        goal. After two older messages in a row, or when odometry was missing, the source has started
        again, or the clock was reset.
        """
        goal = self._goal
        if state.stamp == (0, 0):
            return False
        if state.stamp == self._state.stamp:
            return goal is not None and goal.executing and state == self._state
        if self._was_older or (goal is not None and goal.stale):
            return False
        self._was_older = True
        self.log_event_warning(
            'odometry is old',
            f'odometry on {self.resolve_topic_name("odom")} is ignored: older than the previous one',
        )
        return True

    def _begin(self, goal: ActiveGoal, state: State) -> bool:
        """Start executing a goal, now that the frame of the odometry and the pose are known."""
        try:
            self._match_frames(goal.pursuit.goal)
            goal.pursuit = self._steering.begin(goal.pursuit, state.pose)
        except ValueError as error:
            self.log_event_warning('goal refused', f'goal refused: {error}')
            self._end(GoalStatus.STATUS_ABORTED, 'refused', unless_silent=True)
            return False
        goal.executing = True
        self._publish_status(goal.info, GoalStatus.STATUS_EXECUTING)
        return True

    def _match_frames(self, goal: Goal) -> None:
        frame = self._state.frame
        if goal.frame and frame and goal.frame != frame:
            raise MessageError(
                f"it must be given in the frame of the odometry, '{printable(frame)}' "
                f"or '' for it, got '{printable(goal.frame)}'"
            )

    def _on_stale_odometry(self) -> None:
        """Stop the robot because odometry is missing, and keep the goal."""
        goal = self._goal
        if goal is None:
            return
        topic, timeout = self.resolve_topic_name('odom'), self.parameters.odom_timeout
        goal.stale = goal.stale or goal.executing
        if self._driving:
            self._stop_robot()
            self.log_event_warning(
                'odometry is stale',
                f'no valid odometry on {topic} for {timeout:g} s: robot stopped, waiting'
                f'{self._rolls_on()}',
            )
        else:
            self.log_event_warning(
                'goal waits', f'the goal waits for odometry on {topic}: is the robot running?'
            )

    # --- Goals

    def _on_pose(self, route: Route) -> None:
        self._accept_or_refuse('goal_pose', route, Goal.through)

    def _on_goals(self, route: Route) -> None:
        self._accept_or_refuse('goals', route, Goal.through)

    def _on_path(self, route: Route) -> None:
        self._accept_or_refuse('path', route, Goal.along_path)

    def _on_invalid_goals(self, error: MessageError) -> None:
        assert isinstance(error, GoalError)
        self._refuse(self._new_info(error.stamp), error)

    def _accept_or_refuse(self, topic: str, route: Route, goal_of: Callable[[Route], Goal]) -> None:
        for pose in route.poses:
            self.warn_of_integers(f'a pose on {topic}', *pose)
        info = self._new_info(route.stamp)
        try:
            goal = goal_of(route)
            self._match_frames(goal)
        except ValueError as error:
            self._refuse(info, error)
            return
        self._accept(ActiveGoal(info, Pursuit.of(goal)))

    def _new_info(self, stamp: tuple[int, int]) -> GoalInfo:
        """Return a new identifier of a goal, with its stamp."""
        # Runs in lockstep are the same each time.
        self._goals_received += 1
        origin = f'{self.get_fully_qualified_name()}/{self.now()}/{self._goals_received}'
        identifier = UUID(uuid=list(uuid.uuid5(uuid.NAMESPACE_URL, origin).bytes))
        return GoalInfo(goal_id=identifier, stamp=Time(sec=stamp[0], nanosec=stamp[1]))

    def _refuse(self, info: GoalInfo, error: ValueError) -> None:
        """Publish that a goal is aborted. The active goal is kept."""
        self.log_event_warning('goal refused', f'goal refused: {error}')
        self._publish_status(info, GoalStatus.STATUS_ABORTED)
        if self._goal is not None:
            # The last latched status must be that of the active goal.
            executing = self._goal.executing
            status = GoalStatus.STATUS_EXECUTING if executing else GoalStatus.STATUS_ACCEPTED
            self._publish_status(self._goal.info, status)

    def _accept(self, goal: ActiveGoal) -> None:
        """Replace the active goal, if there is one. On the same path the robot goes on where it is."""
        before = self._goal
        if before is not None:
            self._publish_status(before.info, GoalStatus.STATUS_CANCELED)
        if before is not None and before.pursuit.goal.is_same_path(goal.pursuit.goal):
            goal.pursuit, goal.stale = before.pursuit, before.stale
        else:
            self._steering.reset()
            self._rate.begin()
        if not self._driving:
            # While the robot moves the watchdog runs already, and a new goal is no sign of odometry.
            self._watchdog.start(nanoseconds(self.parameters.odom_timeout))
        self._goal = goal
        self._others.start()
        self._publish_status(goal.info, GoalStatus.STATUS_ACCEPTED)
        self.log_event_info('goal accepted', f'goal accepted: {goal.pursuit.goal}')
        self._advise()

    def _end(self, status: int, what: str, *, unless_silent: bool = False) -> None:
        """Stop the robot and end the active goal.

        `unless_silent`: only if it was this node that moved the robot. Others may drive it.
        """
        if self._driving or not unless_silent:
            self._stop_robot()
        if self._goal is not None:
            self._publish_status(self._goal.info, status)
            self._goal = None
            self._watchdog.stop()
            self._others.stop()
            self.log_event_info(f'end {status}', f'goal {what}')

    # --- Stopping

    def _on_cancel(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._goal is None:
            response.message = 'no goal is active'
            return response
        self._end(GoalStatus.STATUS_CANCELED, f'canceled{self._rolls_on()}')
        response.success, response.message = True, f'goal canceled, zero sent{self._rolls_on()}'
        return response

    def _on_other_driver(self, names: list[str]) -> None:
        """Cancel the goal: whoever drives by hand takes over."""
        topic, who, hint = self._cmd_vel.topic_name, ' or '.join(names), ''
        if self.get_fully_qualified_name() in names:
            who, hint = f'another {who}', f'; {OF_SOMEBODY_ELSE}'
        self.log_event_warning(
            'other driver',
            f'{who} drives the robot by {topic}, so the goal is canceled: send it again later, or '
            f'remap the topic of the other one{hint}',
        )
        # Or the robot might follow the last command of this node.
        self._end(GoalStatus.STATUS_CANCELED, 'canceled', unless_silent=True)

    def stop(self, why: str) -> None:
        """Stop the robot and cancel the goal, if there is one."""
        if self._goal is not None:
            self._end(GoalStatus.STATUS_CANCELED, f'canceled: {why}{self._rolls_on()}')
            self.flush(self._cmd_vel)
            self.flush(self._status)

    def _rolls_on(self) -> str:
        """Describe how far the robot rolls after zero was sent, as far as its limits are known."""
        return rolls_on(self._steering.actuators, self._state.twist)

    # --- Publishing

    def _publish_command(self, twist: tuple[float, float], now: int) -> None:
        """Publish a command at a time (ns)."""
        self._driving = twist != STANDSTILL
        data = self._write_command(Command(twist, now))
        self._others.sent(data)
        self._cmd_vel.publish(data)

    def _stop_robot(self) -> None:
        now = self.now()
        self._steering.stopped(now)
        self._publish_command(STANDSTILL, now)

    def _publish_status(self, info: GoalInfo, status: int) -> None:
        self._status.publish(GoalStatus(goal_info=info, status=status))

    # --- Parameters

    def parameters_changed(self, previous: GoToGoalParameters) -> None:
        """Apply the new parameters; an active goal is kept."""
        before, goal = self._steering, self._goal
        self._steering = self._steer(before)
        self._advise()
        if goal is None:
            return
        if self._steering.drives_otherwise(before):
            goal.pursuit = goal.pursuit.resumed()
        if self.parameters.odom_timeout != previous.odom_timeout:
            self._watchdog.change_timeout(nanoseconds(self.parameters.odom_timeout))

    def _steer(self, before: Steering | None) -> Steering:
        """Return what the parameters choose, and warn of limits that do not suit."""
        steering = Steering(self.parameters, before)
        self._advised.clear()
        self._log_once('limits', limit_warnings(self.parameters.limits()))
        return steering

    def _advise(self) -> None:
        """Warn of gains that do not suit for the goal; without one, of all."""
        self._advise_of_rate()
        goal = None if self._goal is None else self._goal.pursuit.goal
        if goal is None or goal.path is None:
            self._log_once('gains', gain_warnings(self.parameters))
        passing = goal is not None and self.parameters.pass_waypoints and len(goal.poses) > 1
        if goal is None or goal.path is not None or passing:
            self._log_once('paths', path_warnings(self.parameters))

    def _advise_of_rate(self) -> None:
        """Warn of gains that are too large for the rate of the odometry, unless a path is driven."""
        if self._goal is None or self._goal.pursuit.goal.path is None:
            self._log_once('rate', rate_warnings(self.parameters, self._rate.hz))

    def _log_once(self, kind: str, warnings: list[str]) -> None:
        """Log each warning of a kind that was not logged since the parameters were changed."""
        for number, warning in enumerate(warnings):
            if warning not in self._advised:
                self._advised.add(warning)
                self.log_event_warning(f'{kind} {number}', warning)

    def _warn_of_waypoint(self, pursuit: Pursuit) -> None:
        self.log_event_warning(
            'waypoint missed',
            f'waypoint {pursuit.index + 1} of {len(pursuit.goal.poses)} was passed at more than '
            f'waypoint_tolerance, {self.parameters.waypoint_tolerance:g} m: driving to it and those '
            'after it one by one',
        )
