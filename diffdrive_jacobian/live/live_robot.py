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

"""One robot of the page by its topics, services and parameters."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from diffdrive_jacobian.live import settings
from diffdrive_jacobian.live.robot_state import GoalProgress
from diffdrive_jacobian.live.robot_topics import RobotTopics
from diffdrive_jacobian.live.session import Session
from diffdrive_jacobian.live.steered_robot import COMMAND_LIFE, SERVICES, SteeredRobot
from diffdrive_jacobian.messages.codecs import GOAL_STATUS, GOALS, PATH, POSE, Motion, Status
from diffdrive_jacobian.messages.conversion import MessageError, from_covariance
from diffdrive_jacobian.messages.goal_status import ENDED
from diffdrive_jacobian.recording.parameter_query import ParameterQuery
from diffdrive_jacobian.ros.service_client import ServiceClient, ignore
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import seconds

PATIENCE = 3.0
"""Longest wait for the answer of a node (s)."""


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


class LiveRobot(SteeredRobot):
    """Follows one robot by its topics, services and parameters."""

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
            clock: As for `SteeredRobot`.

        Raises:
            ParameterError: A topic has another type in this process.
        """
        super().__init__(session, namespace, clock)
        self._node = node
        self.topics = RobotTopics(node, namespace, names, polled=polled)
        self.topics.listen(GOAL_STATUS, 'goal_status', self.on_status, latched=True)
        self.topics.listen(POSE, 'goal_pose', self.on_goals, latched=False)
        self.topics.listen(GOALS, 'goals', self.on_goals, latched=False)
        self.topics.listen(PATH, 'path', self.on_path, latched=False)
        self.links: dict[str, ParameterLink] = {}
        """Parameters by role."""
        # Before they are needed, so that they are discovered by then.
        self._services = {
            name: ServiceClient(node, Trigger, full, patience=PATIENCE, server=full)
            for name, full in ((name, self.topics.full(name)) for name in SERVICES)
        }
        self._frame = ''

    def now(self) -> int:
        """Return the time of the node (ns)."""
        return int(self._node.get_clock().now().nanoseconds)

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

    def on_status(self, one: Status) -> None:
        """Take a status of the controller."""
        if one.status in ENDED:
            # Where the robot is by now.
            self.poll()
        super().on_status(one)

    def _on_odometry(self, motion: Motion, now: float) -> None:
        try:
            covariance = from_covariance(motion.covariance)
        except MessageError:
            covariance = None
        self._seen, self._frame = now, motion.frame
        count = self.topics.followed['odom'].messages
        pose = np.array(motion.pose)
        self.state.moved(seconds(motion.stamp), pose, motion.twist, covariance, count)

    # --- What the page asks for

    def hears(self, name: str) -> str:
        """Return who does not listen to a topic; '': somebody does."""
        return '' if self.topics.readers(name) else f'nobody is subscribed to {self.topics.full(name)}'

    def publish_twist(self, twist: tuple[float, float], now: int) -> None:
        """Publish a command, at a time (ns)."""
        self.topics.publish_twist(twist, now)

    def publish_goals(
        self, topic: str, poses: NDArray[np.float64], now: int, times: NDArray[np.float64] | None = None
    ) -> None:
        """Publish goals or a path."""
        self.topics.publish(topic, poses, now, times)

    def publish_pose(self, pose: NDArray[np.float64], now: int) -> None:
        """Publish where the robot is."""
        self.topics.publish_pose(pose, self._frame, now)

    def has(self, role: str) -> bool:
        """Return whether there is a node with a role."""
        return role in self.links

    def set_parameter(
        self, role: str, name: str, value: float | str | bool, refused: Callable[[str], None]
    ) -> None:
        """Set a parameter of the node with a role."""
        self.links[role].set(name, value, refused)

    def call(self, service: str, failed: Callable[[str], None]) -> None:
        """Call one of SERVICES."""

        def answered(response: Any) -> None:
            if not response.success:
                failed(printable(response.message, 300))

        if self._services[service].ready:
            self._services[service].call(Trigger.Request(), answered, failed)
        else:
            failed(f'there is no service {self.topics.full(service)}')

    # --- State

    @property
    def ready(self) -> bool:
        """Whether a controller can receive goals, and the robot has odometry."""
        return self.state.pose is not None and self.topics.readers('goals') > 0

    def advance(self) -> None:
        """Advance queries of parameters."""
        for service in self._services.values():
            service.advance()
        for link in self.links.values():
            link.advance()

    def ranges(self) -> Mapping[str, Mapping[str, settings.Range]]:
        """Return the ranges that the nodes serve, by role."""
        return {role: link.ranges for role, link in self.links.items()}

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
