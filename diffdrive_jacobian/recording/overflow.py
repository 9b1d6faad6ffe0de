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

"""When messages may have been dropped: a buffer overflowed, or this process was held.

Through UDP, as the programs of this package receive, the kernel counts for each socket the datagrams
that it dropped because the buffer was full (SO_MEMINFO, Linux). Fast DDS sends them again, unless the
publisher ends first. Through shared memory, which a user's profile of Fast DDS may choose, nothing
counts them: there the volume of what came at once has to do.
"""

from __future__ import annotations

import os
import socket
import stat
import struct
import sys
import time
from array import array
from bisect import bisect_left
from contextlib import suppress

from diffdrive_jacobian.time_units import NANOSECONDS

_SO_MEMINFO = 55
_MEMINFO = struct.Struct('9I')
"""Nine counters, the last of which is that of drops (linux/sock_diag.h)."""
_SPACING = NANOSECONDS // 1000
"""Within this time two entries are kept (ns)."""
HELD = 7 * NANOSECONDS // 20
"""Time between two looks after which the process was held: there are five in a second (ns)."""
BURST_VOLUME = 80_000
"""Volume with which a buffer may have overflowed that nobody counts (bytes; a socket has 212,992)."""
BURST_TIME = NANOSECONDS // 20
"""Time within which such a volume is a burst (ns)."""
OVERHEAD = 768
"""What a message takes up in a buffer besides its data (bytes)."""


class _Times:
    """Times in ascending order (ns); of many within `_SPACING` the first and the last one."""

    def __init__(self) -> None:
        self.times = array('q')

    def add(self, stamp: int) -> None:
        times = self.times
        if times and stamp <= times[-1]:
            # Of another queue, or the clock was set back.
            return
        if len(times) > 1 and stamp - times[-2] < _SPACING:
            times[-1] = stamp
        else:
            times.append(stamp)

    def within(self, begin: int, end: int) -> bool:
        first = bisect_left(self.times, begin)
        return first < len(self.times) and self.times[first] <= end


class Overflow:
    """When messages may have been dropped, by the clock of this machine (ns since the epoch)."""

    def __init__(self, *, counted: bool) -> None:
        """Find the sockets of this process.

        Args:
            counted: Whether all that is received comes through UDP, so that the kernel counts.
        """
        self._sockets = _udp_sockets() if counted else []
        self._dropped = self._count()
        self._looked = time.time_ns()
        self._window = self._volume = 0
        self._drops, self._holds = _Times(), _Times()

    @property
    def last(self) -> int:
        """When datagrams were dropped last; 0: never."""
        return self._drops.times[-1] if self._drops.times else 0

    def dropped(self, begin: int, end: int) -> bool:
        """Return whether datagrams may have been dropped between two times (ns)."""
        return self._drops.within(begin, end)

    def held(self, begin: int, end: int) -> bool:
        """Return whether this process was held between two times (ns).

        What waits in a buffer when a publisher ends is dropped by Fast DDS if it hears of the end first.
        """
        return self._holds.within(begin, end)

    def close(self) -> None:
        """Let go of the sockets."""
        while self._sockets:
            self._sockets.pop().close()
        self._dropped = 0

    def look(self) -> None:
        """Note whether datagrams were dropped since the last call, or the process was held meanwhile."""
        dropped, before, now = self._count(), self._looked, time.time_ns()
        if dropped != self._dropped:
            self._drops.add(now)
        if now - before > HELD:
            self._holds.add(before)
            self._holds.add(now)
        self._dropped, self._looked = dropped, now

    def received(self, size: int, stamp: int) -> None:
        """Take account of a message of a size (bytes) that was received at a time (ns)."""
        if self._sockets:
            self.look()
            return
        if not 0 <= stamp - self._window <= BURST_TIME:
            self._window, self._volume = stamp, 0
        self._volume += size + OVERHEAD
        if self._volume > BURST_VOLUME:
            self._drops.add(stamp)

    def _count(self) -> int:
        counters = (
            one.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size) for one in self._sockets
        )
        return sum(_MEMINFO.unpack(one)[-1] for one in counters)


def _udp_sockets() -> list[socket.socket]:
    """Return the UDP sockets of this process; []: they are not known."""
    found: list[socket.socket] = []
    if not sys.platform.startswith('linux'):
        return found
    for name in os.listdir('/proc/self/fd'):
        # One may be closed meanwhile, as that of the directory is.
        with suppress(OSError):
            if not stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                continue
            one = socket.socket(fileno=os.dup(int(name)))
            if one.type == socket.SOCK_DGRAM and one.family == socket.AF_INET:
                one.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
                found.append(one)
            else:
                one.close()
    return found
