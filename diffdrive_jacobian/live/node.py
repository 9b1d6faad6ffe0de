"""The node behind the page: it finds robots, follows them and steers them."""

from __future__ import annotations

import time
from collections.abc import Callable

from rcl_interfaces.msg import ParameterEvent
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.node import Node

from diffdrive_jacobian.live.commands import Command, Pause, Seek, SetSpeed, Step
from diffdrive_jacobian.live.goal_progress import GoalEnd
from diffdrive_jacobian.live.live_robot import LiveRobot
from diffdrive_jacobian.live.pacing import Pacing
from diffdrive_jacobian.live.session import Session, Snapshot
from diffdrive_jacobian.messages.codecs import PARAMETER_EVENT, Changes
from diffdrive_jacobian.messages.names import base_name, full_name, is_named, namespace_of, node_of
from diffdrive_jacobian.messages.topics import PARAMETER_EVENTS, TOPICS
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros.serialization import ignoring_invalid
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
            polled: Whether it is run by a SingleThreadedExecutor: it then polls its topics with a timer
                of its own. Otherwise `work` must be called often.
            pacing: Control of simulated time. None: time is real.
            goal_ended: Receives the end of each goal. None: nothing does.
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
        if isinstance(command, (Pause, Step, SetSpeed, Seek)):
            if self._pacing is None or isinstance(command, Seek):
                self._session.notify(
                    'time is real here: it can neither pause nor change its speed', 'warning'
                )
            else:
                self._pacing.obey(command)
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
            robot.use_nodes({role: names[0] for role, names in roles.items() if names})
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
        try:
            self.robots[namespace] = LiveRobot(
                self,
                self._session,
                namespace,
                self._names,
                polled=self._polled,
                clock=self._robot_time,
            )
            self.robots[namespace].on_end = self._goal_ended
        except ParameterError as error:
            self._refuse(namespace, error)

    def _refuse(self, name: str, error: ParameterError) -> None:
        if name not in self._refused:
            self._refused.add(name)
            self._session.notify(str(error), 'error')

    def _nodes(self, topic: str) -> list[str]:
        """Return the nodes that publish a topic."""
        return [node_of(one) for one in self.get_publishers_info_by_topic(topic) if is_named(one)]

    def _on_parameter_event(self, changes: Changes) -> None:
        for robot in self.robots.values():
            for link in robot.links.values():
                if link.target == changes.node:
                    link.changed(changes.values)
