"""Whether datagrams were lost between the world and a process.

Both receive through UDP. On one machine a datagram is lost only if the queue of the socket that receives
it is full. The system counts that for each socket.
"""

from __future__ import annotations

import ctypes
import os
import socket
import time
from collections.abc import Iterable
from contextlib import suppress

SYS_PIDFD_GETFD = 438
"""Number of the system call, the same on all machines."""
SO_RCVBUFFORCE = 33
QUEUE = 1 << 26
"""Size of the queue that is asked for (bytes). The system allows less, see LIMIT."""
LIMIT = '/proc/sys/net/core/rmem_max'
PERIOD = 0.05
"""Least time between two looks at the counters, which take 0.3 to 0.8 ms (s)."""


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
                _enlarge(pid, sockets[number])
        self._lost |= {number: lost for number, lost in _counters().items() if number in new}

    def lost(self, *, now: bool = False) -> int:
        """Return how many were lost since the last call.

        Args:
            now: Whether to look, even if that was done just before.
        """
        if not now and time.monotonic() - self._looked < PERIOD:
            return 0
        counters = _counters()
        before, self._lost = self._lost, {one: counters.get(one, n) for one, n in self._lost.items()}
        self._looked = time.monotonic()
        return sum(self._lost.values()) - sum(before.values())


def _counters() -> dict[str, int]:
    """Return how many datagrams each UDP socket of this machine has lost."""
    with open('/proc/net/udp', encoding='ascii') as table:
        rows = [row.split() for row in table.readlines()[1:]]
    return {row[9]: int(row[12]) for row in rows}


def _enlarge(pid: int, descriptor: int) -> None:
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
