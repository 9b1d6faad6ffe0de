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

"""How the threads of an idle process wait, and so which of them wait in a callback.

A thread that waits with a timeout is in a callback, unless it is DDS that waits, as in an idle executor,
or it is a thread that does so in an idle process. Who waits is seen on the stack: the return addresses
of waits with a timeout are at the same places as in the threads of Fast DDS.
"""

from __future__ import annotations

import platform
from collections.abc import Collection

from diffdrive_jacobian.lockstep.external.linux import (
    ENDLESS,
    FUTEX,
    NEVER,
    WAITS,
    Thread,
    code_of,
    stack_of,
    stack_pointer,
)
from diffdrive_jacobian.lockstep.external.threads import THREADS_OF_DDS, Threads

RCLCPP = 'librclcpp.so'
"""Library of nodes in C++."""
DDS = 'libfastrtps.so'
"""Library whose waits are those of an idle node."""
DEEPER = 1024
"""Size of the part of a stack that a callback uses at least until it waits (bytes)."""


class Idle:
    """What was learned of a process while it was idle.

    Attributes:
        loops: Whether all executors that wait with a timeout have done so several times.
        timed_executors: How many executors do, as if they have a timer on wall time.
        polls_files: Whether a thread waits for files with a timeout, as an event loop does.
        new_thread_waits: Whether a thread that it did not have has waited with a timeout since.
    """

    def __init__(self, threads: Threads) -> None:
        """Start without having learned anything."""
        self._threads, self._waits = threads, WAITS[platform.machine()]
        self.loops = True
        self.timed_executors = 0
        self.polls_files = False
        self.new_thread_waits = False
        self._places: set[int] | None = None
        """Places on the stack of return addresses of waits with a timeout. None: not known yet."""
        self._polling: set[int] = set()
        """Threads that wait with a timeout, but not in DDS."""
        self._depths: dict[int, int] = {}
        """Address of the top of the stack of each thread."""
        self._spinning: set[Thread] = set()
        """Main threads that wait in DDS."""
        self._runs: dict[tuple[int, int], int] = {}
        """How often a thread that waits with a timeout had run when it was first seen there."""
        self._dds: dict[int, list[range]] = {}

    def learn(self) -> None:
        """Note which threads wait with a timeout, and how: the process is idle, and was found quiet."""
        timed, calls = [], {}
        self._spinning = set()
        for thread in self._threads.others:
            number, *arguments = thread.idle.split() or [b'']
            if arguments:
                self._depths[thread.tid] = stack_pointer(arguments)
                main = thread.tid == thread.pid
                if main and number in FUTEX and self._addresses(thread, arguments):
                    self._spinning.add(thread)
            place = self._waits.get(number, NEVER)
            if place != NEVER and arguments[place] not in ENDLESS:
                timed.append((thread, self._addresses(thread, arguments)))
                calls[thread] = number
            thread.idle = b''
        named = [found for thread, found in timed if _is_of_dds(thread)]
        self._places = {min(found) for found in named if found}
        executors = [
            thread
            for thread, found in timed
            if not self._places.isdisjoint(found) and not _is_of_dds(thread)
        ]
        self._learn_loops(executors)
        polling = {thread for thread, found in timed if self._places.isdisjoint(found)}
        self._polling = {thread.tid for thread in polling}
        self.polls_files = any(number not in FUTEX for number in map(calls.get, polling))

    def _learn_loops(self, executors: list[Thread]) -> None:
        """Note how often threads of executors that wait with a timeout have run."""
        before, self._runs = self._runs, {}
        self.loops = True
        for thread in executors:
            key = thread.tid, self._depths[thread.tid]
            runs = int(thread.read('schedstat').split()[2])
            self._runs[key] = min(runs, before.get(key, runs))
            self.loops = self.loops and runs > self._runs[key]
        self.timed_executors = len(self._runs)

    def is_in_callback(self, thread: Thread, arguments: list[bytes]) -> bool:
        """Return whether a thread that waits with a timeout does so neither in DDS nor always."""
        if self._places is None or thread.own:
            return False
        if thread.tid not in self._depths:
            # A new thread, as an executor starts them for callbacks, and DDS for a new participant.
            new = not _is_of_dds(thread)
            self.new_thread_waits |= new
            return new
        if stack_pointer(arguments) < self._depths[thread.tid] - DEEPER:
            return True
        if thread.tid in self._polling:
            return False
        return self._places.isdisjoint(self._addresses(thread, arguments))

    def is_stuck(self) -> bool:
        """Return whether the main thread of a quiet process has not returned from a callback."""
        return bool(self._spinning) and all(map(self._is_elsewhere, self._spinning))

    def _is_elsewhere(self, thread: Thread) -> bool:
        """Return whether a thread waits, but not in DDS as in the idle process."""
        call = thread.idle.split()
        if len(call) < 3 or stack_pointer(call) == self._depths[thread.tid]:
            return False
        return not self._addresses(thread, call[1:])

    def spins(self) -> bool:
        """Return whether the main thread of a process waits in DDS now, as an executor does."""
        for thread in self._threads.others:
            call = thread.read('syscall').encode().split() if thread.tid == thread.pid else []
            if len(call) > 2 and self._addresses(thread, call[1:]):
                return True
        return False

    def cpp_executor_threads(self, pid: int, sleeping: Collection[int] = ()) -> int:
        """Return how many threads of executors an idle process in C++ has. 0: it is not in C++.

        Threads that are known to be sleeping are none.
        """
        threads = [thread for thread in self._threads.others if thread.pid == pid]
        code = code_of(threads[0], RCLCPP) if threads else []
        if not code:
            return 0
        found = 0
        for thread in threads:
            call = thread.read('syscall').encode().split()
            if len(call) > 2 and thread.tid not in sleeping and not self._addresses(thread, call[1:]):
                found += any(word in part for word in stack_of(thread, call) for part in code)
        # One of them waits for DDS, and one of rclcpp's threads, which is none of them, for signals.
        return max(found, 1)

    def _addresses(self, thread: Thread, arguments: list[bytes]) -> set[int]:
        """Return at which places on its stack a thread has addresses of code of DDS."""
        if thread.pid not in self._dds:
            self._dds[thread.pid] = code_of(thread, DDS)
        code = self._dds[thread.pid]
        words = stack_of(thread, arguments)
        return {place for place, word in enumerate(words) for part in code if word in part}


def _is_of_dds(thread: Thread) -> bool:
    return thread.read('comm').startswith(THREADS_OF_DDS)
