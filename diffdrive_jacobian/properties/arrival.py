"""Arriving once the faults have ended."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep import Lockstep
from diffdrive_jacobian.properties._goals import Goal, Motion, read_goal
from diffdrive_jacobian.properties._messages import FieldReader, Pose, Twist
from diffdrive_jacobian.properties._node_time import ROUNDING, end_of_faults
from diffdrive_jacobian.properties.base import Watch
from diffdrive_jacobian.properties.goals import GoalProperty


@dataclass(frozen=True, repr=False)
class ArrivesOnceFaultsEnd(GoalProperty):
    """The robot arrives at the goal that its controller has received, once the faults have ended.

    A controller is a node that is subscribed to a topic of `goals` and publishes `commands`. It has the
    goal that it received last. The robot must have stood within `tolerance` of that goal at some time
    after the controller has received it, at the latest `within` after that and after the last fault has
    ended. The goal is not due any longer when

    - the cancel service of the node has responded,
    - the node has published CANCELED or ABORTED for it (with the stamp of the goal) on `status`,
    - the node was removed, killed or shut down.

    While there is a fault without an end nothing is due. A run that ends before the goal is reached
    violates the property: let it run longer. Time is world time.

    Attributes:
        within: Longest time (s).
        tolerance: Largest distance to the goal (m) (default: 0.05).
        status: Topic of type action_msgs/GoalStatus (default: 'goal_status').
        commands: Topic on which the controller publishes (default: 'cmd_vel').
    """

    within: float
    tolerance: float = field(default=0.05, kw_only=True)
    status: str = field(default='goal_status', kw_only=True)
    commands: str = field(default='cmd_vel', kw_only=True)

    def __post_init__(self) -> None:
        """Check the fields."""
        super().__post_init__()
        self._number('within', infinite=False)
        self._number('tolerance', zero=False)
        self._text('status')
        self._text('commands')

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _ArrivesWatch(self, world)


class _ArrivesWatch(Watch):
    def __init__(self, required: ArrivesOnceFaultsEnd, world: Lockstep) -> None:
        super().__init__(world)
        self._required = required
        self._goals: dict[Node, Goal] = {}
        self._ended: dict[Node, Goal] = {}
        self._motion = Motion(self._on_motion)
        self._read_status = FieldReader(
            lambda _: ('status', 'goal_info.stamp.sec', 'goal_info.stamp.nanosec')
        ).read
        world.expect(*map(required.resolved, required.goals))
        for topic in required.goals:
            world.on_delivered(required.resolved(topic), self._on_goal)
        self._commands = world.node.resolve_topic_name(required.resolved(required.commands))
        world.expect(self._commands)
        world.expect(required.resolved(required.odom))
        self._odom = world.on_published(required.resolved(required.odom), self._motion.on_odometry)
        world.on_published(required.resolved(required.status), self._on_status)
        world.on_response(required.resolved(required.cancel), self._on_cancel)

    def _on_goal(self, node: Node, message_type: type, message: Any) -> None:
        goal = read_goal(message_type, message, self.seconds)
        if goal is None or not any(one.topic_name == self._commands for one in node.publishers):
            return
        self._goals[node] = goal
        self.note(f'{self.name_of(node)} received a goal at {goal.pose}')

    def _on_cancel(self, node: Node, _: Any) -> None:
        if self._goals.pop(node, None) is not None:
            self.note('canceled')

    def _on_status(self, publisher: Publisher, message: Any) -> None:
        node, fields = self.world.node_of(publisher), self._read_status(publisher.msg_type, message)
        if node is None or fields is None:
            return
        status, stamp = int(fields[0]), (int(fields[1]), int(fields[2]))
        if status in (GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_ABORTED):
            goal = self._goals.get(node)
            if goal is not None and goal.stamp == stamp:
                self._ended[node] = self._goals.pop(node)
        elif status == GoalStatus.STATUS_ACCEPTED:
            # Goals with equal stamps: what has ended was the one before.
            ended = self._ended.pop(node, None)
            if ended is not None and ended.stamp == stamp and node not in self._goals:
                self._goals[node] = ended

    def _on_motion(self, pose: Pose, _: Twist) -> None:
        if not self._goals or not self._motion.stands:
            return
        for node, goal in list(self._goals.items()):
            if pose.distance(goal.pose) <= self._required.tolerance:
                # Steps of time may be long: it may have arrived too late.
                self._check()
                self._goals.pop(node, None)

    def check(self) -> str | None:
        """Return that a goal was not reached in time; None: all were."""
        if self._goals:
            self._check()
        return self._found

    def _check(self) -> None:
        for node, goal in self._due():
            due = max(goal.seconds, end_of_faults(self.world))
            if self.seconds - due > self._required.within + ROUNDING:
                self.found(self._text(node, goal, f'{self.seconds - due:g} s after {self._since(goal)}'))

    def _due(self) -> list[tuple[Node, Goal]]:
        nodes = self.world.nodes
        for node in [node for node in self._goals if node not in nodes]:
            del self._goals[node]
        return list(self._goals.items())

    def _since(self, goal: Goal) -> str:
        end = end_of_faults(self.world)
        return 'the faults have ended' if end > goal.seconds else 'the goal was received'

    def _text(self, node: Node, goal: Goal, when: str) -> str:
        pose = self._motion.pose
        where = (
            f'there was no odometry on {self._odom}'
            if pose is None
            else f'the robot is {pose.distance(goal.pose):.6g} m from the goal of '
            f'{self.name_of(node)} at {goal.pose}: {pose}, {self._motion.twist}'
        )
        return f'{when} {where}; allowed: within {self._required.tolerance:g} m and standing'

    def finish(self) -> str | None:
        """Return that a goal was not reached yet; None: there is no such goal."""
        if math.isinf(end_of_faults(self.world)):
            return None
        for node, goal in self._due():
            due = max(goal.seconds, end_of_faults(self.world))
            text = self._text(
                node, goal, f'the run ended {self.seconds - due:g} s after {self._since(goal)}'
            )
            return self.described(f'{text}. Let it run for {self._required.within:g} s after that')
        return None
