"""Stopping: when odometry is lost, when commands are lost, and when a node is shut down."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.numerics.checks import NotNegative
from diffdrive_jacobian.numerics.fields import Name, Text
from diffdrive_jacobian.properties._messages import Twist, read_twist
from diffdrive_jacobian.properties._node_time import ROUNDING, ReactionTime, delays
from diffdrive_jacobian.properties.base import Property, Watch


@dataclass(frozen=True, repr=False)
class StopsAfterLostOdometry(Property):
    """A controller stops the robot within a time after it has received its last odometry.

    A controller is a node that publishes `commands` and is subscribed to `odom`, other than that of the
    test. What counts is the odometry that it receives, after all faults of the topic, and the command
    that it has published last, whether or not that arrives: longer than `within` after the last odometry
    it must be zero. Before its first odometry the time counts from its first command. Nodes that were
    removed or killed cannot stop anything, and are not checked.

    The time is what a timer of the node can measure. It does not pass while the clock of the nodes
    stands still or the node is frozen (`Hang`), it starts again where the clock jumps, and it is longer
    for a node that is slow (`Slow`: by three callbacks) or whose timers jitter (`TimerJitter`).

    Attributes:
        within: Longest time (s).
        node: Name of the controller (default: all).
        odom: Topic of the odometry (default: 'odom').
        commands: Topic of type Twist or TwistStamped (default: 'cmd_vel').
    """

    within: NotNegative
    node: Text = field(default='', kw_only=True)
    odom: Name = field(default='odom', kw_only=True)
    commands: Name = field(default='cmd_vel', kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _LostOdometryWatch(self, world)


class _Controller:
    """A node that publishes commands, and may receive odometry."""

    def __init__(self, node: Node, now: float, seconds: float) -> None:
        self.node = node
        self.command = Twist(0.0, 0.0)
        self.received, self.seconds = now, seconds
        self.subscribed = False


class _LostOdometryWatch(Watch):
    def __init__(self, required: StopsAfterLostOdometry, world: Lockstep) -> None:
        super().__init__(world)
        self._required = required
        self._time = ReactionTime(world)
        self._controllers: dict[Node, _Controller] = {}
        world.expect(required.resolved(required.commands))
        self._commands = world.on_published(required.resolved(required.commands), self._on_command)
        world.expect(required.resolved(required.odom))
        self._odom = world.on_delivered(required.resolved(required.odom), self._on_odometry)

    def _on_odometry(self, node: Node, _: type, __: Any) -> None:
        controller = self._controllers.get(node)
        if controller is None:
            controller = self._controllers[node] = _Controller(node, self._time.now(), self.seconds)
        else:
            # Steps of time may be long: this one may come too late.
            self._check(controller)
        controller.received, controller.seconds = self._time.now(), self.seconds
        controller.subscribed = True
        if controller.command.v or controller.command.omega:
            self.note(self._odom, ' was received by ', self.name_of(node))

    def _on_command(self, publisher: Publisher, message: Any) -> None:
        node = self.owner(publisher)
        twist = read_twist(publisher.msg_type, message)
        if node is None or twist is None or node is self.world.node:
            return
        controller = self._controllers.get(node)
        if controller is None:
            controller = self._controllers[node] = _Controller(node, self._time.now(), self.seconds)
        if not controller.subscribed:
            controller.subscribed = any(one.topic_name == self._odom for one in node.subscriptions)
        controller.command = twist
        self.note(self._commands, ': ', twist)

    def check(self) -> str | None:
        """Return that a controller has not stopped in time; None: all have."""
        for controller in self._controllers.values():
            if not controller.command.is_zero:
                self._check(controller)
        return self._found

    def _check(self, controller: _Controller) -> None:
        passed, required = self._time.since(controller.received), self._required
        if controller.command.is_zero or passed <= required.within + ROUNDING:
            return
        if controller.node not in self.world.nodes:
            # It cannot stop anything any more.
            controller.command = Twist(0.0, 0.0)
            return
        if not controller.subscribed or not is_named(self.name_of(controller.node), required.node):
            return
        allowed = required.within + delays(self.world, controller.node, controller.seconds)
        if passed > allowed + ROUNDING:
            name = self.name_of(controller.node)
            self.found(
                f'the last command of {name} is {controller.command}, {passed:.6g} s after it has '
                f'received its last message on {self._odom}; allowed: {allowed:g} s'
            )


@dataclass(frozen=True, repr=False)
class StopsAfterLastCommand(Property):
    """A robot stands still when it has not received a command for a time.

    A robot is a node that publishes `odom` and is subscribed to `commands`. What counts are the commands
    that it receives, after all faults of the topic, and the twists that it publishes in its odometry.
    The time is measured as for `StopsAfterLostOdometry`.

    Attributes:
        within: Longest time (s).
        node: Name of the robot (default: all).
        odom: Topic of the odometry (default: 'odom').
        commands: Topic of the commands, of any type (default: 'cmd_vel').
        v: Largest speed that counts as standing (m/s) (default: 0.001).
        omega: Largest yaw rate that counts as standing (rad/s) (default: 0.001).
    """

    within: NotNegative
    node: Text = field(default='', kw_only=True)
    odom: Name = field(default='odom', kw_only=True)
    commands: Name = field(default='cmd_vel', kw_only=True)
    v: NotNegative = field(default=0.001, kw_only=True)
    omega: NotNegative = field(default=0.001, kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _LastCommandWatch(self, world)


class _LastCommandWatch(Watch):
    def __init__(self, required: StopsAfterLastCommand, world: Lockstep) -> None:
        super().__init__(world)
        self._required = required
        self._time = ReactionTime(world)
        self._received: dict[Node, tuple[float, float]] = {}
        self._robots: dict[Node, bool] = {}
        world.expect(required.resolved(required.odom))
        self._odom = world.on_published(required.resolved(required.odom), self._on_odometry)
        world.expect(required.resolved(required.commands))
        self._commands = world.on_delivered(required.resolved(required.commands), self._on_command)

    def _on_command(self, node: Node, _: type, __: Any) -> None:
        self._received[node] = self._time.now(), self.seconds
        self.note(self._commands, ' was received by ', self.name_of(node))

    def _on_odometry(self, publisher: Publisher, message: Any) -> None:
        now = self._time.now()
        twist = read_twist(publisher.msg_type, message)
        if twist is None or (
            abs(twist.v) <= self._required.v and abs(twist.omega) <= self._required.omega
        ):
            return
        node = self.owner(publisher)
        if node is None or not self._is_robot(node):
            return
        received, seconds = self._received.setdefault(node, (now, self.seconds))
        passed, within = self._time.since(received), self._required.within
        if passed <= within + ROUNDING:
            return
        allowed = within + delays(self.world, node, seconds)
        if passed > allowed + ROUNDING:
            self.found(
                f'{self._odom}: {twist}, {passed:.6g} s after {self.name_of(node)} has '
                f'received its last message on {self._commands}; allowed: {allowed:g} s'
            )

    def check(self) -> str | None:
        """Return that a robot has not stopped in time; None: all have."""
        # Where the clock jumps is noticed only when it is read.
        self._time.now()
        return self._found

    def _is_robot(self, node: Node) -> bool:
        """Return whether a node is a robot that is checked."""
        if node not in self._robots:
            self._robots[node] = is_named(self.name_of(node), self._required.node) and any(
                one.topic_name == self._commands for one in node.subscriptions
            )
        return self._robots[node]


@dataclass(frozen=True, repr=False)
class StopsOnShutdown(Property):
    """A node that is shut down leaves with a command of zero.

    When a node has been destroyed (`destroy_node`), the last command that it has published must be zero,
    if it has published any. Nodes that were killed (`Lockstep.remove`, `Kill`) are not checked: nothing
    of them runs any more.

    Attributes:
        node: Name of the node (default: all that publish commands).
        commands: Topic of type Twist or TwistStamped (default: 'cmd_vel').
    """

    node: Text = field(default='', kw_only=True)
    commands: Name = field(default='cmd_vel', kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _ShutdownWatch(self, world)


class _ShutdownWatch(Watch):
    def __init__(self, required: StopsOnShutdown, world: Lockstep) -> None:
        super().__init__(world)
        self._required = required
        self._last: dict[Node, Twist] = {}
        world.expect(required.resolved(required.commands))
        self._commands = world.on_published(required.resolved(required.commands), self._on_command)

    def _on_command(self, publisher: Publisher, message: Any) -> None:
        node, twist = self.owner(publisher), read_twist(publisher.msg_type, message)
        if node is None or twist is None or node is self.world.node:
            return
        if is_named(self.name_of(node), self._required.node):
            self._last[node] = twist
        self.note(self._commands, ': ', twist)

    def check(self) -> str | None:
        """Return that a node has left while the robot moved; None: none has."""
        if self._last.keys() - self.world.nodes:
            for node, twist in list(self._last.items()):
                if node in self.world.nodes:
                    continue
                del self._last[node]
                if not twist.is_zero and node not in self.world.killed:
                    self.found(
                        f'{self.name_of(node)} was shut down after the command {twist}; allowed: '
                        'a command of zero before'
                    )
        return self._found

    def finish(self) -> str | None:
        """As `check`."""
        return self.check()


def is_named(name: str, wanted: str) -> bool:
    """Return whether the name of a node is the one that is wanted; an empty one: any."""
    return not wanted or name.lstrip('/') == wanted.lstrip('/')
