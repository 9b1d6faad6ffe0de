"""States of a goal, as action_msgs/GoalStatus numbers them, for code that needs no message package."""

from __future__ import annotations

from enum import IntEnum


class GoalState(IntEnum):
    """Constants of action_msgs/msg/GoalStatus."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6
