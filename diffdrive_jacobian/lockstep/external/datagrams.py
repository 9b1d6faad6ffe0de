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

"""Whether datagrams were lost between the world and a process.

Both receive through UDP. On one machine a datagram is lost only if the queue of the socket that receives
it is full. The system counts that for each socket.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import suppress

from diffdrive_jacobian.lockstep.external.linux import enlarge_queue, lost_datagrams, sockets_of

PERIOD = 0.05
"""Least time between two looks at the counters, which take 0.3 to 0.8 ms (s)."""


class Datagrams:
    """Counts the datagrams that the sockets of the world, or of processes, have lost."""

    def __init__(self) -> None:
        """Start without sockets."""
        self._lost: dict[str, int] = {}
        """By socket, as counted last."""
        self._looked = 0.0

    def watch(self, pid: int, *, but: Iterable[str] = ()) -> None:
        """Count for the sockets of a process, too, `but` some, and enlarge their queues."""
        sockets = sockets_of(pid)
        new = sockets.keys() - self._lost.keys() - set(but)
        for number in new:
            with suppress(OSError):
                enlarge_queue(pid, sockets[number])
        self._lost |= {number: lost for number, lost in lost_datagrams().items() if number in new}

    def lost(self, *, now: bool = False) -> int:
        """Return how many were lost since the last call.

        Args:
            now: Whether to look, even if that was done just before.
        """
        if not now and time.monotonic() - self._looked < PERIOD:
            return 0
        counters = lost_datagrams()
        before, self._lost = self._lost, {one: counters.get(one, n) for one, n in self._lost.items()}
        self._looked = time.monotonic()
        return sum(self._lost.values()) - sum(before.values())
