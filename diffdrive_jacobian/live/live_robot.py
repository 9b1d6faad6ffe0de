"""One robot of the page: its topics, services and parameters, and driving it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

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
from diffdrive_jacobian.live.robot_state import GoalEnd, GoalProgress, RobotState
from diffdrive_jacobian.live.robot_topics import RobotTopics
from diffdrive_jacobian.live.session import Session
from diffdrive_jacobian.messages.codecs import GOAL_STATUS, GOALS, PATH, POSE, Motion, Route, Status
from diffdrive_jacobian.messages.conversion import MAX_WAYPOINTS, MessageError, from_covariance
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes.remote_goal import ignores_heading
from diffdrive_jacobian.nodes.stopping import rolls_on
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.recording.parameter_query import ParameterQuery
from diffdrive_jacobian.ros.service_client import ServiceClient, ignore
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS, seconds

PATIENCE = 3.0
"""Longest wait for the answer of a node (s)."""
COMMAND_LIFE = 0.5
"""Time for which a cmd_vel is shown after it was received (s)."""
ANSWER_PATIENCE = 1.0
"""Time within which a controller reports the status of a goal (s)."""
SERVICES = {
    'cancel_goal': 'the goal cannot be canceled',
    'reset_odometry': 'the odometry cannot be reset',
}
"""Services of a robot, and what it means if they fail."""


class ParameterLink:
    """Reads and sets parameters of one node."""

    def __init__(self, node: Node, target: str, gid: bytes) -> None:
        """Query the values of the node with a fully qualified name, and a publisher of this GID."""
        self.target, self.gid = target, gid
        self.values: dict[str, Any] = {}
        """Values by name, as far as they are known."""
        self.ranges: dict[str, settings.Range] = {}
        """Ranges of doubles by name, as far as their descriptors have one."""
        self._known: set[str] = set()
        self._undescribed: list[str] = []
        self._query = ParameterQuery(node, target, self.changed, ignore)
        client = partial(ServiceClient, node, patience=PATIENCE, server=printable(target))
        self._describe = client(DescribeParameters, f'{target}/describe_parameters')
        self._set = client(SetParameters, f'{target}/set_parameters')

    def advance(self) -> None:
        """Ask, and check for answers that are late; to be called often."""
        self._query.advance()
        if self._undescribed and self._describe.ready:
            names, self._undescribed = self._undescribed, []
            request = DescribeParameters.Request(names=names)
            self._describe.call(request, partial(self._on_descriptors, names), ignore)
        self._describe.advance()
        self._set.advance()

    def destroy(self) -> None:
        """Destroy the clients. Who waits for an answer gets a refusal."""
        for client in (self._query, self._describe, self._set):
            client.destroy()

    def changed(self, values: Mapping[str, Any]) -> None:
        """Take values from the node itself or from a parameter event."""
        self.values.update(values)
        new = [name for name, value in values.items() if isinstance(value, float)]
        self._undescribed += [name for name in new if name not in self._known]
        self._known.update(new)

    def set(self, name: str, value: float | str | bool, on_refusal: Callable[[str], object]) -> None:
        """Set a parameter. `on_refusal` receives the reason if the node does not accept it."""

        def on_response(response: Any) -> None:
            result = next(iter(response.results), None)
            if result is None:
                on_refusal('its answer cannot be read')
            elif result.successful:
                self.values[name] = value
            else:
                on_refusal(printable(result.reason, 300))

        parameter = Parameter(name, value=value).to_parameter_msg()
        self._set.call(SetParameters.Request(parameters=[parameter]), on_response, on_refusal)

    def _on_descriptors(self, names: list[str], response: Any) -> None:
        # A node that lacks one of the parameters sends no descriptors at all.
        for name, descriptor in zip(names, response.descriptors, strict=False):
            for one in descriptor.floating_point_range[:1]:
                if -math.inf < one.from_value < one.to_value < math.inf:
                    self.ranges[name] = one.from_value, one.to_value


class LiveRobot:
    """Follows one robot, and does what the page asks for."""

    def __init__(
        self,
        node: Node,
        session: Session,
        namespace: str,
        names: dict[str, str],
        *,
        polled: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Subscribe to the topics of a robot.

        Args:
            node: The node that subscribes.
            session: Receives notices.
            namespace: Namespace of the robot, `/` or `/NAME`.
            names: As for `RobotTopics`.
            polled: As for `Latest`.
            clock: Returns the time in which the robot publishes (s): simulated time may stand.

        Raises:
            ParameterError: A topic has another type in this process.
        """
        self._node, self._session, self._clock = node, session, clock
        self.state = RobotState(namespace)
        self.topics = RobotTopics(node, namespace, names, polled=polled)
        self.topics.listen(GOAL_STATUS, 'goal_status', self._on_status, latched=True)
        self.topics.listen(POSE, 'goal_pose', self._on_goals, latched=False)
        self.topics.listen(GOALS, 'goals', self._on_goals, latched=False)
        self.topics.listen(PATH, 'path', self._on_path, latched=False)
        self.links: dict[str, ParameterLink] = {}
        """Parameters by role."""
        self.hand = HandDriving()
        # Before they are needed, so that they are discovered by then.
        self._services = {
            name: ServiceClient(node, Trigger, full, patience=PATIENCE, server=full)
            for name, full in ((name, self.topics.full(name)) for name in SERVICES)
        }
        self._frame = ''
        self._seen = self._commanded = clock()
        self._sent, self._stamp = -math.inf, 0
        self.on_end: Callable[[GoalEnd], None] | None = None
        """Receives the end of each goal that was sent. None: nothing does."""

    @property
    def silence(self) -> float:
        """Time since the last odometry (s)."""
        return self._clock() - self._seen

    # --- Messages

    def poll(self) -> None:
        """Take the latest messages."""
        now = self._clock()
        followed = {name: latest.take() for name, latest in self.topics.followed.items()}
        if followed['odom'] is not None:
            self._on_odometry(followed['odom'], now)
        if (truth := followed['ground_truth']) is not None:
            self.state.truly_moved(seconds(truth.stamp), np.array(truth.pose), truth.twist)
        if (wheels := followed['joint_states']) is not None:
            try:
                self.state.wheels = wheels.speeds(self.state.wheel_names)
            except MessageError:
                self.state.wheels = None
        command = self.topics.command.take() if self.topics.command is not None else None
        if command is not None:
            self.state.command, self._commanded = command.twist, now
        elif now - self._commanded > COMMAND_LIFE:
            self.state.command = None

    def _on_odometry(self, motion: Motion, now: float) -> None:
        try:
            covariance = from_covariance(motion.covariance)
        except MessageError:
            covariance = None
        self._seen, self._frame = now, motion.frame
        count = self.topics.followed['odom'].messages
        pose = np.array(motion.pose)
        self.state.moved(seconds(motion.stamp), pose, motion.twist, covariance, count)

    def _on_goals(self, route: Route) -> None:
        self.state.goal.sent(np.reshape(route.poses, (-1, 3)), route.stamp)

    def _on_path(self, route: Route) -> None:
        # One that is no path is refused by the controller.
        with suppress(ValueError):
            times = None if route.times is None else np.array(route.times)
            self.state.goal.sent(Path(np.array(route.poses), times), route.stamp)

    def _on_status(self, one: Status) -> None:
        changed = self.state.goal.reported(one.status, one.stamp)
        # The latched status of a goal that was sent before is no news.
        if changed is None or changed.goal is None or not changed.fate.is_end:
            return
        if self.on_end is not None:
            # Where the robot is by now.
            self.poll()
            self.on_end(self.state.goal_end(changed))
        if changed.state is GoalState.ABORTED:
            self._warn('the controller refused or aborted the goal: its log says why')

    # --- Commands of the page

    def obey(self, page: int, command: Command) -> None:
        """Do what a page asks for."""
        if isinstance(command, SendGoal):
            self._send_goal(command)
        elif isinstance(command, DriveByHand):
            if not self.hand.command(page, (command.v, command.omega), time.monotonic()):
                self._warn('another page drives this robot by hand')
        elif isinstance(command, Release):
            self.hand.release(page)
        elif isinstance(command, CancelGoal):
            self._call('cancel_goal')
        elif isinstance(command, Reset):
            self._call('reset_odometry')
            self.state.interrupt()
        elif isinstance(command, Place):
            if self.topics.readers('initialpose'):
                pose = np.array([command.x, command.y, command.theta])
                self.topics.publish_pose(pose, self._frame, self._now())
                self.state.interrupt()
            else:
                self._warn(f'nobody is subscribed to {self.topics.full("initialpose")}: not placed')
        elif isinstance(command, ClearPath):
            self.state.clear_path()
        elif isinstance(command, SetParameter):
            self._set(command)

    def _send_goal(self, command: SendGoal) -> None:
        if self.hand.page is not None:
            self._warn('the robot is driven by hand: release the keys before you send a goal')
            return
        state = self.state
        if command.append and state.goal.active and state.goal.path is not None:
            self._warn('a path is driven along: it takes no further waypoint; a goal replaces it')
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
        topic = 'goals' if together else 'goal_pose'
        if len(goals) > MAX_WAYPOINTS:
            self._warn(f'a robot takes at most {MAX_WAYPOINTS} waypoints')
        elif not self.topics.readers(topic):
            self._warn(f'nobody is subscribed to {self.topics.full(topic)}: is go_to_goal running?')
        else:
            self.send(goals, together=together)
            values = state.controller_values
            if command.theta is not None and ignores_heading(values):
                self._warn(
                    f'{values["controller"]} ignores the heading of the goal: switch on Goal heading, '
                    'or choose the control law pose'
                )

    def _set(self, command: SetParameter) -> None:
        role, _, name = command.parameter.partition('/')
        link = self.links.get(role)
        if link is None:
            self._warn(f'there is no {printable(role, 40)} to set {printable(name, 40)} of')
            return
        try:
            setting = settings.find(command.parameter, self.state.controller_values)
            value = setting.checked(command.value)
        except settings.SettingError as error:
            self._warn(str(error))
            return

        def refused(reason: str) -> None:
            self._session.notify(f'{setting.name} refused: {reason}', 'error')

        link.set(setting.name, value, refused)

    def _call(self, service: str) -> None:
        def failed(reason: str) -> None:
            self._warn(f'{SERVICES[service]}: {reason}')

        def answered(response: Any) -> None:
            if not response.success:
                failed(printable(response.message, 300))

        if self._services[service].ready:
            self._services[service].call(Trigger.Request(), answered, failed)
        else:
            failed(f'there is no service {self.topics.full(service)}')

    def _warn(self, text: str) -> None:
        self._session.notify(text, 'warning')

    def _now(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    # --- Driving by hand

    def drive(self) -> None:
        """Drive by hand, if a page does; to be called often."""
        clocks = time.monotonic(), self._now() / NANOSECONDS
        # Nobody cancels the goal of a controller that has ended.
        active = self.state.goal.active and self.state.controlled
        act = self.hand.update(*clocks, self._session.is_open, active)
        if act is Act.PUBLISH:
            self.topics.publish_twist(self.hand.twist, self._now())
        elif act in (Act.STOP, Act.EXPIRE):
            self.topics.publish_twist(STANDSTILL, self._now())
            rolling = self._rolls_on()
            if act is Act.EXPIRE:
                self._warn(
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
                self.topics.publish_twist(STANDSTILL, self._now())
            self._warn('the controller did not cancel its goal: the robot is not driven by hand')

    def _rolls_on(self) -> str:
        """Describe how far the robot rolls after zero was sent, as far as its limits are known."""
        try:
            model = VirtualRobotParameters().changed(self.state.robot_values).model()
        except ParameterError:
            # The robot is another node, with parameters of the same names.
            return ''
        return rolls_on(model.actuators, self.hand.twist, model)

    def stop(self) -> None:
        """Stop what a page drives."""
        if self.hand.page is not None:
            self.topics.publish_twist(STANDSTILL, self._now())

    # --- State

    @property
    def ready(self) -> bool:
        """Whether a controller can receive goals, and the robot has odometry."""
        return self.state.pose is not None and self.topics.readers('goals') > 0

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
        now = self._stamp = max(self._now(), self._stamp + 1)
        stamp = divmod(now, NANOSECONDS)
        # At once: the next command may append a waypoint.
        if isinstance(goals, Path):
            self.topics.publish('path', poses, now, times)
            self.state.goal.sent(Path(poses, times), stamp)
        else:
            self.topics.publish('goals' if together else 'goal_pose', poses, now)
            self.state.goal.sent(poses, stamp)
        self._sent = time.monotonic()

    def advance(self) -> None:
        """Advance queries of parameters."""
        for service in self._services.values():
            service.advance()
        for link in self.links.values():
            link.advance()

    def shown(self) -> dict[str, Any] | None:
        """Return the JSON object for the page."""
        return self.state.shown(age=self.silence, by_hand=self.hand.page is not None)

    def settings(self) -> list[dict[str, Any]]:
        """Return the settings for the page."""
        ranges = {role: link.ranges for role, link in self.links.items()}
        return self.state.settings(ranges, imported=True)

    def destroy(self) -> None:
        """Destroy all entities."""
        self.topics.destroy()
        for service in self._services.values():
            service.destroy()
        for link in self.links.values():
            link.destroy()

    def use_nodes(self, found: dict[str, tuple[str, bytes]]) -> None:
        """Take the nodes that have the parameters, by role: their names, and GIDs of their publishers.

        A node that was started again has another GID.
        """
        self.state.controlled = 'controller' in found
        for role, (name, gid) in found.items():
            link = self.links.get(role)
            if link is not None and (link.target, link.gid) == (name, gid):
                continue
            if link is not None:
                link.destroy()
                if role == 'controller':
                    # What the one before drove to ended with it.
                    self.state.goal = GoalProgress()
            link = self.links[role] = ParameterLink(self._node, name, gid)
            if role == 'robot':
                self.state.robot_values = link.values
            else:
                self.state.controller_values = link.values
