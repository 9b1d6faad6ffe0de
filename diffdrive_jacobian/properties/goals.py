"""Reaching goals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.codecs import GOAL_STATUS, GOALS, POSE, Status
from diffdrive_jacobian.messages.goal_status import UNSTAMPED, GoalState, Stamp
from diffdrive_jacobian.numerics.checks import NotNegative, PositiveOrInfinite
from diffdrive_jacobian.numerics.fields import Name, Names
from diffdrive_jacobian.properties._messages import (
    FieldReader,
    Pose,
    Twist,
    planar,
    read_pose,
    read_twist,
)
from diffdrive_jacobian.properties._node_time import ROUNDING
from diffdrive_jacobian.properties.base import Property, Watch

STANDING = Twist(0.01, 0.05)
"""Largest twist of a robot that counts as standing."""


class SentGoal(NamedTuple):
    """A goal of the robot."""

    pose: Pose
    seconds: float
    """World time at which it was sent or received (s)."""
    stamp: tuple[int, int]
    """Stamp of its message: sec and nanosec."""


_read_goal = FieldReader(lambda kind: GOALS.fields if kind.__name__ == 'Goals' else POSE.fields).read


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


_read_status = FieldReader(lambda _: GOAL_STATUS.fields).read


def read_status(message_type: type, message: Any) -> Status | None:
    """Return the status in a GoalStatus; None: the bytes are invalid."""
    fields = _read_status(message_type, message)
    return None if fields is None else GOAL_STATUS.value(*map(int, fields))


class Motion:
    """The last pose and twist in the odometry of a robot."""

    def __init__(self, world: Lockstep, topic: str, changed: Callable[[Pose, Twist], None]) -> None:
        """Observe a topic of odometry. `changed` is called with each pose and its twist."""
        self.pose: Pose | None = None
        self.twist: Twist | None = None
        self._changed = changed
        world.expect(topic)
        self.topic = world.on_published(topic, self._on_odometry)

    def _on_odometry(self, publisher: Publisher, message: Any) -> None:
        self.pose = read_pose(publisher.msg_type, message)
        self.twist = read_twist(publisher.msg_type, message)
        if self.pose is not None and self.twist is not None:
            self._changed(self.pose, self.twist)

    @property
    def stands(self) -> bool:
        """Whether the robot stands still."""
        twist = self.twist
        return twist is not None and (abs(twist.v) <= STANDING.v and abs(twist.omega) <= STANDING.omega)

    def where(self, goal: SentGoal | None, of: str = '') -> str:
        """Return where the robot is, relative to a goal, `of` what."""
        if self.pose is None or goal is None:
            return f'there was no odometry on {self.topic}'
        distance = self.pose.distance(goal.pose)
        return (
            f'the robot is {distance:.6g} m from the goal{of} at {goal.pose}: {self.pose}, {self.twist}'
        )


@dataclass(frozen=True, repr=False)
class GoalProperty(Property):
    """A property of the way to goals. Base class.

    Attributes:
        goals: Topics of the goals, of type PoseStamped or Goals, of which the last one counts (default:
            ('goal_pose', 'goals')).
        odom: Topic of the odometry (default: 'odom').
        cancel: Service that cancels the goal (default: 'cancel_goal').
    """

    goals: Names = field(default=('goal_pose', 'goals'), kw_only=True)
    odom: Name = field(default='odom', kw_only=True)
    cancel: Name = field(default='cancel_goal', kw_only=True)


@dataclass(frozen=True, repr=False)
class ReachesGoal(GoalProperty):
    """The robot stands at each goal within a time after the goal was published.

    It stands at a goal when a message of its odometry has a pose within `tolerance` of the goal (and
    within `yaw_tolerance` of its heading), and a twist of at most 0.01 m/s and 0.05 rad/s. A goal is
    not due any longer when another one was published, or the cancel service has responded. A run that
    ends before a goal is reached violates the property: let it run longer. Time is world time.

    Attributes:
        within: Longest time (s).
        tolerance: Largest distance to the goal (m) (default: 0.05).
        yaw_tolerance: Largest difference of the heading (rad) (default: infinite, any heading).
    """

    within: NotNegative
    tolerance: PositiveOrInfinite = field(default=0.05, kw_only=True)
    yaw_tolerance: PositiveOrInfinite = field(default=math.inf, kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _ReachesWatch(self, world)


class _PublishedGoalWatch(Watch):
    """Observes the goals as they are published."""

    def __init__(self, required: GoalProperty, world: Lockstep) -> None:
        super().__init__(world)
        self.goal: SentGoal | None = None
        world.expect(*map(required.resolved, required.goals))
        for topic in required.goals:
            world.on_published(required.resolved(topic), self._on_goal)
        self.motion = Motion(world, required.resolved(required.odom), self.on_motion)
        world.on_response(required.resolved(required.cancel), self._on_cancel)

    def _on_goal(self, publisher: Publisher, message: Any) -> None:
        self.goal = read_goal(publisher.msg_type, message, self.seconds)
        if self.goal is not None:
            self.note(f'{publisher.topic_name}: goal at {self.goal.pose}')

    def _on_cancel(self, _: Any, __: Any) -> None:
        self.goal = None
        self.note('canceled')

    def on_motion(self, pose: Pose, twist: Twist) -> None:
        """Receive a pose and twist of the odometry."""

    def where(self) -> str:
        """Return where the robot is, relative to the goal."""
        return self.motion.where(self.goal)


class _ReachesWatch(_PublishedGoalWatch):
    def __init__(self, required: ReachesGoal, world: Lockstep) -> None:
        self._required = required
        super().__init__(required, world)

    def on_motion(self, pose: Pose, twist: Twist) -> None:
        """Note whether the robot stands at the goal."""
        required, goal = self._required, self.goal
        if (
            goal is not None
            and self.motion.stands
            and pose.distance(goal.pose) <= required.tolerance
            and abs(math.remainder(pose.theta - goal.pose.theta, math.tau)) <= required.yaw_tolerance
        ):
            self._check()
            self.goal = None

    def _check(self) -> None:
        goal, within = self.goal, self._required.within
        if goal is not None and self.seconds - goal.seconds > within + ROUNDING:
            self.found(
                f'{within:g} s after the goal was published {self.where()}; allowed: {self._at()}'
            )

    def _at(self) -> str:
        return f'within {self._required.tolerance:g} m and standing'

    def check(self) -> str | None:
        """Return that a goal was not reached in time; None: it was."""
        self._check()
        return self._found

    def finish(self) -> str | None:
        """Return that a goal was not reached yet; None: there is no such goal."""
        if self.goal is None:
            return None
        passed = self.seconds - self.goal.seconds
        return self.described(
            f'the run ended {passed:g} s after the goal was published, and {self.where()}; allowed: '
            f'{self._at()}. Let it run for {self._required.within:g} s after the goal'
        )


@dataclass(frozen=True, repr=False)
class Settles(GoalProperty):
    """The robot is close to each goal after a settling time, and stays there.

    Later than `within` after a goal was published each pose of the odometry must be within `tolerance`
    of it, until another goal is published or the cancel service has responded. A run that ends before
    `within` after a goal violates the property: let it run longer. Time is world time.

    Attributes:
        within: Settling time (s).
        tolerance: Largest distance to the goal (m).
    """

    within: NotNegative
    tolerance: PositiveOrInfinite

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _SettlesWatch(self, world)


class _SettlesWatch(_PublishedGoalWatch):
    def __init__(self, required: Settles, world: Lockstep) -> None:
        self._required = required
        super().__init__(required, world)

    def on_motion(self, pose: Pose, twist: Twist) -> None:
        """Check the distance to the goal."""
        if self.goal is None or self.seconds - self.goal.seconds <= self._required.within + ROUNDING:
            return
        if not pose.distance(self.goal.pose) <= self._required.tolerance:
            self._late()

    def _late(self) -> None:
        if self.goal is not None:
            self.found(
                f'{self.seconds - self.goal.seconds:g} s after the goal was published {self.where()}; '
                f'allowed: {self._required.tolerance:g} m'
            )

    def finish(self) -> str | None:
        """Return that there was no odometry after the settling time; None: there was."""
        if self.goal is None:
            return None
        passed = self.seconds - self.goal.seconds
        if passed < self._required.within - ROUNDING or self.motion.pose is None:
            return self.described(
                f'the run ended {passed:g} s after the goal was published, and {self.where()}. Let it '
                f'run for {self._required.within:g} s after the goal'
            )
        self.on_motion(self.motion.pose, Twist(0.0, 0.0))
        return self._found


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


@dataclass(frozen=True, repr=False)
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

    topic: Name = field(default='goal_status', kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _StaleGoalWatch(self, world)


class _StaleGoalWatch(Watch):
    def __init__(self, required: NoStaleGoals, world: Lockstep) -> None:
        super().__init__(world)
        self._newest: dict[Publisher, Stamp] = {}
        self._clock = world.now
        world.expect(required.resolved(required.topic))
        self._topic = world.on_published(required.resolved(required.topic), self._on_status)

    def _on_status(self, publisher: Publisher, message: Any) -> None:
        status = read_status(publisher.msg_type, message)
        if status is None or status.status != GoalState.ACCEPTED or status.stamp == UNSTAMPED:
            return
        self._follow_clock()
        stamp, newest = status.stamp, self._newest.get(publisher, UNSTAMPED)
        if stamp <= newest:
            self.found(
                f'{self._topic}: ACCEPTED of the goal with stamp {_text(stamp)} s, after one with stamp '
                f'{_text(newest)} s; allowed: newer stamps'
            )
        self._newest[publisher] = stamp
        self.note(f'{self._topic}: ACCEPTED of the goal with stamp {_text(stamp)} s')

    def check(self) -> str | None:
        """Return that an old goal was accepted; None: none was."""
        self._follow_clock()
        return self._found

    def _follow_clock(self) -> None:
        if self.world.now < self._clock:
            self._newest.clear()
        self._clock = self.world.now


def _text(stamp: Stamp) -> str:
    return f'{stamp[0]}.{stamp[1]:09d}'
