"""Goals that are out of date."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.goal_follower import UNSTAMPED, Stamp
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.numerics.fields import Name
from diffdrive_jacobian.properties._goals import read_status
from diffdrive_jacobian.properties.base import Property, Watch


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
