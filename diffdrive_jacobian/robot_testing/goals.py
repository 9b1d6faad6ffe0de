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

"""Goals: reaching them, their status, canceling, and arriving once the faults have ended."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.faults.fault import RosName
from diffdrive_jacobian.messages.codecs import GOAL_STATUS, GOALS, PATH, POSE, STAMP, Status
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.goal_status import (
    FOLLOWING,
    UNSTAMPED,
    FollowedGoal,
    GoalFollower,
    GoalState,
    Stamp,
)
from diffdrive_jacobian.numerics.checks import Names, NotNegative, PositiveOrInfinite
from diffdrive_jacobian.properties.base import ROUNDING, Property, end_of_faults
from diffdrive_jacobian.robot_testing.fields import field_reader
from diffdrive_jacobian.robot_testing.odometry import MotionProperty
from diffdrive_jacobian.robot_testing.readings import Pose, Twist, planar, read_twist

ENDED_OTHERWISE = (GoalState.CANCELED, GoalState.ABORTED)
"""States of goals that the robot need not reach any longer."""
STANDING = Twist(0.01, 0.05)
"""Largest twist of a robot that counts as standing."""


class SentGoal(NamedTuple):
    """A goal of the robot."""

    pose: Pose
    seconds: float
    """World time at which it was sent or received (s)."""
    stamp: Stamp
    """Stamp of its message."""


_read_goal = field_reader(lambda kind: GOALS.fields if kind.__name__ == 'Goals' else POSE.fields)
_read_status = field_reader(lambda _: GOAL_STATUS.fields)
_read_stamp = field_reader(lambda _: STAMP)
_read_path = field_reader(lambda _: PATH.fields)
_read_identifier = field_reader(lambda _: ('goal_info.goal_id.uuid',))


def read_goal(message_type: type, message: Any, seconds: float) -> SentGoal | None:
    """Return the goal in a PoseStamped, or the last one in a Goals message; None: there is none."""
    fields = _read_goal(message_type, message)
    if fields is None:
        return None
    sec, nanosec, _, *pose = fields
    if message_type.__name__ == 'Goals':
        frames, *columns = pose
        if not frames:
            return None
        pose = [column[-1] for column in columns]
    return SentGoal(planar(*pose), seconds, (int(sec), int(nanosec)))


def read_path(message_type: type, message: Any, seconds: float) -> SentGoal | None:
    """Return the end of a path as a goal; None: there is none."""
    fields = _read_path(message_type, message)
    try:
        route = None if fields is None else PATH.value(*fields)
    except MessageError:
        return None
    if route is None or len({pose[:2] for pose in route.poses}) < 2:
        # A controller refuses it.
        return None
    return SentGoal(Pose(*route.poses[-1]), seconds, route.stamp)


def read_status(message_type: type, message: Any) -> Status | None:
    """Return the status in a GoalStatus; None: the bytes are invalid."""
    fields = _read_status(message_type, message)
    return None if fields is None else GOAL_STATUS.value(*map(int, fields))


def _identifier(message_type: type, message: Any) -> tuple[int, ...] | None:
    """Return the identifier of the goal in a GoalStatus; None: it has none."""
    fields = _read_identifier(message_type, message)
    return tuple(map(int, fields[0])) if fields is not None and any(fields[0]) else None


def _text(stamp: Stamp) -> str:
    return f'the goal with stamp {stamp[0]}.{stamp[1]:09d} s'


@dataclass(repr=False)
class GoalProperty(MotionProperty):
    """A property of the way to goals. Base class.

    Attributes:
        goals: Topics of the goals, of type PoseStamped or Goals, of which the last one counts (default:
            ('goal_pose', 'goals')).
        path: Topic of paths, which replace a goal, of type nav_msgs/Path (default: 'path').
        cancel: Service that cancels the goal (default: 'cancel_goal').
    """

    goals: Names = field(default=('goal_pose', 'goals'), kw_only=True)
    path: RosName = field(default='path', kw_only=True)
    cancel: RosName = field(default='cancel_goal', kw_only=True)

    @property
    def stands(self) -> bool:
        """Whether the robot stands still."""
        return self.twist is not None and self.twist.is_within(*STANDING)

    def where(self, goal: SentGoal, of: str = '') -> str:
        """Return where the robot is, relative to a goal `of` a controller."""
        if self.pose is None:
            return f'there was no odometry on {self._odom}'
        distance = self.pose.distance(goal.pose)
        return (
            f'the robot is {distance:.6g} m from the goal{of} at {goal.pose}: {self.pose}, {self.twist}'
        )


@dataclass(repr=False)
class PublishedGoalProperty(GoalProperty):
    """A property of the last goal that was published. Base class."""

    def begin(self) -> None:
        """Begin to observe the goals and the robot."""
        super().begin()
        self.goal: SentGoal | None = None
        self.world.expect(*map(self.resolved, self.goals))
        for topic in self.goals:
            self.on_published(topic, self._on_goal, optional=True, raw=True)
        self.on_published(self.path, self._on_path, optional=True, raw=True)
        self.on_response(self.cancel, self._on_cancel, optional=True)

    def _on_path(self, publisher: Publisher, message: Any) -> None:
        if read_path(publisher.msg_type, message, self.world_seconds) is not None:
            self.goal = None
            self.note('a path replaces the goal')

    def _on_goal(self, publisher: Publisher, message: Any) -> None:
        self.goal = read_goal(publisher.msg_type, message, self.world_seconds)
        if self.goal is not None:
            self.note(f'{publisher.topic_name}: goal at {self.goal.pose}')

    def _on_cancel(self, _: Node, __: Any) -> None:
        self.goal = None
        self.note('canceled')


@dataclass(repr=False)
class ReachesGoal(PublishedGoalProperty):
    """The robot stands at each goal within a time after the goal was published.

    It stands at a goal when a message of its odometry has a pose within `tolerance` of the goal (and
    within `yaw_tolerance` of its heading), and a twist of at most 0.01 m/s and 0.05 rad/s. A goal is
    not due any longer when another one or a path was published, or the cancel service has responded. A
    run that ends before a goal is reached violates the property: let it run longer. Time is world time.

    Attributes:
        within: Longest time (s).
        tolerance: Largest distance to the goal (m) (default: 0.05).
        yaw_tolerance: Largest difference of the heading (rad) (default: infinite, any heading).
    """

    within: NotNegative
    tolerance: PositiveOrInfinite = field(default=0.05, kw_only=True)
    yaw_tolerance: PositiveOrInfinite = field(default=math.inf, kw_only=True)

    def on_motion(self, pose: Pose, twist: Twist) -> None:
        """Receive a message of the odometry."""
        goal = self.goal
        if (
            goal is not None
            and self.stands
            and pose.distance(goal.pose) <= self.tolerance
            and abs(math.remainder(pose.theta - goal.pose.theta, math.tau)) <= self.yaw_tolerance
        ):
            passed = self.world_seconds - goal.seconds
            if passed > self.within + ROUNDING:
                self.found(
                    f'the robot stood at the goal {passed:g} s after it was published; allowed: '
                    f'{self.within:g} s'
                )
            self.goal = None

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        goal = self.goal
        if goal is not None and (passed := self.world_seconds - goal.seconds) > self.within + ROUNDING:
            self.found(
                f'{passed:g} s after the goal was published {self.where(goal)}; allowed: '
                f'within {self.tolerance:g} m and standing, within {self.within:g} s'
            )
        return None

    def finish(self) -> str | None:
        """Return what is violated at the end; None: nothing."""
        goal = self.goal
        if goal is None:
            return None
        return self.described(
            f'the run ended {self.world_seconds - goal.seconds:g} s after the goal was published, and '
            f'{self.where(goal)}; allowed: within {self.tolerance:g} m and standing. Let it run for '
            f'{self.within:g} s after the goal'
        )


@dataclass(repr=False)
class Settles(PublishedGoalProperty):
    """The robot is close to each goal after a settling time, and stays there.

    Later than `within` after a goal was published each pose of the odometry must be within `tolerance`
    of it, until another goal or a path is published or the cancel service has responded. A run that
    ends before `within` after a goal violates the property: let it run longer. Time is world time.

    Attributes:
        within: Settling time (s).
        tolerance: Largest distance to the goal (m).
    """

    within: NotNegative
    tolerance: PositiveOrInfinite

    def on_motion(self, pose: Pose, twist: Twist) -> None:
        """Receive a message of the odometry."""
        goal = self.goal
        if goal is None or self.world_seconds - goal.seconds <= self.within + ROUNDING:
            return
        if not pose.distance(goal.pose) <= self.tolerance:
            self.found(
                f'{self.world_seconds - goal.seconds:g} s after the goal was published '
                f'{self.where(goal)}; allowed: {self.tolerance:g} m'
            )

    def finish(self) -> str | None:
        """Return what is violated at the end; None: nothing."""
        goal, within = self.goal, self.within
        if goal is None:
            return None
        passed = self.world_seconds - goal.seconds
        if passed < within - ROUNDING or self.pose is None:
            return self.described(
                f'the run ended {passed:g} s after the goal was published, and {self.where(goal)}. Let '
                f'it run for {within:g} s after the goal'
            )
        # That of the last message, which may have come before.
        self.on_motion(self.pose, STANDING)
        return self._found


# --- Arriving once the faults have ended


@dataclass(repr=False)
class DueGoalProperty(GoalProperty):
    """A property of the goals that a controller has received. Base class.

    A controller is a node that is subscribed to a topic of `goals` or to `path` and publishes
    `commands`. It has the goal that it received last, of a path its end. That is due until the robot has
    stood within `tolerance` of it, or

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
    status: RosName = field(default='goal_status', kw_only=True)
    commands: RosName = field(default='cmd_vel', kw_only=True)

    def begin(self) -> None:
        """Begin to observe the goals, the controllers and the robot."""
        super().begin()
        self._followers: defaultdict[Node, GoalFollower[SentGoal]] = defaultdict(GoalFollower)
        self._received: dict[Node, FollowedGoal[SentGoal]] = {}
        self._reached: set[FollowedGoal[SentGoal]] = set()
        self._moved = self.world_seconds
        self.world.expect(*map(self.resolved, (*self.goals, self.path)))
        for topic in self.goals:
            self.on_delivered(topic, self._on_goal, optional=True, raw=True)
        self.on_delivered(self.path, self._on_path, optional=True, raw=True)
        self._commands = self.world.node.resolve_topic_name(self.resolved(self.commands))
        self.world.expect(self._commands)
        self.on_published(self.status, self._on_status, optional=True, raw=True)
        self.on_response(self.cancel, self._on_cancel, optional=True)

    def _on_goal(self, node: Node, message_type: type, message: Any) -> None:
        self._take(node, read_goal(message_type, message, self.world_seconds))

    def _on_path(self, node: Node, message_type: type, message: Any) -> None:
        self._take(node, read_path(message_type, message, self.world_seconds))

    def _take(self, node: Node, goal: SentGoal | None) -> None:
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

    def on_motion(self, pose: Pose, _: Twist) -> None:
        """Receive a message of the odometry."""
        if not self.stands:
            self._moved = self.world_seconds
            return
        for due in self.due():
            if pose.distance(due.goal.pose) <= self.tolerance:
                # Steps of time may be long: this may be too late.
                self.check()
                self._reached.add(due.followed)

    def due(self) -> list[_Due]:
        """Return the goals that are due."""
        if not self._received:
            return []
        nodes, end = self.world.nodes, end_of_faults(self.world)
        found = []
        for node, newest in self._received.items():
            followed: FollowedGoal[SentGoal] | None = newest
            if newest.state is GoalState.ABORTED:
                # It may have been refused. Then the one before it goes on.
                followed = self._followers[node].driving
            if followed is None or followed in self._reached or followed.state in ENDED_OTHERWISE:
                continue
            goal = followed.goal
            if goal is not None and node in nodes:
                begin = max(end, goal.seconds)
                event = 'the faults have ended' if end > goal.seconds else 'the goal was received'
                found.append(_Due(node, goal, begin, event, followed))
        return found

    def where_of(self, due: _Due) -> str:
        """Return where the robot is, relative to a goal."""
        return self.where(due.goal, f' of {self.name_of(due.node)}')


@dataclass(repr=False)
class ArrivesOnceFaultsEnd(DueGoalProperty):
    """The robot arrives at the goal that its controller has received, once the faults have ended.

    A goal must not be due (`DueGoalProperty`) later than `within` after the controller has received it
    and the last fault has ended. A run that ends before the goal is reached violates the property: let
    it run longer.
    """

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        for due in self.due():
            passed = self.world_seconds - due.begin
            if passed > self.within + ROUNDING:
                self.found(
                    f'{passed:g} s after {due.event} {self.where_of(due)}; allowed: '
                    f'within {self.tolerance:g} m and standing'
                )
        return None

    def finish(self) -> str | None:
        """Return what is violated at the end; None: nothing."""
        for due in self.due():
            if math.isfinite(due.begin):
                return self.described(
                    f'the run ended {self.world_seconds - due.begin:g} s after {due.event}: '
                    f'{self.where_of(due)}; allowed: within {self.tolerance:g} m and standing. '
                    f'Let it run for {self.within:g} s after that'
                )
        return None


@dataclass(repr=False)
class KeepsDriving(DueGoalProperty):
    """The robot does not stand still on its way, once the faults have ended.

    While a goal is due (`DueGoalProperty`) the robot must not stand for longer than `within`, beginning
    when the controller has received the goal and the last fault has ended. It stands while the twists in
    its odometry are at most 0.01 m/s and 0.05 rad/s.
    """

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        for due in self.due():
            stood = self.world_seconds - max(due.begin, self._moved)
            if stood > self.within + ROUNDING:
                self.found(
                    f'{self.world_seconds - due.begin:g} s after {due.event} the robot has stood for '
                    f'{stood:g} s, and {self.where_of(due)}; allowed: {self.within:g} s'
                )
        return None


class _Due(NamedTuple):
    """A goal that is due."""

    node: Node
    """Its controller."""
    goal: SentGoal
    begin: float
    """World time at which the time for it begins (s)."""
    event: str
    """What happened then."""
    followed: FollowedGoal[SentGoal]
    """The goal with its status."""


# --- Canceling


@dataclass(repr=False)
class NoCommandAfterCancel(Property):
    """A controller publishes no command that moves the robot after its cancel service has responded.

    It may do so again when it has received another goal or a path. Whether the response reports success
    does not matter. Commands of zero are allowed. Commands of other nodes do not count.

    Attributes:
        cancel: Service that cancels the goal (default: 'cancel_goal').
        commands: Topic of type Twist or TwistStamped (default: 'cmd_vel').
        goals: Topics of the goals and paths (default: ('goal_pose', 'goals', 'path')).
    """

    cancel: RosName = field(default='cancel_goal', kw_only=True)
    commands: RosName = field(default='cmd_vel', kw_only=True)
    goals: Names = field(default=('goal_pose', 'goals', 'path'), kw_only=True)

    def begin(self) -> None:
        """Begin to observe commands, goals and the cancel service."""
        self._canceled: dict[Node, float] = {}
        self._commands = self.on_published(self.commands, self._on_command, raw=True)
        for topic in self.goals:
            self.on_delivered(topic, self._on_goal, optional=True, raw=True)
        self._cancel = self.on_response(self.cancel, self._on_cancel)

    def _on_goal(self, node: Node, message_type: type, message: Any) -> None:
        read = read_path if message_type.__name__ == 'Path' else read_goal
        if read(message_type, message, self.world_seconds) is not None:
            self._canceled.pop(node, None)
            self.note(f'{self.name_of(node)} received a goal')

    def _on_cancel(self, node: Node, _: Any) -> None:
        self._canceled[node] = self.world_seconds
        self.note(f'{self.name_of(node)} responded to {self._cancel}')

    def _on_command(self, publisher: Publisher, message: Any) -> None:
        twist = read_twist(publisher.msg_type, message)
        node = self.owner(publisher)
        if node is None or twist is None:
            return
        if node in self._canceled and not twist.is_zero:
            self.found(
                f'{self._commands}: {twist}, {self.world_seconds - self._canceled[node]:g} s after '
                f'{self.name_of(node)} has responded to {self._cancel}; allowed: zero, '
                'until it receives another goal'
            )
        self.note(self._commands, ': ', twist)


# --- Status


@dataclass(repr=False)
class NoStaleGoals(Property):
    """A controller accepts no goal that is older than one that it has accepted, and none twice.

    The stamps of the goals that it reports as ACCEPTED must increase. Goals without a stamp do not
    count. When the clock of the nodes jumps back, stamps may decrease. Each publisher is checked on its
    own.

    Messages may arrive late or repeatedly (`Reorder`, `Duplicate`). A controller that accepts them
    drives to where nobody wants it any more.

    Attributes:
        topic: Topic of type action_msgs/GoalStatus (default: 'goal_status').
    """

    topic: RosName = field(default='goal_status', kw_only=True)

    def begin(self) -> None:
        """Begin to observe the status."""
        self._newest: dict[Publisher, tuple[Stamp, Any]] = {}
        """Stamp and identifier of the newest goal."""
        self._clock = self.world.now
        self._topic = self.on_published(self.topic, self._on_status, raw=True)

    def _on_status(self, publisher: Publisher, message: Any) -> None:
        status = read_status(publisher.msg_type, message)
        if status is None or status.status != GoalState.ACCEPTED or status.stamp == UNSTAMPED:
            return
        self.check()
        stamp, (newest, same) = status.stamp, self._newest.get(publisher, (UNSTAMPED, None))
        identifier = _identifier(publisher.msg_type, message)
        if identifier is not None and identifier == same:
            # Repeated, as after another goal was refused.
            return
        if stamp <= newest:
            self.found(
                f'{self._topic}: ACCEPTED of {_text(stamp)}, after one with stamp '
                f'{newest[0]}.{newest[1]:09d} s; allowed: newer stamps'
            )
        self._newest[publisher] = stamp, identifier
        self.note(f'{self._topic}: ACCEPTED of {_text(stamp)}')

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        if self.world.now < self._clock:
            self._newest.clear()
        self._clock = self.world.now
        return None


@dataclass(repr=False)
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
        goals: Topics of the goals and paths (default: ('goal_pose', 'goals', 'path')).
    """

    topic: RosName = field(default='goal_status', kw_only=True)
    goals: Names = field(default=('goal_pose', 'goals', 'path'), kw_only=True)

    def begin(self) -> None:
        """Begin to observe goals and their status."""
        self._last: dict[_Goal, GoalState] = {}
        self._active: dict[Publisher, _Goal] = {}
        self._received: Counter[tuple[Node, Stamp]] = Counter()
        self._answered: Counter[_Goal] = Counter()
        self._topic = self.on_published(self.topic, self._on_status, raw=True)
        for goals in self.goals:
            self.on_delivered(goals, self._on_goal, optional=True, raw=True)

    def _on_goal(self, node: Node, message_type: type, message: Any) -> None:
        stamp = _read_stamp(message_type, message)
        if stamp is not None:
            self._received[node, (int(stamp[0]), int(stamp[1]))] += 1

    def _on_status(self, publisher: Publisher, message: Any) -> None:
        status = read_status(publisher.msg_type, message)
        identifier = _read_identifier(publisher.msg_type, message)
        if status is None or identifier is None:
            self.found(f'{self._topic}: bytes that are no GoalStatus')
            return
        goal = _Goal(publisher, bytes(identifier[0]), status.stamp)
        known = status.status in FOLLOWING and status.status != GoalState.UNKNOWN
        what = f'{GoalState(status.status).name if known else status.status} of {goal}'
        self._check(goal, status.status, what)
        if known:
            self._check_active(goal, GoalState(status.status), what)
        self.note(self._topic, ': ', what)

    def _check(self, goal: _Goal, status: int, what: str) -> None:
        """Check what a status follows."""
        last = self._last.get(goal, GoalState.UNKNOWN)
        received = self._received[self.world.node_of(goal.publisher), goal.stamp]
        # A goal without an identifier may be received again after its terminal status.
        if last.ended and not any(goal.uuid) and received > self._answered[goal]:
            last = GoalState.UNKNOWN
        if last is GoalState.UNKNOWN:
            self._answered[goal] = min(self._answered[goal] + 1, received)
        if last.ended:
            self.found(
                f'{self._topic}: {what}, which was {last.name} already; allowed: nothing after that'
            )
        elif status not in FOLLOWING[last]:
            before = f'after {last.name}' if last else 'as its first status'
            allowed = ', '.join(one.name for one in FOLLOWING[last])
            self.found(f'{self._topic}: {what} {before}; allowed: {allowed}')

    def _check_active(self, goal: _Goal, status: GoalState, what: str) -> None:
        """Check that one goal at a time is active."""
        active = self._active.get(goal.publisher)
        if status.ended:
            if active == goal:
                del self._active[goal.publisher]
        elif active not in (None, goal) and status is GoalState.ACCEPTED:
            self.found(
                f'{self._topic}: {what}, while the goal before is {self._last[active].name}; allowed: '
                'after its terminal status'
            )
        if not status.ended:
            self._active[goal.publisher] = goal
        self._last[goal] = status


class _Goal(NamedTuple):
    """A goal as one publisher names it."""

    publisher: Publisher
    uuid: bytes
    stamp: Stamp

    def __str__(self) -> str:
        named = f' and identifier {self.uuid.hex()[:8]}...' if any(self.uuid) else ''
        return _text(self.stamp) + named
