"""Reaching goals."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.numerics.checks import NotNegative, PositiveOrInfinite
from diffdrive_jacobian.numerics.fields import Name, Names
from diffdrive_jacobian.properties._goals import Goal, Motion, read_goal
from diffdrive_jacobian.properties._messages import Pose, Twist
from diffdrive_jacobian.properties._node_time import ROUNDING
from diffdrive_jacobian.properties.base import Property, Watch


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
        self.goal: Goal | None = None
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
