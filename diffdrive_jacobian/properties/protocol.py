"""Protocols: the status of goals, and canceling."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.goal_status import FOLLOWING, GoalState, Stamp
from diffdrive_jacobian.numerics.fields import Name, Names
from diffdrive_jacobian.properties._messages import FieldReader
from diffdrive_jacobian.properties.base import Property, Watch

_NAMES: dict[int, str] = {state: state.name for state in GoalState if state}
_STATUS_FIELDS = (
    'status',
    'goal_info.goal_id.uuid',
    'goal_info.stamp.sec',
    'goal_info.stamp.nanosec',
)
_STAMP_FIELDS = ('header.stamp.sec', 'header.stamp.nanosec')


class _Goal(NamedTuple):
    """A goal as one publisher names it."""

    publisher: Publisher
    uuid: bytes
    stamp: Stamp


@dataclass(frozen=True, repr=False)
class StatusProtocol(Property):
    """The status of each goal goes its way: ACCEPTED, EXECUTING, then one terminal status, and no more.

    - The first status of a goal is ACCEPTED, or ABORTED if it is refused.
    - ACCEPTED is followed by EXECUTING, CANCELING, CANCELED or ABORTED, EXECUTING by CANCELING or a
      terminal status. Only ACCEPTED, EXECUTING and CANCELING may be repeated.
    - After a terminal status (SUCCEEDED, CANCELED, ABORTED) there is no other, not even the same again.
    - One goal at a time is active: before the next one is ACCEPTED the previous one has its terminal
      status.

    Goals are told apart by the identifier and the stamp in `goal_info`. A controller that leaves the
    identifier at zeros may accept a stamp again when it receives a goal with this stamp again. A goal
    need not become terminal. Each publisher is checked on its own, so a node that was restarted starts
    afresh.

    Attributes:
        topic: Topic of type action_msgs/GoalStatus (default: 'goal_status').
        goals: Topics of the goals (default: ('goal_pose', 'goals')).
    """

    topic: Name = field(default='goal_status', kw_only=True)
    goals: Names = field(default=('goal_pose', 'goals'), kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _StatusWatch(self, world)


class _StatusWatch(Watch):
    def __init__(self, protocol: StatusProtocol, world: Lockstep) -> None:
        super().__init__(world)
        self._read = FieldReader(lambda _: _STATUS_FIELDS).read
        self._read_stamp = FieldReader(lambda _: _STAMP_FIELDS).read
        self._last: dict[_Goal, GoalState] = {}
        self._active: dict[Publisher, _Goal] = {}
        self._received: Counter[tuple[Node, Stamp]] = Counter()
        self._answered: Counter[_Goal] = Counter()
        world.expect(protocol.resolved(protocol.topic))
        self._topic = world.on_published(protocol.resolved(protocol.topic), self._on_status)
        for goals in protocol.goals:
            world.on_delivered(protocol.resolved(goals), self._on_goal)

    def _on_goal(self, node: Node, message_type: type, message: Any) -> None:
        stamp = self._read_stamp(message_type, message)
        if stamp is not None:
            self._received[node, (int(stamp[0]), int(stamp[1]))] += 1

    def _on_status(self, publisher: Publisher, message: Any) -> None:
        fields = self._read(publisher.msg_type, message)
        if fields is None:
            self.found(f'{self._topic}: bytes that are no GoalStatus')
            return
        status, uuid, sec, nanosec = int(fields[0]), bytes(fields[1]), int(fields[2]), int(fields[3])
        goal = _Goal(publisher, uuid, (sec, nanosec))
        name = f'the goal with stamp {sec}.{nanosec:09d} s' + (
            f' and identifier {uuid.hex()[:8]}...' if any(uuid) else ''
        )
        self._check(goal, status, name)
        self.note(self._topic, ': ', _NAMES.get(status, status), ' of ', name)

    def _check(self, goal: _Goal, status: int, name: str) -> None:
        last = self._last.get(goal, GoalState.UNKNOWN)
        if last is GoalState.UNKNOWN or self._is_new(goal, last):
            last = GoalState.UNKNOWN
            received = self._received[self.world.node_of(goal.publisher), goal.stamp]
            self._answered[goal] = min(self._answered[goal] + 1, received)
        if status in _NAMES:
            self._last[goal] = GoalState(status)
            self._check_active(goal, GoalState(status), name)
        if last.ended:
            self.found(
                f'{self._topic}: {_NAMES.get(status, status)} of {name}, which was '
                f'{last.name} already; allowed: nothing after that'
            )
        elif status not in FOLLOWING[last]:
            before = f'after {last.name}' if last else 'as its first status'
            allowed = ', '.join(one.name for one in FOLLOWING[last])
            self.found(
                f'{self._topic}: {_NAMES.get(status, status)} of {name} {before}; allowed: {allowed}'
            )

    def _is_new(self, goal: _Goal, last: GoalState) -> bool:
        """Return whether a goal without an identifier was received again after its terminal status."""
        received = self._received[self.world.node_of(goal.publisher), goal.stamp]
        return last.ended and not any(goal.uuid) and received > self._answered[goal]

    def _check_active(self, goal: _Goal, status: GoalState, name: str) -> None:
        active = self._active.get(goal.publisher)
        if status.ended:
            if active == goal:
                del self._active[goal.publisher]
            return
        if active not in (None, goal) and status is GoalState.ACCEPTED:
            self.found(
                f'{self._topic}: ACCEPTED of {name}, while the goal before is '
                f'{self._last[active].name}; allowed: after its terminal status'
            )
        self._active[goal.publisher] = goal
