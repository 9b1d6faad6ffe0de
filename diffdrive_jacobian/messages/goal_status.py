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

"""States of a goal, and what became of the goals that were sent to a controller.

A status names its goal by the stamp of the message that contained the goal. It may be received before
the goal, as they are different topics, and several goals may have the same stamp, such as none.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import Generic, TypeAlias, TypeVar


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


G = TypeVar('G')
Stamp: TypeAlias = tuple[int, int]
"""sec and nanosec of a message, which may be anything."""
UNSTAMPED: Stamp = (0, 0)
MAX_KNOWN = 32
"""Number of stamps whose goals are remembered."""


class Fate(Enum):
    """What became of a goal."""

    WAITING = auto()
    """It has no status yet."""
    ACTIVE = auto()
    """The controller drives to it."""
    SUCCEEDED = auto()
    """The robot has arrived."""
    REPLACED = auto()
    """The controller ended it, or drives to another one, because a later goal was sent."""
    CANCELED = auto()
    """The controller ended it on request."""
    ABORTED = auto()
    """The controller gave it up."""
    REFUSED = auto()
    """The controller never accepted it."""

    @property
    def is_end(self) -> bool:
        """Whether the controller has finished with it, and not because of a later goal."""
        return self not in (Fate.WAITING, Fate.ACTIVE, Fate.REPLACED)


@dataclass(slots=True, eq=False)
class FollowedGoal(Generic[G]):
    """A goal and its last status."""

    goal: G | None
    """What was sent. None: only statuses of it were received."""
    stamp: Stamp
    state: GoalState = GoalState.UNKNOWN
    since: float = 0.0
    """Time of its last status."""
    accepted: bool = False
    """Whether the controller has driven to it."""
    replaced: bool = False
    """Whether the controller left it for another goal."""
    earlier: FollowedGoal[G] | None = None
    """The goal with the same stamp that was active when this one was sent."""

    @property
    def fate(self) -> Fate:
        """What became of it."""
        if self.replaced:
            return Fate.REPLACED
        if self.state.active:
            return Fate.ACTIVE
        if self.state is GoalState.ABORTED and not self.accepted:
            return Fate.REFUSED
        return _FATES[self.state]


_FATES = {
    GoalState.UNKNOWN: Fate.WAITING,
    GoalState.SUCCEEDED: Fate.SUCCEEDED,
    GoalState.CANCELED: Fate.CANCELED,
    GoalState.ABORTED: Fate.ABORTED,
}


class GoalFollower(Generic[G]):
    """Follows the goals of one controller, which drives to one of them at a time."""

    def __init__(self) -> None:
        """Start without goals."""
        self.newest: FollowedGoal[G] | None = None
        """The goal that was sent last."""
        self.driving: FollowedGoal[G] | None = None
        """The goal that the controller drives to. None: it drives to none."""
        self._goals: dict[Stamp, FollowedGoal[G]] = {}

    def sent(self, goal: G, stamp: Stamp) -> FollowedGoal[G]:
        """Take a goal that was sent; return it with its status, which may have been received before."""
        known = self._goals.get(stamp)
        # An unstamped goal that has ended was another one.
        if known is not None and known.goal is None and (known.state.active or stamp != UNSTAMPED):
            known.goal, self.newest = goal, known
            return known
        self.newest = followed = FollowedGoal(goal, stamp)
        if known is not None:
            followed.earlier = known if known.state.active else known.earlier
        self._remember(followed)
        return followed

    def reported(self, status: int, stamp: Stamp, time: float = 0.0) -> FollowedGoal[G] | None:
        """Take a status that the controller has published.

        Args:
            status: Number of action_msgs/GoalStatus. UNKNOWN and invalid numbers are ignored.
            stamp: Stamp of the goal.
            time: When it was received, in any unit.

        Returns:
            The goal whose fate has changed. None: there is none.
        """
        if status == GoalState.UNKNOWN or status not in set(GoalState):
            return None
        state = GoalState(status)
        followed = self._concerned(state, stamp)
        before = followed.fate
        followed.state, followed.since = state, time
        if state.active:
            if self.driving is not None:
                self.driving.replaced = True
            self.driving = followed
            followed.accepted, followed.replaced, followed.earlier = True, False, None
        else:
            newest = self.newest
            makes_room = newest is not None and newest is not followed and not newest.state.ended
            followed.replaced = state is not GoalState.SUCCEEDED and followed.accepted and makes_room
            if self.driving is followed:
                self.driving = None
        return None if followed.fate is before else followed

    def _concerned(self, state: GoalState, stamp: Stamp) -> FollowedGoal[G]:
        """Return the goal that a status is about."""
        newest = self._goals.get(stamp)
        if newest is not None and newest.earlier is not None and not newest.earlier.state.ended:
            return self._one_of_two(newest, newest.earlier, state)
        # An unstamped goal that has ended was another one.
        ended_before = stamp == UNSTAMPED and newest is not None and newest.state.ended
        if newest is not None and not (ended_before and state.active):
            return newest
        followed: FollowedGoal[G] = FollowedGoal(None, stamp)
        self._remember(followed)
        return followed

    @staticmethod
    def _one_of_two(
        newest: FollowedGoal[G], earlier: FollowedGoal[G], state: GoalState
    ) -> FollowedGoal[G]:
        """Return which of two goals with the same stamp a status is about; the earlier one is active."""
        if not newest.state.ended:
            # The controller accepts or refuses the newest one before anything else.
            return newest if state in (GoalState.ACCEPTED, GoalState.ABORTED) else earlier
        # It has refused the newest one, and repeats the state of the earlier one.
        repeated = state is not GoalState.ACCEPTED or earlier.state is GoalState.ACCEPTED
        return earlier if repeated else newest

    def _remember(self, followed: FollowedGoal[G]) -> None:
        self._goals.pop(followed.stamp, None)
        self._goals[followed.stamp] = followed
        if len(self._goals) > MAX_KNOWN:
            del self._goals[next(iter(self._goals))]
