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

"""What may be wrong with a topic, by who publishes it and who is subscribed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from diffdrive_jacobian.messages.topics import Topic
from diffdrive_jacobian.text import listed

SAME_NAMES = 'in the same namespace, or remap the topic ({}:=NAME)'
"""Where to start what `Topic.if_unread` and `Topic.if_unpublished` say."""
OF_SOMEBODY_ELSE = (
    "if it is somebody else's, a ROS_DOMAIN_ID of your own keeps it away, or, if it is on another "
    'machine of this network, ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST'
)
"""What to do about a second node of the same name."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TopicFault:
    """A fault that a topic may have."""

    present: Callable[[int, int], bool]
    """Returns whether it is present with so many publishers and subscriptions."""
    log: str
    """Line of the log, with `{topic}`, `{publishers}`, `{remedy}` and `{killed}`."""
    finding: str
    """Finding of the doctor, with `{topic}`, `{publishers}` and `{subscriptions}`."""
    remedy: Callable[[Topic], str]
    """Returns what to do about it. Empty: a topic of this kind may be so."""
    problem: bool = True
    """Whether something does not work with it."""

    def logged(self, topic: str, known: Topic, publishers: list[str]) -> str:
        """Return the line for the log of a node.

        Args:
            topic: Fully qualified name of the topic.
            known: The topic before it is remapped.
            publishers: The nodes that publish it.
        """
        # The graph keeps a node that was killed for 20 s, also beside its successor.
        repeated = len({*publishers}) < len(publishers)
        return self.log.format(
            topic=topic,
            publishers=listed(publishers),
            remedy=self.remedy(known),
            killed=f'; one that was killed disappears within 20 s; {OF_SOMEBODY_ELSE}'
            if repeated
            else '',
        )

    def found(self, topic: str, publishers: list[str], subscriptions: list[str]) -> str:
        """Return the finding of the doctor, without what to do about it."""
        return self.finding.format(
            topic=topic, publishers=listed(publishers), subscriptions=listed(subscriptions)
        )


def _start(program: str, known: Topic) -> str:
    return f'{program} {SAME_NAMES.format(known.name)}' if program else ''


UNREAD = TopicFault(
    present=lambda publishers, subscriptions: publishers > 0 and subscriptions <= 0,
    log='no node is subscribed to {topic}: {remedy}',
    finding='{publishers} publishes {topic}, but nobody subscribes to it',
    remedy=lambda known: _start(known.if_unread, known),
)
GOALS_LOST = replace(
    UNREAD,
    log='{publishers} publishes {topic}, but no controller is subscribed to it, so that goals are lost: '
    '{remedy}',
)
UNPUBLISHED = TopicFault(
    present=lambda publishers, subscriptions: subscriptions > 0 and not publishers,
    log='no node publishes {topic}: {remedy}',
    finding='{subscriptions} subscribes to {topic}, but nobody publishes it',
    remedy=lambda known: _start(known.if_unpublished, known),
)
SEVERAL = TopicFault(
    present=lambda publishers, subscriptions: publishers > 1,
    log='{publishers} publish {topic}: {remedy}{killed}',
    finding='{publishers} publish {topic}',
    remedy=lambda known: known.if_several,
)
ALTERNATING = TopicFault(
    present=SEVERAL.present,
    log='{publishers} publish {topic}, and their commands alternate: stop one of them, or put a '
    'multiplexer such as twist_mux between',
    finding='{publishers} publish {topic}: the robot follows the last command of either',
    remedy=lambda known: (
        'drive by hand only while no goal is active, or use a multiplexer such as twist_mux'
        if known.name == 'cmd_vel'
        else ''
    ),
    problem=False,
)
