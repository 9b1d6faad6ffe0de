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

"""One robot of the page, whoever drives it: its state, the commands of the page, driving it by hand.

Imports no ROS.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Path
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.live import settings
from diffdrive_jacobian.live.commands import (
    CancelGoal,
    ClearPath,
    Command,
    DriveByHand,
    Place,
    Release,
    Reset,
    SendGoal,
    SetParameter,
)
from diffdrive_jacobian.live.hand import DEAD_MAN, STANDSTILL, Act, HandDriving
from diffdrive_jacobian.live.robot_state import GoalEnd, RobotState
from diffdrive_jacobian.live.session import Session
from diffdrive_jacobian.live.settings import Range
from diffdrive_jacobian.messages.codecs import Route, Status
from diffdrive_jacobian.messages.conversion import MAX_WAYPOINTS
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes.stopping import rolls_on
from diffdrive_jacobian.parameters.chosen_law import ignores_heading
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS

ANSWER_PATIENCE = 1.0
"""Time within which a controller reports the status of a goal (s)."""
COMMAND_LIFE = 0.5
"""Time for which a cmd_vel is shown after it was received (s)."""
SERVICES = {
    'cancel_goal': 'the goal cannot be canceled',
    'reset_odometry': 'the odometry cannot be reset',
}
"""Services of a robot, and what it means if they fail."""


class SteeredRobot(ABC):
    """What is known of one robot, and doing what the page asks for."""

    def __init__(self, session: Session, name: str, clock: Callable[[], float]) -> None:
        """Start without messages.

        Args:
            session: Receives notices.
            name: Namespace of the robot, `/` or `/NAME`.
            clock: Returns the time in which the robot publishes (s): simulated time may stand.
        """
        self._session, self._clock = session, clock
        self.state = RobotState(name)
        self.hand = HandDriving()
        self._seen = self._commanded = clock()
        self._sent, self._stamp = -np.inf, 0
        self.on_end: Callable[[GoalEnd], None] | None = None
        """Receives the end of each goal that was sent. None: nothing does."""

    # --- Of a subclass

    @abstractmethod
    def now(self) -> int:
        """Return the time of the robot (ns)."""

    @property
    @abstractmethod
    def ready(self) -> bool:
        """Whether a controller can receive goals, and the robot has odometry."""

    @abstractmethod
    def hears(self, name: str) -> str:
        """Return who does not listen to a topic; '': somebody does."""

    @abstractmethod
    def publish_twist(self, twist: tuple[float, float], now: int) -> None:
        """Publish a command, at a time (ns)."""

    @abstractmethod
    def publish_goals(
        self, topic: str, poses: NDArray[np.float64], now: int, times: NDArray[np.float64] | None = None
    ) -> None:
        """Publish goals or a path; the arguments are those of `nodes.goal_client.goals_message`."""

    @abstractmethod
    def publish_pose(self, pose: NDArray[np.float64], now: int) -> None:
        """Publish where the robot is, `[x, y, theta]` in the frame of its odometry, at a time (ns)."""

    @abstractmethod
    def call(self, service: str, failed: Callable[[str], None]) -> None:
        """Call one of SERVICES. `failed` receives the reason if it does nothing."""

    @abstractmethod
    def has(self, role: str) -> bool:
        """Return whether there is a node with a role."""

    @abstractmethod
    def set_parameter(
        self, role: str, name: str, value: float | str | bool, refused: Callable[[str], None]
    ) -> None:
        """Set a parameter of the node with a role, which there is.

        `refused` receives the reason if the node does not accept it.
        """

    # --- Messages

    @property
    def silence(self) -> float:
        """Time since the last odometry (s)."""
        return self._clock() - self._seen

    def on_goals(self, route: Route) -> None:
        """Take goals that somebody has sent."""
        self.state.goal.sent(np.reshape(route.poses, (-1, 3)), route.stamp)

    def on_path(self, route: Route) -> None:
        """Take a path that somebody has sent. One that is no path is refused by the controller."""
        with suppress(ValueError):
            times = None if route.times is None else np.array(route.times)
            self.state.goal.sent(Path(np.array(route.poses), times), route.stamp)

    def on_status(self, one: Status) -> None:
        """Take a status of the controller."""
        changed = self.state.goal.reported(one.status, one.stamp)
        # The latched status of a goal that was sent before is no news.
        if changed is None or changed.goal is None or not changed.fate.is_end:
            return
        if self.on_end is not None:
            self.on_end(self.state.goal_end(changed))
        if changed.state is GoalState.ABORTED:
            self.warn('the controller refused or aborted the goal: its log says why')

    # --- Commands of the page

    def obey(self, page: int, command: Command) -> None:
        """Do what a page asks for."""
        if isinstance(command, SendGoal):
            self._send_goal(command)
        elif isinstance(command, DriveByHand):
            if not self.hand.command(page, (command.v, command.omega), time.monotonic()):
                self.warn('another page drives this robot by hand')
        elif isinstance(command, Release):
            self.hand.release(page)
        elif isinstance(command, CancelGoal):
            self.cancel()
        elif isinstance(command, Reset):
            self._call('reset_odometry')
            self.state.interrupt()
        elif isinstance(command, Place):
            if missing := self.hears('initialpose'):
                self.warn(f'{missing}: not placed')
            else:
                self.publish_pose(np.array([command.x, command.y, command.theta]), self.now())
                self.state.interrupt()
        elif isinstance(command, ClearPath):
            self.state.clear_path()
        elif isinstance(command, SetParameter):
            self._set(command)

    def _send_goal(self, command: SendGoal) -> None:
        if self.hand.page is not None:
            self.warn('the robot is driven by hand: release the keys before you send a goal')
            return
        state = self.state
        if command.append and state.goal.active and state.goal.path is not None:
            self.warn('a path is driven along: it takes no further waypoint; a goal replaces it')
            return
        fresh = time.monotonic() - self._sent < ANSWER_PATIENCE
        remaining = state.goal.remaining(fresh=fresh) if command.append else np.empty((0, 3))
        x, y = command.x, command.y
        before = remaining[-1] if len(remaining) else state.pose
        theta = command.theta
        if theta is None:
            theta = 0.0 if before is None else float(np.arctan2(y - before[1], x - before[0]))
        goals = np.vstack([remaining, [x, y, theta]])
        together = len(goals) > 1
        if len(goals) > MAX_WAYPOINTS:
            self.warn(f'a robot takes at most {MAX_WAYPOINTS} waypoints')
        elif missing := self.hears('goals' if together else 'goal_pose'):
            self.warn(f'{missing}: is go_to_goal running?')
        else:
            self.send(goals, together=together)
            values = state.controller_values
            if command.theta is not None and ignores_heading(values):
                self.warn(
                    f'{values["controller"]} ignores the heading of the goal: switch on Goal heading, '
                    'or choose the control law pose'
                )

    def _set(self, command: SetParameter) -> None:
        role, _, name = command.parameter.partition('/')
        if not self.has(role):
            self.warn(f'there is no {printable(role, 40)} to set {printable(name, 40)} of')
            return
        try:
            setting = settings.find(command.parameter, self.state.controller_values)
            value = setting.checked(command.value)
        except settings.SettingError as error:
            self.warn(str(error))
            return

        def refused(reason: str) -> None:
            self._session.notify(f'{setting.name} refused: {reason}', 'error')

        self.set_parameter(role, setting.name, value, refused)

    def _call(self, service: str) -> None:
        self.call(service, lambda reason: self.warn(f'{SERVICES[service]}: {reason}'))

    def warn(self, text: str) -> None:
        """Show a warning on all pages."""
        self._session.notify(text, 'warning')

    # --- Driving by hand

    def drive(self) -> None:
        """Drive by hand, if a page does; to be called often."""
        clocks = time.monotonic(), self.now() / NANOSECONDS
        # Nobody cancels the goal of a controller that has ended.
        active = self.state.goal.active and self.state.controlled
        act = self.hand.update(*clocks, self._session.is_open, active)
        if act is Act.PUBLISH:
            self.publish_twist(self.hand.twist, self.now())
        elif act in (Act.STOP, Act.EXPIRE):
            self.publish_twist(STANDSTILL, self.now())
            rolling = self._rolls_on()
            if act is Act.EXPIRE:
                self.warn(
                    f'the page was silent for {DEAD_MAN:g} s, driving by hand has ended: release the '
                    f'keys before you drive again{rolling}'
                )
            elif rolling:
                self._session.notify(f'driving by hand has ended, zero was sent{rolling}')
        elif act is Act.CANCEL_GOAL:
            self._session.notify('driving by hand: the goal is canceled')
            self._call('cancel_goal')
        elif act is Act.GIVE_UP:
            if self.hand.moved:
                self.publish_twist(STANDSTILL, self.now())
            self.warn('the controller did not cancel its goal: the robot is not driven by hand')

    def _rolls_on(self) -> str:
        """Describe how far the robot rolls after zero was sent, as far as its limits are known."""
        try:
            model = VirtualRobotParameters().changed(self.state.robot_values).model()
        except ParameterError:
            # The robot is another node, with parameters of the same names.
            return ''
        return rolls_on(model.actuators, self.hand.twist, model)

    def cancel(self) -> None:
        """Cancel a goal or path."""
        self._call('cancel_goal')

    def stop(self) -> None:
        """Stop what a page drives."""
        if self.hand.page is not None:
            self.publish_twist(STANDSTILL, self.now())

    # --- State

    def send(
        self, goals: NDArray[np.float64] | Path, *, together: bool = True, relative: bool = False
    ) -> None:
        """Send goals or a path.

        Args:
            goals: `[x, y, theta]` of each, shape (n, 3) (m, m, rad), or a path.
            together: Whether to use the topic goals. Otherwise there is one, which goal_pose takes.
            relative: Whether they are in the body frame of the robot, which has odometry.
        """
        times = goals.times if isinstance(goals, Path) else None
        poses = goals.poses if isinstance(goals, Path) else goals
        if relative and self.state.pose is not None:
            poses = se2.compose(self.state.pose, poses)
        # The stamp distinguishes goals, also while simulated time stands.
        now = self._stamp = max(self.now(), self._stamp + 1)
        stamp = divmod(now, NANOSECONDS)
        # At once: the next command may append a waypoint.
        if isinstance(goals, Path):
            self.publish_goals('path', poses, now, times)
            self.state.goal.sent(Path(poses, times), stamp)
        else:
            self.publish_goals('goals' if together else 'goal_pose', poses, now)
            self.state.goal.sent(poses, stamp)
        self._sent = time.monotonic()

    def shown(self) -> dict[str, Any] | None:
        """Return the JSON object for the page."""
        return self.state.shown(age=self.silence, by_hand=self.hand.page is not None)

    def settings(self) -> list[dict[str, Any]]:
        """Return the settings for the page."""
        return self.state.settings(self.ranges(), imported=True)

    def ranges(self) -> Mapping[str, Mapping[str, Range]]:
        """Return the ranges that the nodes serve, by role. Those of this package need none."""
        return {}
