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

"""Wall time of other processes, as the world gives it: their clocks, sleeps, and waits with a timeout.

A library in C, `simulated_wall_time.c`, is put before those of an unchanged program. It takes the time
from memory that it shares with the world, and enters there what waits until when. So the world knows
when the process would go on by itself, advances to that time, and lets one after the other go on.
"""

from __future__ import annotations

import ctypes
import hashlib
import mmap
import os
import platform
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from diffdrive_jacobian.lockstep._errors import LockstepError

WALL_TIMES = ('real', 'simulated')
SOURCE = Path(__file__).with_name('simulated_wall_time.c')
VARIABLE = 'LOCKSTEP_WALL_TIME'
COMPILERS = ('cc', 'gcc', 'clang')
FLAGS = ('-shared', '-fPIC', '-O2', '-pthread')
FUTEX = {'x86_64': 202, 'aarch64': 98}
WAKE, ALL = 1, 2**31 - 1
PID_MAX = Path('/proc/sys/kernel/pid_max')
FREE, WAITS, DUE = 0, 2, 3
"""States of a slot: nobody has it, somebody waits, and goes on."""
MANY = 100
"""Number of slots in use from which those of threads that have ended are looked for."""
SLOTS, PROCESSES, NAME = 250, 32, 64


class _Page(ctypes.Structure):
    """What is shared, as `struct page` of the library."""

    _fields_ = (
        ('steady', ctypes.c_int64),
        ('system', ctypes.c_int64),
        ('ended', ctypes.c_int64),
        ('turn', ctypes.c_int32),
        ('full', ctypes.c_int32),
        ('waiters', ctypes.c_int32),
        ('spinning', ctypes.c_int32),
        ('processes', ctypes.c_int32 * PROCESSES),
        ('refused', ctypes.c_char * NAME),
        ('slots', ctypes.c_int64 * 2 * SLOTS),
    )


class WallTime:
    """The wall time of a process and of all that it starts."""

    def __init__(self, now: int) -> None:
        """Stop it at a time (ns).

        Raises:
            LockstepError: The library is not there, and there is no compiler to build it.
        """
        self._library = built()
        self._file = os.memfd_create('lockstep_wall_time')
        os.ftruncate(self._file, ctypes.sizeof(_Page))
        self._memory = mmap.mmap(self._file, ctypes.sizeof(_Page))
        self._page = _Page.from_buffer(self._memory)
        self._slots = np.frombuffer(
            self._page.slots, [('until', np.int64), ('state', np.int32), ('thread', np.int32)]
        )
        self._libc, self._futex = ctypes.CDLL(None), FUTEX[platform.machine()]
        self.root = 0
        """Process that has started all others."""
        self._ids = int(PID_MAX.read_text())
        self.give(now, now)

    def environment(self) -> dict[str, str]:
        """Return the variables with which a program follows it."""
        preloaded = ':'.join(filter(None, (str(self._library), os.environ.get('LD_PRELOAD', ''))))
        return {'LD_PRELOAD': preloaded, VARIABLE: f'/proc/{os.getpid()}/fd/{self._file}'}

    @property
    def steady(self) -> int:
        """The time of clocks that are not set (ns)."""
        return int(self._page.steady)

    def give(self, steady: int, system: int) -> None:
        """Set both times (ns). Nobody goes on by that."""
        self._page.steady, self._page.system = steady, system

    @property
    def spins(self) -> bool:
        """Whether the main thread of a process waits in an executor."""
        return bool(self._page.spinning > 0)

    def next(self, *, executors: bool = True) -> tuple[int, int] | None:
        """Return until when is waited for (ns), and the slot: the earliest, of the oldest thread.

        Args:
            executors: Whether those count that wait for the timers of an executor.
        """
        until, state, thread = (self._slots[name] for name in ('until', 'state', 'thread'))
        (waiting,) = np.nonzero((state == WAITS) & (executors | (thread > 0)))
        if len(waiting) > MANY:
            self._free_abandoned()
        if not len(waiting):
            return None
        # After the largest id of a thread the system begins anew with the smallest.
        first = min(waiting, key=lambda slot: (until[slot], (abs(thread[slot]) - self.root) % self._ids))
        return int(until[first]), int(first)

    def _free_abandoned(self) -> None:
        """Free the slots of threads that have ended while they waited: they were killed."""
        for slot in np.flatnonzero(self._slots['state'] >= WAITS):
            if not os.path.exists(f'/proc/{abs(self._slots["thread"][slot])}'):
                self._slots['state'][slot] = FREE

    def sleeping(self) -> set[int]:
        """Return the threads that wait for a time, without executors."""
        return {int(one) for one in self._slots['thread'][self._slots['state'] == WAITS] if one > 0}

    def end_sleep(self) -> bool:
        """Advance to where the first that sleeps goes on, while the process starts. False: none does."""
        if (first := self.next(executors=False)) is None:
            return False
        self.give(max(self.steady, first[0]), int(self._page.system))
        self.let_go_on(first[1])
        return True

    def let_go_on(self, slot: int) -> None:
        """End the wait of a slot."""
        self._slots['state'][slot] = DUE
        self._wake()

    def end(self) -> None:
        """Let real time go on from here, so that the program can end."""
        if not self._page.ended:
            self._page.ended = time.monotonic_ns()
            self._wake()

    def check(self, title: str) -> None:
        """Raise LockstepError if a process uses what does not follow it. The error names it so."""
        refused = self._page.refused.decode(errors='replace')
        if refused or self._page.full:
            what = f'calls {refused}' if refused else f'waits in more than {SLOTS} threads'
            raise LockstepError(f"{title} {what}, which wall_time='simulated' does not cover")

    def check_loaded(self, pids: set[int]) -> None:
        """Raise LockstepError if processes have not loaded the library."""
        if missing := pids - set(self._page.processes):
            raise LockstepError(
                f'process {min(missing)} does not load the library for simulated wall time: it is '
                "linked statically, has other rights, or removes LD_PRELOAD; it needs wall_time='real'"
            )

    def _wake(self) -> None:
        self._page.turn += 1
        turn = ctypes.addressof(self._page) + _Page.turn.offset
        self._libc.syscall(self._futex, ctypes.c_void_p(turn), WAKE, ALL, None, None, 0)

    def close(self) -> None:
        """Forget it. The processes have ended."""
        os.close(self._file)
        # What looks into the memory would keep it open.
        del self._slots, self._page
        self._memory.close()


def built() -> Path:
    """Return the library, which is built once for each user and machine.

    Raises:
        LockstepError: There is no compiler, or it fails.
    """
    source = SOURCE.read_bytes()
    known = hashlib.sha256(source + ' '.join((platform.machine(), *platform.libc_ver())).encode())
    root = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
    library = root / 'diffdrive_jacobian' / f'simulated_wall_time-{known.hexdigest()[:16]}.so'
    if set(str(library)) & set(' :'):
        raise LockstepError(
            f'the library for simulated wall time cannot be kept in {library.parent}: LD_PRELOAD allows '
            'neither spaces nor colons; XDG_CACHE_HOME may be another folder'
        )
    if library.exists():
        return library
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        raise LockstepError(
            "wall_time='simulated' needs a C compiler once, cc, gcc or clang, and there is none: with "
            'one (apt install gcc libc6-dev) wall timers and sleeps follow simulated time; without, '
            "wall_time='real' takes nodes whose timers are on the clock of the node"
        )
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as folder:
            made = Path(folder, library.name)
            command = [compiler, *FLAGS, '-o', str(made), str(SOURCE), '-ldl']
            subprocess.check_output(command, stderr=subprocess.STDOUT, errors='replace')
            made.replace(library)
    except subprocess.CalledProcessError as error:
        raise LockstepError(f'{" ".join(command)} fails:\n{error.output}') from error
    except OSError as error:
        raise LockstepError(
            f'the library for simulated wall time cannot be built in {library.parent} '
            f'(XDG_CACHE_HOME): {error}'
        ) from error
    return library
