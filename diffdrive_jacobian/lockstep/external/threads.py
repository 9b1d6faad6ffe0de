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

"""The threads of a process with all that it has started, and those of this one that receive from it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress

from diffdrive_jacobian.lockstep.external.linux import (
    LOADAVG,
    Thread,
    links_of_threads,
    own_run_times,
    run_time,
    threads_of,
)

THREADS_OF_DDS = 'dds.'
"""Beginning of the names of the threads of Fast DDS itself."""
CLOSED = -1
"""Stands for a file that was closed."""


class Threads:
    """The threads that are observed. Those of ended processes raise ProcessLookupError."""

    def __init__(self, pid: int, own: Iterable[int]) -> None:
        """Start to observe.

        Args:
            pid: The process.
            own: Ids of the threads of this process that receive its messages.

        Raises:
            LockstepError: The process may not be observed.
        """
        self._links = {pid: 0}
        """Number of links of the folder of the threads, by process: it changes with their number."""
        self._loadavg = os.open(LOADAVG, os.O_RDONLY)
        self._newest = b''
        """Id of the newest thread on this machine when it was last looked which threads there are."""
        self.own = [Thread(os.getpid(), tid, own=True) for tid in own]
        self._others: dict[tuple[int, int], Thread] = {}
        self.zombies: set[int] = set()
        """Threads that have ended and were not waited for. The main one has the id of its process."""

    def __iter__(self) -> Iterator[Thread]:
        """Yield all of them, those of this process last."""
        yield from self._others.values()
        yield from self.own

    @property
    def others(self) -> list[Thread]:
        """Those of the process and of all that it has started."""
        return list(self._others.values())

    def listeners(self) -> list[int]:
        """Return those of this process that receive what nodes tell of themselves, alone: of rmw."""
        return [one.tid for one in self.own if not one.read('comm').startswith(THREADS_OF_DDS)]

    def processes(self) -> list[int]:
        """Return the ids of the process and of all that it has started and that lives."""
        with suppress(ProcessLookupError):
            while self.update():
                pass
        return list(self._links)

    def has_ended(self, pid: int) -> bool:
        """Return whether a process of those that are observed had ended when it was looked at last."""
        return pid not in self._links or pid in self.zombies

    def run_times(self) -> list[int]:
        """Return for how long the processes, and the threads of this one, have run (ns)."""
        try:
            return [*map(run_time, self._links), *own_run_times(thread.tid for thread in self.own)]
        except OSError:
            raise ProcessLookupError from None

    def delay(self) -> float:
        """Return for how long all threads together have waited for a processor (s)."""
        self.processes()
        counters = [thread.read('schedstat').split() for thread in self]
        return sum(int(counter[1]) for counter in counters if counter) / 1e9

    def have_changed(self) -> bool:
        """Return whether there are others than at the last call. Ended ones may not be noticed."""
        newest = os.pread(self._loadavg, 128, 0).rpartition(b' ')[2]
        if newest == self._newest:
            return False
        if self.update():
            return True
        self._newest = newest
        return False

    def look_again(self) -> None:
        """Find out which there are, after one has turned out to have ended."""
        self._newest = b''
        self._links = dict.fromkeys(self._links, 0)
        with suppress(ProcessLookupError):
            self.update()

    def update(self) -> bool:
        """Open the files of new threads, close those of ended ones. Return whether there were any."""
        changed = False
        for pid, known in list(self._links.items()):
            try:
                links = links_of_threads(pid)
                if links == known:
                    continue
                present = {(pid, tid) for tid in threads_of(pid)}
            except (FileNotFoundError, ProcessLookupError):
                links, present = 0, set()
            changed = True
            for key in [key for key in self._others if key[0] == pid and key not in present]:
                self._others.pop(key).close()
                self.zombies.discard(key[1])
            for key in sorted(present - self._others.keys()):
                self._others[key] = Thread(*key)
            self._links[pid] = links
            if not present:
                del self._links[pid]
        for thread in self._others.values():
            for child in os.pread(thread.children, 4096, 0).split():
                if int(child) not in self._links:
                    self._links[int(child)] = 0
                    changed = True
        return changed

    def close(self) -> None:
        """End the observation."""
        for thread in self:
            thread.close()
        if self._loadavg != CLOSED:
            os.close(self._loadavg)
        self._others, self.own, self._loadavg = {}, [], CLOSED
