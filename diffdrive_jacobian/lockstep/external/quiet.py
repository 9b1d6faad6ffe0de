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

"""When other processes have processed what they received: all their threads wait, without a break.

`Quiet` looks at a process with all that it has started, and at the threads of this process that receive
from them. It reads for how long each has run, then in which system call each thread waits, then whether
it sleeps, and then again for how long they have run. If all threads sleep and nothing has run
meanwhile, then all of them slept when the first reading was complete, and no message was on its way
from one to another. The system call does not tell: that of a thread that was woken up, and does not run
yet because its processor has to be told, is the one in which it waited.

A thread that sleeps for a time goes on by itself, so it counts as busy. So does one that waits with a
timeout in a callback (`idle`).
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterable
from contextlib import suppress

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep.external.idle import Idle
from diffdrive_jacobian.lockstep.external.linux import (
    ASLEEP,
    ENDLESS,
    NEVER,
    SELECTS,
    SLEEPS,
    STATES,
    STOPPED,
    WAITS,
    Thread,
)
from diffdrive_jacobian.lockstep.external.threads import Threads

TRIES = 30
"""Number of attempts that follow each other at once. Later ones leave the processor to others."""
MANY_TRIES = 200
"""Number of attempts after which the time is taken."""
PAUSE = 0.0002
"""Time between later attempts (s)."""
LONGEST = 10
"""Largest ratio of the wall time that a process gets to the time that it is given."""
IN_CALLBACK = 'waits in a callback, with a timeout'


class Quiet:
    """Observes a process with all that it starts, and the receiving threads of this one.

    Attributes:
        threads: The threads that are observed.
        idle: How those of the process wait when it is idle.
        waits_in_callback: Whether all was quiet at the last look but for callbacks that wait with a
            timeout.
    """

    def __init__(self, pid: int, own: Iterable[int]) -> None:
        """Start to observe.

        Args:
            pid: The process.
            own: Ids of the threads of this process that receive its messages.

        Raises:
            LockstepError: The process may not be observed.
        """
        machine = platform.machine()
        self._sleeps, self._selects, self._waits = SLEEPS[machine], SELECTS[machine], WAITS[machine]
        self.threads = Threads(pid, own)
        self.idle = Idle(self.threads)
        self.waits_in_callback = False
        self._busy: Thread | None = None
        self._why = ''

    def wait(self, patience: float, asks: Callable[[], bool]) -> None:
        """Wait until all is quiet.

        Args:
            patience: Longest time (s), as of `Allowance`.
            asks: Called if all is quiet but for callbacks that wait with a timeout. Returns whether they
                wait for responses of the world.

        Raises:
            LockstepError: It does not become quiet.
        """
        tries = 0
        allowance: Allowance | None = None
        while not self.is_quiet():
            if self.waits_in_callback and asks():
                return
            tries += 1
            if tries < TRIES:
                os.sched_yield()
                continue
            if tries == MANY_TRIES:
                allowance = Allowance(self, patience)
            if allowance is not None and allowance.is_used_up():
                # What is stopped is the cause, also if another thread is about to run.
                with suppress(ProcessLookupError):
                    for thread in self.threads.others:
                        if thread.state() in STOPPED:
                            self._is_awake(thread)
                raise LockstepError(f'not quiet within {patience:g} s: {self.describe()}')
            time.sleep(PAUSE)

    def is_quiet(self) -> bool:
        """Look once. Return whether nothing was being done."""
        self.waits_in_callback = False
        try:
            if self._busy is not None and self._is_busy(self._busy) and self._why != IN_CALLBACK:
                return False
            self._busy, waiting = None, None
            before = self.threads.run_times()
            # Ended threads are noticed below.
            if self.threads.have_changed():
                return False
            for thread in self.threads:
                if self._is_busy(thread):
                    self._busy = thread
                    if self._why != IN_CALLBACK:
                        return False
                    waiting = thread
            # Until a thread that was woken up gets a processor it is in its system call still.
            if any(map(self._is_awake, self.threads)):
                return False
            if self.threads.run_times() != before:
                return False
            self.waits_in_callback = waiting is not None
            return waiting is None
        except ProcessLookupError:
            # A thread has ended. The next look is at what is left.
            self._busy = None
            self.threads.look_again()
            return False

    def _is_awake(self, thread: Thread) -> bool:
        """Return whether a thread does not sleep, by its state, whatever its system call is.

        Raises:
            ProcessLookupError: It has ended.
        """
        state = thread.state()
        if state in ASLEEP:
            return False
        self._busy, self._why = thread, STATES.get(state, f'has the state {state.decode()}')
        return True

    def _is_busy(self, thread: Thread) -> bool:
        """Return whether a thread runs, is about to, or will go on by itself.

        Raises:
            ProcessLookupError: It has ended.
        """
        call = os.pread(thread.call, 256, 0)
        if call == thread.idle:
            return False
        number, *arguments = call.split()
        place = self._waits.get(number)
        if number == b'running':
            self._why = STATES[b'R']
            return True
        if number in self._sleeps:
            self._why = 'sleeps'
            return True
        if place is None:
            return self._is_active(thread)
        if place != NEVER and arguments[place] not in ENDLESS:
            if number in self._selects and arguments[0] == b'0x0':
                self._why = 'sleeps'
                return True
            if self.idle.is_in_callback(thread, arguments):
                self._why = IN_CALLBACK
                return True
        thread.idle = call
        return False

    def _is_active(self, thread: Thread) -> bool:
        """Return whether a thread does something in a system call, such as to wait for a disk."""
        state = thread.state()
        if state in (b'Z', b'X'):
            # Its parent has still to be woken up when its state changes.
            new = thread.tid not in self.threads.zombies
            self.threads.zombies.add(thread.tid)
            return new
        self._why = STATES.get(state, f'has the state {state.decode()}')
        return state != b'S'

    def describe(self) -> str:
        """Return which thread was busy last, and how."""
        if self._busy is None:
            return 'processes come and go'
        thread = self._busy
        command = thread.read('cmdline').replace('\0', ' ').strip()
        name = thread.read('comm').strip()
        return f"thread {thread.tid} ('{name}') of {command} (pid {thread.pid}) {self._why}"


class Allowance:
    """A limit for the time that processes need, without that for which they waited for a processor.

    So it does not depend on what else the machine does, within reason.
    """

    def __init__(self, quiet: Quiet, seconds: float) -> None:
        """Begin now, with a number of seconds."""
        self._threads, self._seconds = quiet.threads, seconds
        self._begin, self._delay = time.monotonic(), self._threads.delay()

    def is_used_up(self) -> bool:
        """Return whether it has passed."""
        passed = time.monotonic() - self._begin
        if passed <= self._seconds:
            return False
        delay = self._threads.delay() - self._delay
        return passed - delay > self._seconds or passed > LONGEST * self._seconds


class BegunLater:
    """An allowance that begins when it is asked first."""

    def __init__(self, quiet: Quiet, seconds: float) -> None:
        """Do not begin yet."""
        self._quiet, self._seconds = quiet, seconds
        self._allowance: Allowance | None = None

    def is_used_up(self) -> bool:
        """Return whether it has passed since it was asked first."""
        if self._allowance is None:
            self._allowance = Allowance(self._quiet, self._seconds)
        return self._allowance.is_used_up()
