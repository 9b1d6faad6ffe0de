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

"""Stopping: when odometry is lost, when commands are lost, and when a node is shut down."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.faults.fault import RosName
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.numerics.checks import NotNegative
from diffdrive_jacobian.properties.base import ROUNDING, Property
from diffdrive_jacobian.robot_testing.readings import Twist, read_twist
from diffdrive_jacobian.time_units import NANOSECONDS


@dataclass(repr=False)
class ReactionProperty(Property):
    """A property of a node that does not receive messages any more. Base class.

    The time is what a timer of the node can measure. It does not pass while the clock of the nodes
    stands still or the node is frozen (`Hang`), it starts again where the clock jumps, and it is longer
    for a node that is slow (`Slow`: by three callbacks) or whose timers jitter (`TimerJitter`).

    Attributes:
        within: Longest time (s).
        node: Name of the node (default: all).
        commands: Topic of the commands (default: 'cmd_vel').
        odom: Topic of type Odometry (default: 'odom').
    """

    odom: RosName = field(default='odom', kw_only=True)
    within: NotNegative
    node: str = field(default='', kw_only=True)
    commands: RosName = field(default='cmd_vel', kw_only=True)

    def begin(self) -> None:
        """Begin to measure the time since nodes have received a message."""
        self._world_time, self._clock = self.world.world_time, self.world.now
        self._passed, self._jumped = 0, -math.inf
        self._received: dict[Node, tuple[float, float]] = {}

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        # Where the clock jumps is noticed only when it is read.
        self._time()
        return None

    def received(self, node: Node) -> None:
        """Note that a node has received a message."""
        self._received[node] = self._time(), self.world_seconds

    def late(self, node: Node, topic: str, subject: str = '') -> str | None:
        """Return that a node, the `subject`, has received a topic too long ago; None: it has not."""
        begin, seconds = self._received.setdefault(node, (self._time(), self.world_seconds))
        passed = self._time() - max(begin, self._jumped)
        if passed <= self.within + ROUNDING or node not in self.world.nodes:
            return None
        name = self.name_of(node)
        subscribed = any(one.topic_name == topic for one in node.subscriptions)
        if not subscribed or not is_named(name, self.node):
            return None
        allowed = self.within + delays(self.world, node, seconds)
        if passed <= allowed + ROUNDING:
            return None
        return (
            f'{passed:.6g} s after {subject or name} has received its last message on {topic}; '
            f'allowed: {allowed:g} s'
        )

    def _time(self) -> float:
        """Return the time that has passed for timers of the nodes (s), and note a jump of the clock."""
        world_time, clock = self.world.world_time, self.world.now
        by_world, by_clock = world_time - self._world_time, clock - self._clock
        # After a pause a jump forward may look as if time had passed evenly.
        jumped = by_world > 0 and any(
            self._world_time < time * NANOSECONDS <= world_time
            for fault in self.world.faults
            for time in fault.clock_jumps
        )
        self._world_time, self._clock = world_time, clock
        if 0 <= by_clock <= by_world and not jumped:
            self._passed += by_clock
        else:
            self._passed += by_world
            self._jumped = self._passed / NANOSECONDS
        return self._passed / NANOSECONDS


def delays(world: Lockstep, node: Node, since: float) -> float:
    """Return by how much faults of a node may have delayed its reaction since a world time (s)."""
    name, now = node.get_fully_qualified_name(), world.world_seconds
    total = 0.0
    for fault in world.faults:
        if fault.affected_node and is_named(name, fault.affected_node):
            total += fault.reaction_delay(node, since, now)
    return total


def is_named(name: str, wanted: str) -> bool:
    """Return whether the name of a node is the one that is wanted; an empty one: any."""
    return not wanted or name.lstrip('/') == wanted.lstrip('/')


@dataclass(repr=False)
class StopsAfterLostOdometry(ReactionProperty):
    """A controller stops the robot within a time after it has received its last odometry.

    A controller is a node that publishes `commands` and is subscribed to `odom`, other than that of the
    test. What counts is the odometry that it receives, after all faults of the topic, and the command
    that it has published last, whether or not that arrives: longer than `within` after the last odometry
    it must be zero. Before its first odometry the time counts from its first command. Nodes that were
    removed or killed cannot stop anything, and are not checked. The time: see `ReactionProperty`.
    """

    def begin(self) -> None:
        """Begin to observe commands and odometry."""
        super().begin()
        self._moving: dict[Node, Twist] = {}
        self._commands = self.on_published(self.commands, self._on_command, raw=True)
        self._odom = self.on_delivered(self.odom, self._on_odometry, raw=True)

    def _on_odometry(self, node: Node, _: type, __: Any) -> None:
        if node in self._moving:
            # Steps of time may be long: this one may come too late.
            self._check(node)
            self.note(self._odom, ' was received by ', self.name_of(node))
        self.received(node)

    def _on_command(self, publisher: Publisher, message: Any) -> None:
        node = self.owner(publisher)
        twist = read_twist(publisher.msg_type, message)
        if node is None or twist is None or node is self.world.node:
            return
        if twist.is_zero:
            self._moving.pop(node, None)
        else:
            self._moving[node] = twist
        if node not in self._received:
            self.received(node)
        self.note(self._commands, ': ', twist)

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        for node in self._moving:
            self._check(node)
        return super().check()

    def _check(self, node: Node) -> None:
        if (late := self.late(node, self._odom, 'it')) is not None:
            self.found(f'the last command of {self.name_of(node)} is {self._moving[node]}, {late}')


@dataclass(repr=False)
class StopsAfterLastCommand(ReactionProperty):
    """A robot stands still when it has not received a command for a time.

    A robot is a node that publishes `odom` and is subscribed to `commands`. What counts are the commands
    that it receives, after all faults of the topic, and the twists that it publishes in its odometry.
    The time: see `ReactionProperty`. Commands may be of any type.

    Attributes:
        v: Largest speed that counts as standing (m/s) (default: 0.001).
        omega: Largest yaw rate that counts as standing (rad/s) (default: 0.001).
    """

    v: NotNegative = field(default=0.001, kw_only=True)
    omega: NotNegative = field(default=0.001, kw_only=True)

    def begin(self) -> None:
        """Begin to observe odometry and commands."""
        super().begin()
        self._odom = self.on_published(self.odom, self._on_odometry, raw=True)
        self._commands = self.on_delivered(self.commands, self._on_command, raw=True)

    def _on_command(self, node: Node, _: type, __: Any) -> None:
        self.received(node)
        self.note(self._commands, ' was received by ', self.name_of(node))

    def _on_odometry(self, publisher: Publisher, message: Any) -> None:
        twist = read_twist(publisher.msg_type, message)
        if twist is None or twist.is_within(self.v, self.omega):
            return
        node = self.owner(publisher)
        if node is not None and (late := self.late(node, self._commands)) is not None:
            self.found(f'{self._odom}: {twist}, {late}')


@dataclass(repr=False)
class StopsOnShutdown(Property):
    """A node that is shut down leaves with a command of zero.

    When a node has been destroyed (`destroy_node`), the last command that it has published must be zero,
    if it has published any. Nodes that were killed (`Lockstep.remove`, `Kill`) are not checked: nothing
    of them runs any more.

    Attributes:
        node: Name of the node (default: all that publish commands).
        commands: Topic of type Twist or TwistStamped (default: 'cmd_vel').
    """

    node: str = field(default='', kw_only=True)
    commands: RosName = field(default='cmd_vel', kw_only=True)

    def begin(self) -> None:
        """Begin to observe commands."""
        self._last: dict[Node, Twist] = {}
        self._commands = self.on_published(self.commands, self._on_command, raw=True)

    def _on_command(self, publisher: Publisher, message: Any) -> None:
        node, twist = self.owner(publisher), read_twist(publisher.msg_type, message)
        if node is None or twist is None or node is self.world.node:
            return
        if is_named(self.name_of(node), self.node):
            self._last[node] = twist
        self.note(self._commands, ': ', twist)

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        gone = self._last.keys() - self.world.nodes
        for node in [one for one in self._last if one in gone]:
            twist = self._last.pop(node)
            if not twist.is_zero and node not in self.world.killed:
                self.found(
                    f'{self.name_of(node)} was shut down after the command {twist}; allowed: '
                    'a command of zero before'
                )
        return None

    def finish(self) -> str | None:
        """Return what is violated at the end."""
        return self.check()
