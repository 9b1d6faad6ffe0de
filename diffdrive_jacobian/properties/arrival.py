"""Arriving once the faults have ended."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.goal_follower import FollowedGoal, GoalFollower
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.numerics.checks import NotNegative, PositiveOrInfinite
from diffdrive_jacobian.numerics.fields import Name
from diffdrive_jacobian.properties._messages import Pose, Twist
from diffdrive_jacobian.properties._node_time import ROUNDING, end_of_faults
from diffdrive_jacobian.properties.base import Watch
from diffdrive_jacobian.properties.goals import GoalProperty, Motion, SentGoal, read_goal, read_status


@dataclass(frozen=True, repr=False)
class DueGoalProperty(GoalProperty):
    """A property of the goals that a controller has received. Base class.

    A controller is a node that is subscribed to a topic of `goals` and publishes `commands`. It has the
    goal that it received last. That is due until the robot has stood within `tolerance` of it, or

    - the cancel service of the node has responded,
    - the node has published CANCELED or ABORTED for it (with the stamp of the goal) on `status`,
    - the node was removed, killed or shut down.

    While there is a fault without an end nothing is due. Time is world time. The faults have ended when
    what they delayed has arrived, too (`end_of_faults`).

    Attributes:
        within: Longest time (s).
        tolerance: Largest distance to the goal (m) (default: 0.05).
        status: Topic of type action_msgs/GoalStatus (default: 'goal_status').
        commands: Topic on which the controller publishes (default: 'cmd_vel').
    """

    within: NotNegative
    tolerance: PositiveOrInfinite = field(default=0.05, kw_only=True)
    status: Name = field(default='goal_status', kw_only=True)
    commands: Name = field(default='cmd_vel', kw_only=True)


@dataclass(frozen=True, repr=False)
class ArrivesOnceFaultsEnd(DueGoalProperty):
    """The robot arrives at the goal that its controller has received, once the faults have ended.

    A goal must not be due (`DueGoalProperty`) later than `within` after the controller has received it
    and the last fault has ended. A run that ends before the goal is reached violates the property: let
    it run longer.
    """

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _ArrivesWatch(self, world)


@dataclass(frozen=True, repr=False)
class KeepsDriving(DueGoalProperty):
    """The robot does not stand still on its way, once the faults have ended.

    While a goal is due (`DueGoalProperty`) the robot must not stand for longer than `within`, beginning
    when the controller has received the goal and the last fault has ended. It stands while the twists in
    its odometry are at most 0.01 m/s and 0.05 rad/s.
    """

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _KeepsDrivingWatch(self, world)


class _DueGoalWatch(Watch):
    def __init__(self, required: DueGoalProperty, world: Lockstep) -> None:
        super().__init__(world)
        self._required = required
        self._followers: defaultdict[Node, GoalFollower[SentGoal]] = defaultdict(GoalFollower)
        self._received: dict[Node, FollowedGoal[SentGoal]] = {}
        self._moved = self.seconds
        world.expect(*map(required.resolved, required.goals))
        for topic in required.goals:
            world.on_delivered(required.resolved(topic), self._on_goal)
        self._commands = world.node.resolve_topic_name(required.resolved(required.commands))
        world.expect(self._commands)
        world.on_published(self._commands, lambda publisher, _: self.check_observable(publisher))
        self._motion = Motion(world, required.resolved(required.odom), self._on_motion)
        world.on_published(required.resolved(required.status), self._on_status)
        world.on_response(required.resolved(required.cancel), self._on_cancel)

    def _on_goal(self, node: Node, message_type: type, message: Any) -> None:
        goal = read_goal(message_type, message, self.seconds)
        if goal is None or not any(one.topic_name == self._commands for one in node.publishers):
            return
        self._received[node] = self._followers[node].sent(goal, goal.stamp)
        self.note(f'{self.name_of(node)} received a goal at {goal.pose}')

    def _on_cancel(self, node: Node, _: Any) -> None:
        if self._received.pop(node, None) is not None:
            self.note('canceled')

    def _on_status(self, publisher: Publisher, message: Any) -> None:
        node, status = self.world.node_of(publisher), read_status(publisher.msg_type, message)
        if node is not None and status is not None:
            self._followers[node].reported(status.status, status.stamp)

    def _on_motion(self, pose: Pose, _: Twist) -> None:
        if not self._motion.stands:
            self._moved = self.seconds
            return
        for node, goal in self._due():
            if pose.distance(goal.pose) <= self._required.tolerance:
                # Steps of time may be long: this may be too late.
                self._check()
                self._received.pop(node, None)

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        self._check()
        return self._found

    def _check(self) -> None:
        """Find what is violated by goals that are due."""
        raise NotImplementedError

    def _due(self) -> list[tuple[Node, SentGoal]]:
        if not self._received:
            return []
        nodes = self.world.nodes
        return [
            (node, followed.goal)
            for node, followed in self._received.items()
            if followed.goal is not None
            and followed.state not in (GoalState.CANCELED, GoalState.ABORTED)
            and node in nodes
        ]

    def _begin(self, goal: SentGoal) -> tuple[float, str]:
        """Return when the time for a goal begins, and what happened then."""
        end = end_of_faults(self.world)
        if end > goal.seconds:
            return end, 'the faults have ended'
        return goal.seconds, 'the goal was received'

    def _where(self, node: Node, goal: SentGoal) -> str:
        return self._motion.where(goal, f' of {self.name_of(node)}')


class _ArrivesWatch(_DueGoalWatch):
    def _check(self) -> None:
        for node, goal in self._due():
            begin, what = self._begin(goal)
            if self.seconds - begin > self._required.within + ROUNDING:
                self.found(
                    f'{self.seconds - begin:g} s after {what} {self._where(node, goal)}; allowed: '
                    f'within {self._required.tolerance:g} m and standing'
                )

    def finish(self) -> str | None:
        """Return that a goal was not reached yet; None: there is no such goal."""
        for node, goal in self._due():
            begin, what = self._begin(goal)
            if math.isfinite(begin):
                return self.described(
                    f'the run ended {self.seconds - begin:g} s after {what}: {self._where(node, goal)}; '
                    f'allowed: within {self._required.tolerance:g} m and standing. Let it run for '
                    f'{self._required.within:g} s after that'
                )
        return None


class _KeepsDrivingWatch(_DueGoalWatch):
    def _check(self) -> None:
        for node, goal in self._due():
            begin, what = self._begin(goal)
            stood = self.seconds - max(begin, self._moved)
            if stood > self._required.within + ROUNDING:
                self.found(
                    f'{self.seconds - begin:g} s after {what} the robot has stood for {stood:g} s, and '
                    f'{self._where(node, goal)}; allowed: {self._required.within:g} s'
                )
