"""A goal of the node go_to_goal, read from a message."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from action_msgs.msg import GoalInfo
from builtin_interfaces.msg import Time
from unique_identifier_msgs.msg import UUID

from diffdrive_jacobian.control import Waypoints
from diffdrive_jacobian.messages import conversion as messages
from diffdrive_jacobian.messages.conversion import MessageError


@dataclass(slots=True)
class Goal:
    """A goal that was accepted: the content of one message."""

    info: GoalInfo
    frame: str
    """Frame of its poses; empty: that of the odometry."""
    waypoints: Waypoints
    executing: bool = False
    """Whether odometry was received after it was accepted."""
    stale: bool = False
    """Whether the robot is stopped because odometry is missing."""


class GoalIdentifiers:
    """The identifiers of the goals of one controller.

    They follow from its name, the time of receipt and their number. So runs in lockstep are the same
    each time.
    """

    def __init__(self, controller: str) -> None:
        """Start without goals. `controller` is the fully qualified name of the node."""
        self._controller = controller
        self._count = 0

    def info(self, stamp: Time, now: int) -> GoalInfo:
        """Return a new identifier, with the stamp of the goal. `now` is the time of receipt (ns)."""
        self._count += 1
        identifier = uuid.uuid5(uuid.NAMESPACE_URL, f'{self._controller}/{now}/{self._count}')
        return GoalInfo(goal_id=UUID(uuid=list(identifier.bytes)), stamp=stamp)


def read_goal(
    frame: str, frames: Sequence[str], poses: Sequence[Sequence[float]]
) -> tuple[str, Waypoints]:
    """Return the frame and the poses of a goal.

    Args:
        frame: Frame of the message.
        frames: Frames of its poses; '': that of the message.
        poses: The fields of each pose, as `from_pose` takes them.

    Raises:
        MessageError: There is no pose, a pose is invalid, or the poses are in several frames.
    """
    if not poses:
        raise MessageError('goals must contain at least one pose, got none (to stop, call cancel_goal)')
    distinct = {one or frame for one in frames}
    if len(distinct) > 1:
        raise MessageError(
            f'all poses must be given in one frame, got {messages.quoted(sorted(distinct))}'
        )
    read = np.array([messages.from_pose(*pose) for pose in poses])
    return distinct.pop(), Waypoints(read)
