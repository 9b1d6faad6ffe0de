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

"""What nodes in other processes rely on in Linux: its system calls, /proc, and the sockets of processes.

No other module of this package reads /proc, but for `launch`, which is a program of its own, and
`wall_time`, whose memory has a name there.
"""

from __future__ import annotations

import ctypes
import os
import platform
import socket
import sys
import time
from array import array
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from diffdrive_jacobian.lockstep._errors import LockstepError

LOADAVG = '/proc/loadavg'
"""File whose last word is the id of the newest thread on this machine."""
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
STACK = 512
"""Size of the part of a stack that is looked at (bytes)."""
ASLEEP = (b'S', b'I', b'Z', b'X')
"""States of threads that wait or have ended."""
STOPPED = (b'T', b't')
STATES = {b'R': 'is running', b'D': 'waits for a disk', b'T': 'is stopped', b't': 'is being debugged'}
SYS_PIDFD_GETFD = 438
"""Number of the system call, the same on all machines."""
SO_RCVBUFFORCE = 33
QUEUE = 1 << 26
"""Size of the queue that is asked for (bytes). The system allows less, see LIMIT."""
LIMIT = '/proc/sys/net/core/rmem_max'
ADDR_NO_RANDOMIZE = 0x0040000
RANDOMIZE = Path('/proc/sys/kernel/randomize_va_space')
DISCOVERY_PORTS, PORTS_OF_CLIENTS = 7400, 32768
"""First port of discovery, and first one that the system gives to clients. A domain has `PORTS`."""
PORTS = 250


def check_platform() -> None:
    """Raise LockstepError if the threads of other processes cannot be observed on this machine."""
    machine = platform.machine()
    if sys.platform != 'linux' or machine not in WAITS:
        raise LockstepError(
            'nodes in other processes need Linux on x86_64 or aarch64, which shows in /proc whether a '
            f'process has processed its input; this is {sys.platform} on {machine}'
        )


def own_run_times(tids: Iterable[int]) -> list[int]:
    """Return for how long threads of this process have run (ns)."""
    return [time.clock_gettime_ns(~tid << 3 | 6) for tid in tids]


# --- Threads


class Thread:
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


def code_of(thread: Thread, library: str) -> list[range]:
    """Return the addresses of the code of a library in the process of a thread."""
    return [
        range(*(int(end, 16) for end in line.split()[0].split('-')))
        for line in thread.read('maps').splitlines()
        if library in line and 'x' in line.split()[1]
    ]


def stack_pointer(call: list[bytes]) -> int:
    """Return the address of the top of the stack of a thread in a system call, as /proc shows that.

    The call is its number, its arguments, this address, and that of the instruction.
    """
    return int(call[-2], 16)


def stack_of(thread: Thread, call: list[bytes]) -> array[int]:
    """Return the top of the stack of a thread that waits in a system call."""
    words = array('Q')
    with suppress(OSError), open(f'/proc/{thread.pid}/mem', 'rb', buffering=0) as memory:
        words.frombytes(os.pread(memory.fileno(), STACK, stack_pointer(call)))
    return words


def run_time(pid: int) -> int:
    """Return for how long a process has run (ns).

    Of what runs now the last part may be missing, but not when it has stopped to run.

    Raises:
        OSError: It has ended.
    """
    return time.clock_gettime_ns(~pid << 3 | 2)


def links_of_threads(pid: int) -> int:
    """Return a number that changes with the number of threads of a process.

    Raises:
        FileNotFoundError, ProcessLookupError: It has ended.
    """
    return os.stat(f'/proc/{pid}/task').st_nlink


def threads_of(pid: int) -> set[int]:
    """Return the ids of the threads of a process.

    Raises:
        FileNotFoundError, ProcessLookupError: It has ended.
    """
    return set(map(int, os.listdir(f'/proc/{pid}/task')))


def first_child(pid: int) -> int | None:
    """Return a child that the main thread of a process has started; None: there is none."""
    with suppress(OSError):
        for child in Path(f'/proc/{pid}/task/{pid}/children').read_text().split()[:1]:
            return int(child)
    return None


def has_random_addresses(pid: int) -> bool:
    """Return whether the addresses of a process are random. False: it has ended, or is protected."""
    try:
        personality = int(Path(f'/proc/{pid}/personality').read_text(), 16)
    except OSError:
        return False
    return not personality & ADDR_NO_RANDOMIZE and RANDOMIZE.read_text().strip() != '0'


# --- Sockets


def sockets_of(pid: int) -> dict[str, int]:
    """Return the sockets of a process: their numbers (inodes), with a file descriptor of each."""
    found = {}
    with suppress(OSError):
        for descriptor in os.listdir(f'/proc/{pid}/fd'):
            with suppress(OSError):
                kind, _, rest = os.readlink(f'/proc/{pid}/fd/{descriptor}').partition(':[')
                if kind == 'socket':
                    found[rest.rstrip(']')] = int(descriptor)
    return found


def lost_datagrams() -> dict[str, int]:
    """Return how many datagrams each UDP socket of this machine has lost."""
    return {row[9]: int(row[12]) for row in _udp_sockets()}


def largest_queue() -> str:
    """Return the size to which the system limits the queue of a socket without rights (bytes)."""
    return Path(LIMIT).read_text().strip()


def enlarge_queue(pid: int, descriptor: int) -> None:
    """Enlarge the queue of a socket of a process as far as the system allows it."""
    process = os.pidfd_open(pid)
    try:
        copy = ctypes.CDLL(None).syscall(SYS_PIDFD_GETFD, process, descriptor, 0)
    finally:
        os.close(process)
    if copy < 0:
        return
    with socket.socket(fileno=copy) as receiving:
        if receiving.type != socket.SOCK_DGRAM:
            return
        try:
            receiving.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, QUEUE)
        except PermissionError:
            receiving.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, QUEUE)


def domains_of(pids: Sequence[int]) -> set[int]:
    """Return the ROS domains in which processes receive, by their UDP ports."""
    sockets = {number for pid in pids for number in sockets_of(pid)}
    found = set()
    for row in _udp_sockets():
        port = int(row[1].rpartition(':')[2], 16)
        if row[9] in sockets and DISCOVERY_PORTS <= port < PORTS_OF_CLIENTS:
            found.add((port - DISCOVERY_PORTS) // PORTS)
    return found


def _udp_sockets() -> list[list[str]]:
    """Return the columns of each UDP socket of this machine."""
    with open('/proc/net/udp', encoding='ascii') as table:
        return [row.split() for row in table.readlines()[1:]]
