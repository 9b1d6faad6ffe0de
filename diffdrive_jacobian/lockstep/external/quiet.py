"""When another process has processed what it received: all its threads wait, without a break.

`Quiet` looks at the threads of a process and of all that it has started, and at those of this process
that receive from it, in two rounds. The first reads of each thread for how long it has run
(`/proc/PID/task/TID/schedstat`), the second whether it sleeps (`stat`), in which system call
(`syscall`), and again for how long it has run. Of a thread for which both times are equal, and that
sleeps in the second round, it is known that it did not run in between, and was not about to. So if this
holds for all of them, there was a moment between the rounds at which none did anything, and no message
was on its way from one to the other.

A thread that sleeps for a time, as in `time.sleep`, goes on by itself. It counts as busy. So does one
that waits with a timeout at another place of its stack than in an idle process: it is in a callback.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from diffdrive_jacobian.lockstep._errors import LockstepError

SLEEPS = {
    'x86_64': ({b'35', b'230'}, {b'7', b'23', b'270', b'271'}),
    'aarch64': ({b'101', b'115'}, {b'72', b'73'}),
}
"""Numbers of the system calls that sleep (nanosleep, clock_nanosleep), and of those that do if they have
no file to wait for (poll, select, pselect6, ppoll), for each machine."""
TIMED = {
    'x86_64': {b'202': 3, b'7': 2, b'271': 2, b'270': 4, b'23': 4, b'232': 3, b'281': 3},
    'aarch64': {b'98': 3, b'73': 2, b'72': 4, b'22': 3},
}
"""Numbers of the system calls that wait (futex, poll, select, epoll), with the place of their timeout
among the arguments, for each machine."""
ENDLESS = (b'0x0', b'0xffffffff', b'0xffffffffffffffff')
"""Timeouts that are none."""
TRIES = 30
"""Number of attempts that follow each other at once. Later ones leave the processor to others."""
PAUSE = 0.0001
"""Time between later attempts (s)."""
STATES = {b'R': 'is running', b'D': 'waits for a disk', b'T': 'is stopped', b't': 'is being debugged'}
ENDED = (b'Z', b'X')
"""States of threads that have ended."""


class _Thread(NamedTuple):
    """The open files of a thread below /proc."""

    pid: int
    tid: int
    own: bool
    """Whether it is a thread of this process."""
    stat: int
    counter: int
    call: int
    children: int

    def close(self) -> None:
        """Close the files."""
        for descriptor in (self.stat, self.counter, self.children, self.call):
            if descriptor >= 0:
                os.close(descriptor)


def check_platform() -> None:
    """Raise LockstepError if the threads of other processes cannot be observed on this machine."""
    machine = platform.machine()
    if sys.platform != 'linux' or machine not in SLEEPS:
        raise LockstepError(
            'nodes in other processes need Linux on x86_64 or aarch64, which shows in /proc whether a '
            f'process has processed its input; this is {sys.platform} on {machine}'
        )
    try:
        _read(os.open('/proc/self/schedstat', os.O_RDONLY), close=True)
    except OSError as error:
        raise LockstepError(
            f'this kernel does not show when a thread has run: /proc/self/schedstat: {error.strerror}'
        ) from error


def threads_of_this_process() -> set[int]:
    """Return the ids of the threads of this process."""
    return set(map(int, os.listdir('/proc/self/task')))


class Quiet:
    """Observes a process with all that it starts, and the receiving threads of this one."""

    def __init__(self, pid: int, own: Iterable[int]) -> None:
        """Start to observe.

        Args:
            pid: The process.
            own: Ids of the threads of this process that receive its messages.

        Raises:
            LockstepError: The process may not be observed.
        """
        self._sleeps, self._polls = SLEEPS[platform.machine()]
        self._timed = TIMED[platform.machine()]
        self.learning = True
        """Whether the process is idle, so that its threads wait where they do when they are."""
        self._idle: set[tuple[int, int, bytes]] = set()
        """Threads and stack pointers, of waits with a timeout in an idle process."""
        self._threads: dict[tuple[int, int], _Thread] = {}
        self._sizes: dict[int, int] = {pid: 0}
        """Number of links of the folder of the threads, by process."""
        self._own = [self._open(os.getpid(), tid, own=True) for tid in own]
        self._busy: _Thread | None = None
        self._why = ''
        self._ended: set[tuple[int, int]] = set()

    def has_ended(self, pid: int) -> bool:
        """Return whether a process of those that are observed had ended when it was looked at last."""
        return pid not in self._sizes or (pid, pid) in self._ended

    def close(self) -> None:
        """End the observation."""
        for thread in (*self._threads.values(), *self._own):
            thread.close()
        self._threads, self._own = {}, []

    # --- Waiting

    def wait(self, patience: float, check: Callable[[], None]) -> None:
        """Wait until all is quiet.

        Args:
            patience: Longest wall time (s).
            check: Called now and then. It raises an error if there is nothing to wait for.

        Raises:
            LockstepError: It does not become quiet.
        """
        end = time.monotonic() + patience
        tries = 0
        while not self.is_quiet():
            tries += 1
            if tries < TRIES:
                os.sched_yield()
                continue
            check()
            if time.monotonic() > end:
                raise LockstepError(f'not quiet within {patience:g} s of wall time: {self.describe()}')
            time.sleep(PAUSE)

    def is_quiet(self) -> bool:
        """Look once. Return whether nothing was being done."""
        try:
            if self._busy is not None and self._is_busy(self._busy):
                return False
            self._update()
            threads = [*self._threads.values(), *self._own]
            counters = [os.pread(thread.counter, 64, 0) for thread in threads]
            # Between the rounds: one that is new now was not in the first.
            if self._update() or self._has_new_children(threads):
                return False
            for thread, counter in zip(threads, counters, strict=True):
                if self._is_busy(thread) or os.pread(thread.counter, 64, 0) != counter:
                    self._busy = thread
                    return False
            return True
        except ProcessLookupError:
            # A thread has ended. The next look is at what is left.
            self._busy = None
            self._sizes = dict.fromkeys(self._sizes, 0)
            return False

    def _is_busy(self, thread: _Thread) -> bool:
        """Return whether a thread runs, is about to, or sleeps for a time.

        Raises:
            ProcessLookupError: It has ended.
        """
        _, _, rest = os.pread(thread.stat, 512, 0).rpartition(b') ')
        state = rest[:1]
        if state != b'S':
            self._why = STATES.get(state, f'has the state {state.decode()}')
            return state not in ENDED or not self._was_ended(thread)
        if thread.call < 0:
            return False
        return self._waits_in_callback(thread, os.pread(thread.call, 256, 0).split())

    def _waits_in_callback(self, thread: _Thread, call: list[bytes]) -> bool:
        """Return whether a thread sleeps for a time, or waits with a timeout as it does not when idle.

        Args:
            thread: The thread.
            call: Number, arguments, stack pointer and program counter of its system call.
        """
        number = call[0]
        if number in self._sleeps or (number in self._polls and _waits_for_no_file(number, call[1:])):
            self._why = 'sleeps'
            return True
        place = self._timed.get(number)
        if place is None or call[1 + place] in ENDLESS:
            return False
        wait = (thread.pid, thread.tid, call[-2])
        if self.learning:
            self._idle.add(wait)
        self._why = 'waits in a callback, with a timeout'
        return wait not in self._idle

    def _was_ended(self, thread: _Thread) -> bool:
        """Return whether a thread had ended when it was looked at before.

        When its state changes, it has still to wake up its parent.
        """
        if thread[:2] in self._ended:
            return True
        self._ended.add(thread[:2])
        return False

    # --- Which threads there are

    def _update(self) -> bool:
        """Open the files of new threads, close those of ended ones. Return whether there were any."""
        before = dict(self._sizes)
        for pid, size in self._sizes.items():
            try:
                links = os.stat(f'/proc/{pid}/task').st_nlink
            except FileNotFoundError:
                links = -1
            if links == size:
                continue
            self._sizes[pid] = links
            try:
                present = (
                    {(pid, int(tid)) for tid in os.listdir(f'/proc/{pid}/task')} if links > 0 else set()
                )
            except FileNotFoundError:
                present = set()
            for key in [key for key in self._threads if key[0] == pid and key not in present]:
                self._threads.pop(key).close()
                self._ended.discard(key)
            for key in sorted(present - self._threads.keys()):
                self._threads[key] = self._open(*key)
            if self._busy not in self._threads.values():
                self._busy = None
        self._sizes = {pid: links for pid, links in self._sizes.items() if links > 0}
        return self._sizes != before

    def _has_new_children(self, threads: Iterable[_Thread]) -> bool:
        """Add what the processes have started. Return whether there was anything new."""
        found = {
            int(child)
            for thread in threads
            if not thread.own
            for child in os.pread(thread.children, 4096, 0).split()
        }
        new = found - self._sizes.keys()
        self._sizes.update(dict.fromkeys(new, 0))
        return bool(new)

    def _open(self, pid: int, tid: int, *, own: bool = False) -> _Thread:
        """Open the files of a thread. The calls of Fast DDS are not looked at: it never sleeps."""
        descriptors: list[int] = []
        folder = f'/proc/{pid}/task/{tid}'
        try:
            for name in ('stat', 'schedstat', 'children', 'syscall'):
                descriptors.append(os.open(f'{folder}/{name}', os.O_RDONLY))
            stat, counter, children, call = descriptors
            if own or b'(dds.' in _read(stat):
                os.close(call)
                call = -1
            else:
                _read(call)
            return _Thread(pid, tid, own, stat, counter, call, children)
        except PermissionError as error:
            raise LockstepError(
                f'{folder}/syscall cannot be read, which shows whether a thread sleeps: a container '
                'needs --cap-add=SYS_PTRACE, and /proc/sys/kernel/yama/ptrace_scope must be 0 or 1'
            ) from error
        except (FileNotFoundError, ProcessLookupError):
            for descriptor in descriptors:
                os.close(descriptor)
            raise ProcessLookupError from None

    # --- Failures

    def describe(self) -> str:
        """Return which thread was busy last, and how."""
        if self._busy is None:
            return 'processes come and go'
        thread = self._busy
        name = _text(f'/proc/{thread.pid}/task/{thread.tid}/comm')
        command = _text(f'/proc/{thread.pid}/cmdline').replace('\0', ' ').strip()
        return f"thread {thread.tid} ('{name}') of {command} (pid {thread.pid}) {self._why}"


def _waits_for_no_file(number: bytes, arguments: list[bytes]) -> bool:
    """Return whether a call of poll or select has no file, and so only waits for its timeout."""
    # The number of files is the second argument of poll, and the first of select.
    place = 1 if number in (b'7', b'271', b'73') else 0
    return arguments[place] == b'0x0'


def _read(descriptor: int, *, close: bool = False) -> bytes:
    try:
        return os.pread(descriptor, 512, 0)
    finally:
        if close:
            os.close(descriptor)


def _text(file: str) -> str:
    try:
        return Path(file).read_text(errors='replace').strip()
    except OSError:
        return '?'


def descendants(pid: int) -> Iterator[int]:
    """Yield a process and all that it has started and that lives."""
    yield pid
    try:
        tids = os.listdir(f'/proc/{pid}/task')
    except FileNotFoundError:
        return
    for tid in tids:
        for child in _text(f'/proc/{pid}/task/{tid}/children').split():
            if child.isdecimal():
                yield from descendants(int(child))
