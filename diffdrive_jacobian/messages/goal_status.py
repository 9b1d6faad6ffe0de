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

    @property
    def active(self) -> bool:
        """Whether the controller drives to the goal."""
        return self in ACTIVE

    @property
    def ended(self) -> bool:
        """Whether the controller does not drive to the goal any more."""
        return self in ENDED

    @property
    def word(self) -> str:
        """What a user reads: 'arrived', and otherwise the name in lower case."""
        return 'arrived' if self is GoalState.SUCCEEDED else self.name.lower()


ACTIVE = (GoalState.ACCEPTED, GoalState.EXECUTING, GoalState.CANCELING)
ENDED = (GoalState.SUCCEEDED, GoalState.CANCELED, GoalState.ABORTED)
FOLLOWING = {
    GoalState.UNKNOWN: (GoalState.ACCEPTED, GoalState.ABORTED),
    GoalState.ACCEPTED: (*ACTIVE, GoalState.CANCELED, GoalState.ABORTED),
    GoalState.EXECUTING: (GoalState.EXECUTING, GoalState.CANCELING, *ENDED),
    GoalState.CANCELING: (GoalState.CANCELING, *ENDED),
    **dict.fromkeys(ENDED, ()),
}
"""What may follow each state. UNKNOWN: the goal has had no status. ABORTED may come first: refused."""
