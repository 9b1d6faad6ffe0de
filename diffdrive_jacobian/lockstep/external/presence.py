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

"""Whether the nodes of a process are those that it had, and follow simulated time."""

from __future__ import annotations

import time

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep.external.discovery import Discovery
from diffdrive_jacobian.lockstep.external.domain import Domain
from diffdrive_jacobian.lockstep.external.graph import marks
from diffdrive_jacobian.messages.names import node_of

PERIOD = 0.01
"""Period at which the graph is looked at (s)."""
DESTRUCTION = 0.5
"""Time in which all entities of a node that is destroyed disappear, and a new one appears (s)."""


class Presence:
    """The nodes of a process that there were when it was last looked."""

    def __init__(self, domain: Domain, discovery: Discovery) -> None:
        """Start without nodes."""
        self._domain, self._discovery = domain, discovery
        self._marks: dict[str, bytes] = {}
        """What differs if a node is created anew."""

    def untimed(self) -> list[str]:
        """Return the nodes that should receive the time and do not, as far as is discovered."""
        if not self._domain.command.use_sim_time:
            return []
        timed = {
            node_of(info)
            for topic in self._discovery.clock_publishers
            for info in self._domain.node.get_subscriptions_info_by_topic(topic)
        }
        return sorted(self._discovery.stand_ins.keys() - timed)

    def note(self) -> None:
        """Note which nodes there are, for `check`."""
        self._marks = marks(self._domain.node)

    def check(self) -> None:
        """Check that the nodes of a process that runs are those that were there before.

        Raises:
            LockstepError: They are not, or do not follow simulated time any more.
        """
        end, before = time.monotonic() + DESTRUCTION, set(self._marks)
        while not (gone := self._gone()) and (untimed := self.untimed()):
            if time.monotonic() > end:
                names = ', '.join(untimed)
                if before.issuperset(untimed):
                    raise LockstepError(f'{names} has stopped to follow simulated time')
                raise LockstepError(
                    f'{names} does not follow simulated time: its parameter use_sim_time must be true; '
                    'a component has it from the request that loads it (LoadNode, parameters), not from '
                    'its container'
                )
            # A node that is destroyed loses its entities one by one.
            time.sleep(PERIOD)
        if gone:
            raise LockstepError(
                f'{", ".join(gone)} was destroyed, or created anew, while {self._domain.title} runs: '
                'what is sent meanwhile would be lost or not, from run to run. In lockstep a process '
                'keeps its nodes until it ends; Kill, or stop() and start(), create them anew'
            )

    def _gone(self) -> list[str]:
        """Return the nodes that were destroyed, or created anew, since this was last asked."""
        there = {graph.full_name for graph in self._discovery.graph()}
        now = marks(self._domain.node)
        anew = {name for name, mark in now.items() if self._marks.get(name, mark) != mark}
        self._marks = {**self._marks, **now}
        return sorted(name for name in self._discovery.stand_ins if name in anew or name not in there)
