"""Canceling a goal."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.numerics.fields import Name, Names
from diffdrive_jacobian.properties._messages import read_twist
from diffdrive_jacobian.properties.base import Property, Watch


@dataclass(frozen=True, repr=False)
class NoCommandAfterCancel(Property):
    """A controller publishes no command that moves the robot after its cancel service has responded.

    It may do so again when it has received another goal. Whether the response reports success does not
    matter. Commands of zero are allowed. Commands of other nodes do not count.

    Attributes:
        cancel: Service that cancels the goal (default: 'cancel_goal').
        commands: Topic of type Twist or TwistStamped (default: 'cmd_vel').
        goals: Topics of the goals (default: ('goal_pose', 'goals')).
    """

    cancel: Name = field(default='cancel_goal', kw_only=True)
    commands: Name = field(default='cmd_vel', kw_only=True)
    goals: Names = field(default=('goal_pose', 'goals'), kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _CancelWatch(self, world)


class _CancelWatch(Watch):
    def __init__(self, required: NoCommandAfterCancel, world: Lockstep) -> None:
        super().__init__(world)
        self._canceled: dict[Node, float] = {}
        world.expect(required.resolved(required.commands))
        world.expect(required.resolved(required.cancel))
        self._commands = world.on_published(required.resolved(required.commands), self._on_command)
        for topic in required.goals:
            world.on_delivered(required.resolved(topic), self._on_goal)
        self._cancel = world.on_response(required.resolved(required.cancel), self._on_cancel)

    def _on_goal(self, node: Node, _: type, __: Any) -> None:
        self._canceled.pop(node, None)
        self.note(f'{self.name_of(node)} received a goal')

    def _on_cancel(self, node: Node, _: Any) -> None:
        self._canceled[node] = self.seconds
        self.note(f'{self.name_of(node)} responded to {self._cancel}')

    def _on_command(self, publisher: Publisher, message: Any) -> None:
        twist = read_twist(publisher.msg_type, message)
        node = self.owner(publisher)
        if node is None or twist is None:
            return
        if node in self._canceled and not twist.is_zero:
            self.found(
                f'{self._commands}: {twist}, {self.seconds - self._canceled[node]:g} s after '
                f'{self.name_of(node)} has responded to {self._cancel}; allowed: zero, '
                'until it receives another goal'
            )
        self.note(self._commands, ': ', twist)
