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

"""The page of a robot that is driven without ROS, in simulated time beside the clock on the wall."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.drives.read_values import as_read
from diffdrive_jacobian.drives.values import START, World, record
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.live.commands import RobotCommand
from diffdrive_jacobian.live.pacing import Pacing, control_time
from diffdrive_jacobian.live.page_drive import PageDrive
from diffdrive_jacobian.live.server import LiveServer
from diffdrive_jacobian.live.session import Session, Snapshot
from diffdrive_jacobian.live.steered_robot import COMMAND_LIFE, SteeredRobot
from diffdrive_jacobian.messages.codecs import Command, Place, Route
from diffdrive_jacobian.messages.conversion import MessageError, from_covariance
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.time_units import NANOSECONDS, seconds

PERIOD = 1.0 / 30.0
"""Time between two states that are stored (s)."""
ROLES = {'robot': 'virtual_robot', 'controller': 'go_to_goal'}


class ValueRobot(SteeredRobot):
    """The robot of a world without ROS."""

    def __init__(self, session: Session, world: World) -> None:
        """Follow what is published in the world."""
        super().__init__(session, world.namespace, lambda: world.seconds)
        self._world = world
        self._take_parameters()
        world.observers.append(self.observe)

    def now(self) -> int:
        """Return the time of the world (ns)."""
        return self._world.now

    @property
    def ready(self) -> bool:
        """Whether the robot has odometry."""
        return self.state.pose is not None

    # --- Messages

    def observe(self, topic: str, value: Any) -> None:
        """Take a message."""
        state = self.state
        try:
            value = as_read(topic, value)
        except MessageError:
            # The nodes drop it.
            return
        if topic == 'odom':
            self._seen = self._clock()
            pose, covariance = np.array(value.pose), from_covariance(value.covariance)
            state.moved(seconds(value.stamp), pose, value.twist, covariance)
        elif topic == 'ground_truth':
            state.truly_moved(seconds(value.stamp), np.array(value.pose), value.twist)
        elif topic == 'joint_states':
            state.wheels = value.speeds(state.wheel_names)
        elif topic == 'cmd_vel':
            state.command, self._commanded = value.twist, self._clock()
        elif topic == 'goals':
            self.on_goals(value)
        elif topic == 'path':
            self.on_path(value)
        elif topic == 'goal_status':
            self.on_status(value)

    def forget(self) -> None:
        """Forget a command that is too old."""
        if self._clock() - self._commanded > COMMAND_LIFE:
            self.state.command = None

    # --- What the page asks for

    def hears(self, name: str) -> str:
        """Return ''."""
        return ''

    def publish_twist(self, twist: tuple[float, float], now: int) -> None:
        """Publish a command."""
        self._world.publish('cmd_vel', Command(twist))

    def publish_goals(
        self, topic: str, poses: NDArray[np.float64], now: int, times: NDArray[np.float64] | None = None
    ) -> None:
        """Publish goals or a path."""
        of_path = None if times is None else tuple(times.tolist())
        rows = tuple((x, y, theta) for x, y, theta in poses.tolist())
        route = Route(divmod(now, NANOSECONDS), '', rows, of_path)
        self._world.publish('path' if topic == 'path' else 'goals', route)

    def publish_pose(self, pose: NDArray[np.float64], now: int) -> None:
        """Publish where the robot is."""
        x, y, theta = pose.tolist()
        self._world.publish('initialpose', Place(now, (x, y, theta), (0.0,) * 9))

    def has(self, role: str) -> bool:
        """Return whether there is a node with a role."""
        return role in ROLES

    def set_parameter(
        self, role: str, name: str, value: float | str | bool, refused: Callable[[str], None]
    ) -> None:
        """Set a parameter."""
        try:
            self._world.set_parameter(ROLES[role], name, value)
        except ParameterError as error:
            refused(str(error))
        self._take_parameters()

    def call(self, service: str, failed: Callable[[str], None]) -> None:
        """Call one of SERVICES."""
        world = self._world
        if service == 'reset_odometry':
            world.robot.reset_odometry(world.now)
        elif not world.driver.cancel(world.now):
            failed('no goal is active')

    def _take_parameters(self) -> None:
        world = self._world
        self.state.robot_values = world.robot.parameters.by_name()
        self.state.controller_values = world.driver.parameters.by_name()


class ValuePage:
    """What is behind the page: it obeys, advances worlds, and stores the state."""

    def __init__(
        self, session: Session, worlds: Sequence[World], pacing: Pacing, *, controlled: bool
    ) -> None:
        """Show the robots of worlds. `controlled`: whether the page controls their time."""
        self._session, self._worlds, self._pacing = session, worlds, pacing
        self._controlled = controlled
        self.robots = {world.namespace: ValueRobot(session, world) for world in worlds}
        """The robots by namespace."""
        self._stored = -1.0

    @property
    def seconds(self) -> float:
        """Time since the start (s)."""
        return min(world.seconds for world in self._worlds)

    def advance(self) -> None:
        """Advance the world that is behind to its next event."""
        min(self._worlds, key=lambda world: world.now).advance()

    def work(self) -> None:
        """Obey the page, and store the state as often as needed; to be called often."""
        session = self._session
        for page, command in session.take_commands():
            if not isinstance(command, RobotCommand):
                control_time(session, self._pacing if self._controlled else None, command)
            elif command.robot not in self.robots:
                session.notify('there is no such robot', 'warning')
            else:
                self.robots[command.robot].obey(page, command)
                # The next command finds what this one did.
                self.settle()
        for robot in self.robots.values():
            robot.drive()
        self.settle()
        now = time.monotonic()
        if session.watched and now - self._stored >= 0.9 * PERIOD:
            self._stored = now
            session.store(self._snapshot())

    def settle(self) -> None:
        """Let everybody receive what was published."""
        for world in self._worlds:
            world.settle()

    def _snapshot(self) -> Snapshot:
        for robot in self.robots.values():
            robot.forget()
        shown = (robot.shown() for robot in self.robots.values())
        return Snapshot(
            robots=[one for one in shown if one is not None],
            trails={name: robot.state.trail for name, robot in self.robots.items()},
            true_trails={name: robot.state.true_trail for name, robot in self.robots.items()},
            world=self._pacing.shown() if self._controlled else {'kind': 'robots'},
            fixed={
                'settings': {name: robot.settings() for name, robot in self.robots.items()},
                'notes': [],
            },
        )

    def stop(self) -> None:
        """Stop what pages drive, and the goals."""
        for robot in self.robots.values():
            robot.stop()
        for world in self._worlds:
            world.driver.cancel(world.now)
        self.settle()


def drive_live(drive: PageDrive) -> bool:
    """Drive robots, bridges and controllers without ROS, with the page. They are always isolated.

    Returns:
        Whether a page was open, so that what there is to send was sent.

    Raises:
        UserError: The parameters or the ROS arguments are invalid.
        OSError: The port is in use.
    """
    if not drive.isolated:
        raise UserError('other processes need rclpy, which is not installed')
    start = START if drive.lockstep else time.time_ns()
    worlds = [
        World(
            drive.parameters,
            one.placed(drive.robot_parameters),
            drive.ros_arguments,
            start,
            namespace=one.namespace,
        )
        for one in drive.fleet
    ]
    drive.nodes_created([name for world in worlds for name in world.nodes.values()])
    session, pacing, numbers = Session(), Pacing(), itertools.count(1)
    if drive.recording is not None:
        for world in worlds:
            record(world, drive.recording, numbers)
    page = ValuePage(session, worlds, pacing, controlled=drive.lockstep)
    for robot in page.robots.values():
        robot.on_end = drive.goal_ended
    waiting = drive.sends
    with closing(LiveServer(session, drive.port, drive.share)) as server:
        drive.ready(server)

        def work() -> bool:
            nonlocal waiting
            page.work()
            # Whoever opened the page wants to see the whole drive.
            if waiting and session.watched and all(robot.ready for robot in page.robots.values()):
                waiting = False
                drive.send(page.robots)
                page.settle()
            return drive.signals.count > 0

        while not (work() or pacing.pace(page.seconds, work)):
            page.advance()
        page.stop()
        return not waiting
