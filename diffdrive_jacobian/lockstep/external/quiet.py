"""When other processes have processed what they received: all their threads wait, without a break.

`Quiet` looks at a process with all that it has started, and at the threads of this process that receive
from them. It reads for how long each has run, then in which system call each thread waits, then whether
it sleeps, and then again for how long they have run. If all threads sleep and nothing has run
meanwhile, then all of them slept when the first reading was complete, and no message was on its way
from one to another. The system call does not tell: that of a thread that was woken up, and does not run
yet because its processor has to be told, is the one in which it waited.

A thread that sleeps for a time goes on by itself, so it counts as busy. So does one that waits with a
timeout, which is in a callback, unless it is DDS that waits, as in an idle executor, or it is a thread
that does so in an idle process. Who waits is seen on the stack: the return addresses of waits with a
timeout are at the same places as in the threads of Fast DDS.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from array import array
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from pathlib import Path

from diffdrive_jacobian.lockstep._errors import LockstepError

CLOSED = -1
"""Stands for a file that was closed."""
NEVER = -1
"""Place of a timeout that there is not."""
SLEEPS = {'x86_64': (b'35', b'230'), 'aarch64': (b'101', b'115')}
"""Numbers of the system calls nanosleep and clock_nanosleep, by machine."""
SELECTS = {'x86_64': (b'23', b'270'), 'aarch64': (b'72',)}
"""Numbers of select: with a timeout and no file it sleeps, as `time.sleep` of Python 3.10 does."""
WAITS = {
    'x86_64': {
        **{b'202': 3, b'7': 2, b'271': 2, b'23': 4, b'270': 4, b'232': 3, b'281': 3},
        **{b'45': NEVER, b'47': NEVER, b'61': NEVER, b'247': NEVER},
    },
    'aarch64': {
        **{b'98': 3, b'73': 2, b'72': 4, b'22': 3},
        **{b'207': NEVER, b'212': NEVER, b'260': NEVER, b'95': NEVER},
    },
}
"""Numbers of the system calls that wait, with the place of their timeout among the arguments: futex,
poll, select, epoll; and of recvfrom, recvmsg, wait4, waitid, which have none."""
FUTEX = (b'202', b'98')
"""Number of the system call in which threads wait for one another, on both machines."""
ENDLESS = (b'0x0', b'0xffffffff', b'0xffffffffffffffff')
"""Timeouts that are none."""
RCLCPP = 'librclcpp.so'
"""Library of nodes in C++."""
DDS = 'libfastrtps.so'
"""Library whose waits are those of an idle node."""
DEEPER = 1024
"""Size of the part of a stack that a callback uses at least until it waits (bytes)."""
STACK = 512
"""Size of the part of a stack that is looked at (bytes)."""
TRIES = 30
"""Number of attempts that follow each other at once. Later ones leave the processor to others."""
MANY_TRIES = 200
"""Number of attempts after which the time is taken."""
PAUSE = 0.0002
"""Time between later attempts (s)."""
LONGEST = 10
"""Largest ratio of the wall time that a process gets to the time that it is given."""
ASLEEP = (b'S', b'I', b'Z', b'X')
"""States of threads that wait or have ended."""
STOPPED = (b'T', b't')
IN_CALLBACK = 'waits in a callback, with a timeout'
STATES = {b'R': 'is running', b'D': 'waits for a disk', b'T': 'is stopped', b't': 'is being debugged'}


class _Thread:
    """A thread of another process, or one of this process that receives."""

    def __init__(self, pid: int, tid: int, *, own: bool = False) -> None:
        """Open its files.

        Raises:
            LockstepError: It may not be observed.
            ProcessLookupError: It has ended.
        """
        self.pid, self.tid, self.own = pid, tid, own
        self.idle = b''
        """System call in which it has been found not to be busy."""
        self._files: list[int] = []
        try:
            for name in ('syscall', 'children', 'stat'):
                self._files.append(os.open(f'/proc/{pid}/task/{tid}/{name}', os.O_RDONLY))
            self.call, self.children, self._stat = self._files
            os.pread(self.call, 256, 0)
        except PermissionError as error:
            self.close()
            raise LockstepError(
                f'/proc/{pid}/syscall cannot be read, which shows whether a thread sleeps: a container '
                'needs --cap-add=SYS_PTRACE, and /proc/sys/kernel/yama/ptrace_scope must be 0 or 1'
            ) from error
        except OSError:
            self.close()
            raise ProcessLookupError from None

    def close(self) -> None:
        """Close the files."""
        while self._files:
            os.close(self._files.pop())

    def state(self) -> bytes:
        """Return the letter of its state."""
        return os.pread(self._stat, 512, 0).rpartition(b') ')[2][:1]

    def read(self, name: str) -> str:
        """Return the content of a file below /proc; empty: it has ended."""
        try:
            return Path(f'/proc/{self.pid}/task/{self.tid}/{name}').read_text(errors='replace')
        except OSError:
            return ''


def check_platform() -> None:
    """Raise LockstepError if the threads of other processes cannot be observed on this machine."""
    machine = platform.machine()
    if sys.platform != 'linux' or machine not in WAITS:
        raise LockstepError(
            'nodes in other processes need Linux on x86_64 or aarch64, which shows in /proc whether a '
            f'process has processed its input; this is {sys.platform} on {machine}'
        )


def threads_of_this_process() -> set[int]:
    """Return the ids of the threads of this process."""
    return set(map(int, os.listdir('/proc/self/task')))


def own_run_times(tids: Iterable[int]) -> list[int]:
    """Return for how long threads of this process have run (ns)."""
    return [time.clock_gettime_ns(~tid << 3 | 6) for tid in tids]


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
        machine = platform.machine()
        self._sleeps, self._selects, self._waits = SLEEPS[machine], SELECTS[machine], WAITS[machine]
        self._links = {pid: 0}
        """Number of links of the folder of the threads, by process: it changes with their number."""
        self._loadavg = os.open('/proc/loadavg', os.O_RDONLY)
        self._newest = b''
        """Id of the newest thread on this machine when it was last looked which threads there are."""
        self._own = [_Thread(os.getpid(), tid, own=True) for tid in own]
        self._threads: dict[tuple[int, int], _Thread] = {}
        self._busy: _Thread | None = None
        self._why = ''
        self._places: set[int] | None = None
        """Places on the stack of return addresses of waits with a timeout. None: not known yet."""
        self._dds: dict[int, list[range]] = {}
        self._polling: set[int] = set()
        """Threads that wait with a timeout in an idle process, but not in DDS."""
        self.polls_files = False
        """Whether one of them waits for files, as an event loop does, and no executor."""
        self._ended: set[int] = set()
        self.waits_in_callback = False
        """Whether all was quiet at the last look but for callbacks that wait with a timeout."""
        self.loops = True
        """Whether all executors that wait with a timeout have done so several times."""
        self._loops: dict[tuple[int, int], int] = {}
        """How often such a thread had run when it was first seen at this place."""
        self._depths: dict[int, int] = {}
        """Address of the top of the stack of each thread in an idle process."""
        self._spinning: set[_Thread] = set()
        """Main threads that wait in DDS in an idle process."""
        self.timed_executors = 0
        """How many threads do so with a timeout, as if they have a timer on wall time."""
        self.new_thread_waits = False
        """Whether a thread that an idle process did not have has waited with a timeout."""

    def has_ended(self, pid: int) -> bool:
        """Return whether a process of those that are observed had ended when it was looked at last."""
        return pid not in self._links or pid in self._ended

    def listeners(self) -> list[int]:
        """Return the threads of this process that receive what nodes tell of themselves, alone.

        That is, those of rmw: the threads of Fast DDS itself have other names.
        """
        return [thread.tid for thread in self._own if not thread.read('comm').startswith('dds.')]

    def close(self) -> None:
        """End the observation."""
        for thread in (*self._threads.values(), *self._own):
            thread.close()
        if self._loadavg != CLOSED:
            os.close(self._loadavg)
        self._threads, self._own, self._loadavg = {}, [], CLOSED

    # --- Waiting

    def wait(self, patience: float, asks: Callable[[], bool] = lambda: False) -> None:
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
                    for thread in self._threads.values():
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
            before = self._times()
            # Ended threads are noticed below.
            newest = os.pread(self._loadavg, 128, 0).rpartition(b' ')[2]
            if newest != self._newest:
                if self._update():
                    return False
                self._newest = newest
            for thread in (*self._threads.values(), *self._own):
                if self._is_busy(thread):
                    self._busy = thread
                    if self._why != IN_CALLBACK:
                        return False
                    waiting = thread
            # Until a thread that was woken up gets a processor it is in its system call still.
            if any(map(self._is_awake, (*self._threads.values(), *self._own))):
                return False
            if self._times() != before:
                return False
            self.waits_in_callback = waiting is not None
            return waiting is None
        except ProcessLookupError:
            # A thread has ended. The next look is at what is left.
            self._busy, self._newest = None, b''
            self._links = dict.fromkeys(self._links, 0)
            with suppress(ProcessLookupError):
                self._update()
            return False

    def _times(self) -> list[int]:
        """Return for how long the processes, and the threads of this one, have run (ns).

        Of what runs now the last part may be missing, but not when it has stopped to run.
        """
        try:
            return [
                *(time.clock_gettime_ns(~pid << 3 | 2) for pid in self._links),
                *own_run_times(thread.tid for thread in self._own),
            ]
        except OSError:
            raise ProcessLookupError from None

    def _is_awake(self, thread: _Thread) -> bool:
        """Return whether a thread does not sleep, by its state, whatever its system call is.

        Raises:
            ProcessLookupError: It has ended.
        """
        state = thread.state()
        if state in ASLEEP:
            return False
        self._busy, self._why = thread, STATES.get(state, f'has the state {state.decode()}')
        return True

    def _is_busy(self, thread: _Thread) -> bool:
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
            if self._is_in_callback(thread, arguments):
                self._why = IN_CALLBACK
                return True
        thread.idle = call
        return False

    def _is_active(self, thread: _Thread) -> bool:
        """Return whether a thread does something in a system call, such as to wait for a disk."""
        state = thread.state()
        if state in (b'Z', b'X'):
            # Its parent has still to be woken up when its state changes.
            new = thread.tid not in self._ended
            self._ended.add(thread.tid)
            return new
        self._why = STATES.get(state, f'has the state {state.decode()}')
        return state != b'S'

    # --- Who waits with a timeout

    def learn(self) -> None:
        """Note which threads wait with a timeout, and how: the process is idle, and was found quiet."""
        timed, calls = [], {}
        self.loops = True
        self._spinning = set()
        for thread in self._threads.values():
            number, *arguments = thread.idle.split() or [b'']
            if arguments:
                self._depths[thread.tid] = int(arguments[-2], 16)
                main = thread.tid == thread.pid
                if main and number in FUTEX and self._addresses(thread, arguments):
                    self._spinning.add(thread)
            place = self._waits.get(number, NEVER)
            if place != NEVER and arguments[place] not in ENDLESS:
                timed.append((thread, self._addresses(thread, arguments)))
                calls[thread] = number
            thread.idle = b''
        named = [found for thread, found in timed if thread.read('comm').startswith('dds.')]
        self._places = {min(found) for found in named if found}
        loops = {}
        for thread, found in timed:
            if not (self._places.isdisjoint(found) or thread.read('comm').startswith('dds.')):
                key = thread.tid, self._depths[thread.tid]
                times = int(thread.read('schedstat').split()[2])
                loops[key] = min(times, self._loops.get(key, times))
                self.loops = self.loops and times > loops[key]
        self._loops = loops
        self.timed_executors = len(loops)
        polling = {thread for thread, found in timed if self._places.isdisjoint(found)}
        self._polling = {thread.tid for thread in polling}
        self.polls_files = any(number not in FUTEX for number in map(calls.get, polling))

    def _is_in_callback(self, thread: _Thread, arguments: list[bytes]) -> bool:
        """Return whether a thread that waits with a timeout does so neither in DDS nor always."""
        if self._places is None or thread.own:
            return False
        if thread.tid not in self._depths:
            # A new thread, as an executor starts them for callbacks, and DDS for a new participant.
            new = not thread.read('comm').startswith('dds.')
            self.new_thread_waits |= new
            return new
        if int(arguments[-2], 16) < self._depths[thread.tid] - DEEPER:
            return True
        if thread.tid in self._polling:
            return False
        return self._places.isdisjoint(self._addresses(thread, arguments))

    def _addresses(self, thread: _Thread, arguments: list[bytes]) -> set[int]:
        """Return at which places on its stack a thread has addresses of code of DDS."""
        pid = thread.pid
        if pid not in self._dds:
            self._dds[pid] = _code(thread, DDS)
        words = _stack(thread, arguments)
        return {place for place, word in enumerate(words) for code in self._dds[pid] if word in code}

    def cpp_executor_threads(self, pid: int, sleeping: Collection[int] = ()) -> int:
        """Return how many threads of executors an idle process in C++ has. 0: it is not in C++.

        Threads that are known to be sleeping are none.
        """
        threads = [thread for thread in self._threads.values() if thread.pid == pid]
        code = _code(threads[0], RCLCPP) if threads else []
        if not code:
            return 0
        found = 0
        for thread in threads:
            call = thread.read('syscall').encode().split()
            if len(call) > 2 and thread.tid not in sleeping and not self._addresses(thread, call[1:]):
                found += any(word in part for word in _stack(thread, call) for part in code)
        # One of them waits for DDS, and one of rclcpp's threads, which is none of them, for signals.
        return max(found, 1)

    def spins(self) -> bool:
        """Return whether the main thread of a process waits in DDS, as an executor does."""
        for thread in self._threads.values():
            call = thread.read('syscall').encode().split() if thread.tid == thread.pid else []
            if len(call) > 2 and self._addresses(thread, call[1:]):
                return True
        return False

    def stuck(self) -> bool:
        """Return whether the main thread of a quiet process has not returned from a callback."""
        return bool(self._spinning) and all(map(self._is_elsewhere, self._spinning))

    def _is_elsewhere(self, thread: _Thread) -> bool:
        """Return whether a thread waits, but not in DDS as in an idle process."""
        call = thread.idle.split()
        if len(call) < 3 or int(call[-2], 16) == self._depths[thread.tid]:
            return False
        return not self._addresses(thread, call[1:])

    # --- Which threads there are

    def processes(self) -> list[int]:
        """Return the ids of the process and of all that it has started and that lives."""
        with suppress(ProcessLookupError):
            while self._update():
                pass
        return list(self._links)

    def _update(self) -> bool:
        """Open the files of new threads, close those of ended ones. Return whether there were any."""
        changed = False
        for pid, known in list(self._links.items()):
            try:
                links = os.stat(f'/proc/{pid}/task').st_nlink
                if links == known:
                    continue
                present = {(pid, int(tid)) for tid in os.listdir(f'/proc/{pid}/task')}
            except (FileNotFoundError, ProcessLookupError):
                links, present = 0, set()
            changed = True
            for key in [key for key in self._threads if key[0] == pid and key not in present]:
                self._threads.pop(key).close()
                self._ended.discard(key[1])
            for key in sorted(present - self._threads.keys()):
                self._threads[key] = _Thread(*key)
            self._links[pid] = links
            if not present:
                del self._links[pid]
                self._dds.pop(pid, None)
        for thread in self._threads.values():
            for child in os.pread(thread.children, 4096, 0).split():
                if int(child) not in self._links:
                    self._links[int(child)] = 0
                    changed = True
        return changed

    # --- Failures

    def delay(self) -> float:
        """Return for how long all threads together have waited for a processor (s)."""
        self.processes()
        counters = [thread.read('schedstat').split() for thread in (*self._threads.values(), *self._own)]
        return sum(int(counter[1]) for counter in counters if counter) / 1e9

    def describe(self) -> str:
        """Return which thread was busy last, and how."""
        if self._busy is None:
            return 'processes come and go'
        thread = self._busy
        command = thread.read('cmdline').replace('\0', ' ').strip()
        name = thread.read('comm').strip()
        return f"thread {thread.tid} ('{name}') of {command} (pid {thread.pid}) {self._why}"


def _code(thread: _Thread, library: str) -> list[range]:
    """Return the addresses of the code of a library in the process of a thread."""
    return [
        range(*(int(end, 16) for end in line.split()[0].split('-')))
        for line in thread.read('maps').splitlines()
        if library in line and 'x' in line.split()[1]
    ]


def _stack(thread: _Thread, call: list[bytes]) -> array[int]:
    """Return the top of the stack of a thread that waits in a system call."""
    words = array('Q')
    with suppress(OSError), open(f'/proc/{thread.pid}/mem', 'rb', buffering=0) as memory:
        words.frombytes(os.pread(memory.fileno(), STACK, int(call[-2], 16)))
    return words


class Allowance:
    """A limit for the time that processes need, without that for which they waited for a processor.

    So it does not depend on what else the machine does, within reason.
    """

    def __init__(self, quiet: Quiet, seconds: float) -> None:
        """Begin now, with a number of seconds."""
        self._quiet, self._seconds = quiet, seconds
        self._begin, self._delay = time.monotonic(), quiet.delay()

    def is_used_up(self) -> bool:
        """Return whether it has passed."""
        passed = time.monotonic() - self._begin
        if passed <= self._seconds:
            return False
        delay = self._quiet.delay() - self._delay
        return passed - delay > self._seconds or passed > LONGEST * self._seconds
