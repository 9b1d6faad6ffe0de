"""Observing goals, cancellations and the pose of the robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.codecs import GOAL_STATUS, GOALS, POSE, Status
from diffdrive_jacobian.properties._messages import (
    FieldReader,
    Pose,
    Twist,
    planar,
    read_pose,
    read_twist,
)

STANDING = Twist(0.01, 0.05)
"""Largest twist of a robot that counts as standing."""


class Goal(NamedTuple):
    """A goal of the robot."""

    pose: Pose
    seconds: float
    """World time at which it was sent or received (s)."""
    stamp: tuple[int, int]
    """Stamp of its message: sec and nanosec."""


_read_goal = FieldReader(lambda kind: GOALS.fields if kind.__name__ == 'Goals' else POSE.fields).read


def read_goal(message_type: type, message: Any, seconds: float) -> Goal | None:
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
    return Goal(planar(*pose), seconds, (int(sec), int(nanosec)))


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

    def where(self, goal: Goal | None, of: str = '') -> str:
        """Return where the robot is, relative to a goal, `of` what."""
        if self.pose is None or goal is None:
            return f'there was no odometry on {self.topic}'
        distance = self.pose.distance(goal.pose)
        return (
            f'the robot is {distance:.6g} m from the goal{of} at {goal.pose}: {self.pose}, {self.twist}'
        )
