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

"""The node behind the page, which finds, follows and steers robots; and programs that run it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.node import Node

from diffdrive_jacobian.drives.nodes import DISCOVERY_PERIOD as RECORDED_PERIOD
from diffdrive_jacobian.drives.nodes import add_nodes, in_lockstep, in_real_time, recorder_of
from diffdrive_jacobian.live.commands import Command, RobotCommand
from diffdrive_jacobian.live.fleet import PATTERN, Member
from diffdrive_jacobian.live.live_robot import LiveRobot
from diffdrive_jacobian.live.pacing import Pacing, control_time
from diffdrive_jacobian.live.page_drive import PageDrive
from diffdrive_jacobian.live.robot_state import GoalEnd
from diffdrive_jacobian.live.server import LiveServer, Ready
from diffdrive_jacobian.live.session import Session, Share, Snapshot
from diffdrive_jacobian.lockstep.runner import LockstepRunner
from diffdrive_jacobian.messages.codecs import PARAMETER_EVENT, Changes
from diffdrive_jacobian.messages.names import base_name, full_name, is_named, namespace_of, node_of
from diffdrive_jacobian.messages.topics import PARAMETER_EVENTS, TOPICS, Selection
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros.runner import ros_context, running
from diffdrive_jacobian.ros.serialization import ignoring_invalid
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable

NAME = 'live_page'
"""Name of the node."""
PERIOD = 1.0 / 30.0
"""Time between two looks at topics and commands (s)."""
DISCOVERY_PERIOD = 0.5
"""Time between two looks at the graph (s)."""
MAX_ROBOTS = 16
"""Largest number of robots that are shown."""
LOST = 30.0
"""Time without odometry and publisher after which a robot is no longer shown (s)."""
CANCELED_WITHIN = 1.0
"""Longest time that a controller needs to say that it drives no more (s)."""
RECORDED_AFTER = 1.5 * RECORDED_PERIOD
"""Time after which the recorder has found the publishers of the page (s)."""


class LivePage(Node):  # type: ignore[misc]
    """Node behind the page. `work` does everything; callbacks only store."""

    def __init__(
        self,
        session: Session,
        context: Context,
        *,
        polled: bool,
        pacing: Pacing | None = None,
        goal_ended: Callable[[GoalEnd], None] | None = None,
    ) -> None:
        """Create the node without robots.

        Args:
            session: What the page shows, and where its commands come from.
            context: Context of the node.
            polled: Whether it polls its topics with a timer of its own, as a SingleThreadedExecutor
                needs it. Otherwise `work` must be called often.
            pacing: Control of simulated time. None: time is real.
            goal_ended: Receives the end of each goal.
        """
        super().__init__(NAME, context=context, start_parameter_services=False)
        self._session, self._polled, self._pacing = session, polled, pacing
        self._goal_ended = goal_ended
        self._robot_time = time.monotonic if pacing is None else pacing.now
        self.robots: dict[str, LiveRobot] = {}
        """Robots by namespace."""
        self._names = {
            topic: base_name(self.resolve_topic_name(topic)) for topic in TOPICS if '/' not in topic
        }
        self._refused: set[str] = set()
        self._unshown: list[str] = []
        self._discovered = self._worked = -1.0
        received = ignoring_invalid(PARAMETER_EVENT, ParameterEvent, self._on_parameter_event)
        self.create_subscription(ParameterEvent, PARAMETER_EVENTS, received, 10, raw=True)
        if polled:
            self.create_timer(PERIOD, self.work, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def work(self) -> None:
        """Obey the page, look at topics and the graph as often as needed, and store the state."""
        for page, command in self._session.take_commands():
            self._obey(page, command)
        now = time.monotonic()
        if now - self._discovered >= DISCOVERY_PERIOD:
            self._discovered = now
            self._discover()
        for robot in self.robots.values():
            robot.drive()
        if now - self._worked < 0.9 * PERIOD:
            return
        self._worked = now
        for robot in self.robots.values():
            robot.poll()
            robot.advance()
        if self._session.watched:
            self._session.store(self._snapshot())

    def is_ready(self, one: Member) -> bool:
        """Return whether a robot and its controller are there."""
        return one.namespace in self.robots and self.robots[one.namespace].ready

    @property
    def drives(self) -> bool:
        """Whether a robot drives to a goal or along a path."""
        return any(robot.state.goal.active for robot in self.robots.values())

    def cancel(self) -> None:
        """Cancel goals and paths."""
        for robot in self.robots.values():
            if robot.state.goal.active:
                robot.cancel()

    def stop(self) -> None:
        """Stop what pages drive by hand."""
        for robot in self.robots.values():
            robot.stop()

    def _snapshot(self) -> Snapshot:
        shown = {name: robot.shown() for name, robot in sorted(self.robots.items())}
        return Snapshot(
            robots=[one for one in shown.values() if one is not None],
            trails={name: robot.state.trail for name, robot in self.robots.items()},
            true_trails={name: robot.state.true_trail for name, robot in self.robots.items()},
            world={'kind': 'robots'} if self._pacing is None else self._pacing.shown(),
            fixed={
                'settings': {name: robot.settings() for name, robot in self.robots.items()},
                'notes': self._notes(),
            },
        )

    def _notes(self) -> list[str]:
        """Return what the page does not show although it is there."""
        count = len(self._unshown)
        if not count:
            return []
        names = ', '.join(printable(name, 40) for name in self._unshown[:3])
        more = ', ...' if count > 3 else ''
        return [f'at most {MAX_ROBOTS} robots are shown; {count} more publish odometry: {names}{more}']

    def _obey(self, page: int, command: Command) -> None:
        if not isinstance(command, RobotCommand):
            control_time(self._session, self._pacing, command)
            return
        robot = self.robots.get(command.robot)
        if robot is None:
            self._session.notify('there is no such robot', 'warning')
            return
        try:
            robot.obey(page, command)
        except ParameterError as error:
            self._session.notify(str(error), 'error')

    # --- Discovery

    def _discover(self) -> None:
        types = dict(self.get_topic_names_and_types())
        self._unshown = []
        for topic, kinds in types.items():
            if base_name(topic) == self._names['odom'] and 'nav_msgs/msg/Odometry' in kinds:
                self._add(namespace_of(topic))
        for namespace, robot in list(self.robots.items()):
            publishers = self._nodes(robot.topics.full('odom'))
            if not publishers and robot.silence > LOST:
                robot.destroy()
                del self.robots[namespace]
                continue
            roles = {'robot': publishers, 'controller': self._nodes(robot.topics.full('goal_status'))}
            robot.use_nodes({role: nodes[0] for role, nodes in roles.items() if nodes})
            try:
                robot.topics.use_twist_type(types.get(robot.topics.full('cmd_vel'), []))
            except ParameterError as error:
                self._refuse(robot.topics.full('cmd_vel'), error)

    def _add(self, namespace: str) -> None:
        if namespace in self.robots or namespace in self._refused:
            return
        if not self._nodes(full_name(namespace, self._names['odom'])):
            # Only somebody who listens, or the publisher's node is not discovered yet.
            return
        if len(self.robots) >= MAX_ROBOTS:
            self._unshown.append(namespace)
            return
        names, clock = self._names, self._robot_time
        try:
            robot = LiveRobot(self, self._session, namespace, names, polled=self._polled, clock=clock)
        except ParameterError as error:
            self._refuse(namespace, error)
        else:
            self.robots[namespace], robot.on_end = robot, self._goal_ended

    def _refuse(self, name: str, error: ParameterError) -> None:
        if name not in self._refused:
            self._refused.add(name)
            self._session.notify(str(error), 'error')

    def _nodes(self, topic: str) -> list[tuple[str, bytes]]:
        """Return the nodes that publish a topic, and the GIDs of their publishers."""
        return [
            (node_of(one), bytes(one.endpoint_gid))
            for one in self.get_publishers_info_by_topic(topic)
            if is_named(one)
        ]

    def _on_parameter_event(self, changes: Changes) -> None:
        for robot in self.robots.values():
            for link in robot.links.values():
                if link.target == changes.node:
                    link.changed(changes.values)


def watch_nodes(
    *,
    ros_arguments: Sequence[str],
    port: int,
    signals: Signals,
    ready: Ready,
    share: Share | None = None,
) -> None:
    """Show and steer robots whose nodes run in other processes.

    Args:
        ros_arguments: ROS arguments of the node.
        port: TCP port of the page. 0: any free one.
        signals: Counter of the signals that end it.
        ready: Receives the server when it answers.
        share: With whom the page is shared. None: with nobody.

    Raises:
        UserError: The ROS arguments are invalid.
        OSError: The port is in use.
    """
    session = Session()
    with closing(LiveServer(session, port, share)) as server:
        ready(server)
        with (
            ros_context(['watch_run', *ros_arguments]) as context,
            running(context, isolated=False) as runner,
        ):
            page = runner.add(lambda: LivePage(session, context, polled=True))
            try:
                runner.spin(lambda: False, signals=signals)
            finally:
                page.stop()


def drive_live(drive: PageDrive) -> bool:
    """Run robots, wheel bridges and controllers in this process, with the page.

    Returns:
        Whether a page was open, so that what there is to send was sent.

    Raises:
        UserError: A node cannot run with the parameters or ROS arguments given.
        DriveError: In lockstep, a callback blocks, or simulated time cannot advance.
        OSError: The port is in use.
    """
    session, arguments, isolated = Session(), drive.ros_arguments, drive.isolated
    stage = in_lockstep(arguments) if drive.lockstep else in_real_time(arguments, isolated=isolated)
    with closing(LiveServer(session, drive.port, drive.share)) as server, ExitStack() as stack:
        drive.ready(server)
        runner = stack.enter_context(stage)
        context = runner.context
        fleet, names = drive.fleet, list[str]()
        for one in fleet:
            of_robot = one.placed(drive.robot_parameters)
            nodes = add_nodes(runner, drive.parameters, of_robot, namespace=one.namespace)
            names += [node.get_fully_qualified_name() for node in nodes]
        drive.nodes_created(names)
        pacing = Pacing() if drive.lockstep else None
        # The executor of nodes that others can reach leaves the topics to `work`.
        how: Any = {'polled': not isolated, 'pacing': pacing, 'goal_ended': drive.goal_ended}
        page = runner.add(lambda: LivePage(session, context, **how))
        stack.callback(page.stop)
        selection = Selection(pattern=PATTERN) if drive.robots > 1 else None
        discover = recorder_of(runner, drive.recording, selection)
        waiting = drive.sends
        since: list[float] = []

        def work() -> bool:
            nonlocal waiting
            discover()
            page.work()
            # Whoever opened the page wants to see the whole drive. What is sent at once after the page
            # has its publishers would not be recorded.
            if waiting and session.watched and all(map(page.is_ready, fleet)):
                since.append(runner.seconds())
                if drive.recording is None or since[-1] - since[0] >= RECORDED_AFTER:
                    waiting = False
                    drive.send(page.robots)
            return drive.signals.count > 0

        def end() -> bool:
            """Cancel what is driven to, and wait until its end was told."""
            page.cancel()

            def ended() -> bool:
                page.work()
                return not page.drives

            runner.spin(ended, timeout=CANCELED_WITHIN)
            return not waiting

        if pacing is None:
            runner.spin(work)
            return end()
        assert isinstance(runner, LockstepRunner)

        def meanwhile() -> bool:
            over = work()
            # What the page has sent is answered also while time stands.
            runner.settle()
            return over

        runner.spin(lambda: work() or pacing.pace(runner.seconds(), meanwhile))
        return end()
