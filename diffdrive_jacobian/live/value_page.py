"""The page of a robot that is driven without ROS, in simulated time beside the clock on the wall."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Path
from diffdrive_jacobian.drives.read_values import as_read
from diffdrive_jacobian.drives.values import NODES, START, World, record
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.live.commands import RobotCommand
from diffdrive_jacobian.live.pacing import Pacing, control_time
from diffdrive_jacobian.live.robot_state import GoalEnd
from diffdrive_jacobian.live.server import LiveServer, Ready
from diffdrive_jacobian.live.session import Session, Snapshot
from diffdrive_jacobian.live.steered_robot import COMMAND_LIFE, SteeredRobot
from diffdrive_jacobian.messages.codecs import Command, Place, Route
from diffdrive_jacobian.messages.conversion import MessageError, from_covariance
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.recording.recording import Recording
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.time_units import NANOSECONDS, seconds

PERIOD = 1.0 / 30.0
"""Time between two states that are stored (s)."""
NAME = '/'
"""Namespace of the robot."""
ROLES = {'robot': '/virtual_robot', 'controller': '/go_to_goal'}


class ValueRobot(SteeredRobot):
    """The robot of a world without ROS."""

    def __init__(self, session: Session, world: World) -> None:
        """Follow what is published in the world."""
        super().__init__(session, NAME, lambda: world.seconds)
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
        parameters = self._world.parameters
        self.state.robot_values = parameters[ROLES['robot']]
        self.state.controller_values = parameters[ROLES['controller']]


class ValuePage:
    """What is behind the page: it obeys, and stores the state."""

    def __init__(self, session: Session, world: World, pacing: Pacing, *, controlled: bool) -> None:
        """Show the robot of a world. `controlled`: whether the page controls its time."""
        self._session, self._world, self._pacing = session, world, pacing
        self._controlled = controlled
        self.robot = ValueRobot(session, world)
        self._stored = -1.0

    def work(self) -> None:
        """Obey the page, and store the state as often as needed; to be called often."""
        robot, session = self.robot, self._session
        for page, command in session.take_commands():
            if not isinstance(command, RobotCommand):
                control_time(session, self._pacing if self._controlled else None, command)
            elif command.robot != NAME:
                session.notify('there is no such robot', 'warning')
            else:
                robot.obey(page, command)
                # The next command finds what this one did.
                self._world.settle()
        robot.drive()
        self._world.settle()
        now = time.monotonic()
        if session.watched and now - self._stored >= 0.9 * PERIOD:
            self._stored = now
            robot.forget()
            session.store(self._snapshot())

    def _snapshot(self) -> Snapshot:
        robot = self.robot
        shown = robot.shown()
        return Snapshot(
            robots=[] if shown is None else [shown],
            trails={NAME: robot.state.trail},
            true_trails={NAME: robot.state.true_trail},
            world=self._pacing.shown() if self._controlled else {'kind': 'robots'},
            fixed={'settings': {NAME: robot.settings()}, 'notes': []},
        )

    def stop(self) -> None:
        """Stop what a page drives, and the goal."""
        self.robot.stop()
        self._world.driver.cancel(self._world.now)
        self._world.settle()


def drive_live(
    goals: NDArray[np.float64] | Path,
    *,
    relative: bool = False,
    lockstep: bool,
    isolated: bool,
    parameters: Mapping[str, Any],
    robot_parameters: Mapping[str, Any],
    recording: Recording | None,
    ros_arguments: Sequence[str],
    port: int,
    signals: Signals,
    ready: Ready,
    nodes_created: Callable[[Sequence[str]], None],
    goal_ended: Callable[[GoalEnd], None] | None = None,
) -> None:
    """Drive robot, bridge and controller without ROS, with the page, until a signal comes.

    The arguments are those of `live.node.drive_live`. It is always `isolated`.

    Raises:
        UserError: The parameters or the ROS arguments are invalid.
        OSError: The port is in use.
    """
    if not isolated:
        raise UserError('other processes need rclpy, which is not installed')
    start = START if lockstep else time.time_ns()
    world = World(parameters, robot_parameters, ros_arguments, start)
    nodes_created(NODES)
    session, pacing = Session(), Pacing()
    if recording is not None:
        record(world, recording)
    page = ValuePage(session, world, pacing, controlled=lockstep)
    page.robot.on_end = goal_ended
    waiting = [goals] if isinstance(goals, Path) or len(goals) else []
    with closing(LiveServer(session, port)) as server:
        ready(server)

        def work() -> bool:
            page.work()
            # Whoever opened the page wants to see the whole drive.
            if waiting and session.watched and page.robot.ready:
                page.robot.send(waiting.pop(), relative=relative)
                world.settle()
            return signals.count > 0

        while not (work() or pacing.pace(world.seconds, work)):
            world.advance()
        page.stop()
