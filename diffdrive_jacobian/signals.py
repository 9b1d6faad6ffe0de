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

"""Signals that are only counted: the code that runs the loop decides what they mean.

This module imports nothing slow, so that an entry point can catch signals before it loads rclpy.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from socket import socket

CAUGHT = tuple(
    getattr(signal, name) for name in ('SIGINT', 'SIGTERM', 'SIGHUP') if hasattr(signal, name)
)
"""Windows has no SIGHUP."""
TOGETHER = 0.1
"""Signals this soon after the first are the same request, as from a terminal and a parent (s)."""
GRACE = 2.0
"""How long a process may go on after a second request without reading `count` (s)."""
MAX_GRACE = 10.0
"""How long it may go on after a second request in any case (s)."""


class Signals:
    """Counts SIGINT, SIGTERM and SIGHUP, which end the process otherwise."""

    _read = 0.0
    _ignored = False

    def __init__(self, end: Callable[[], object] = lambda: None) -> None:
        """Start with no signal.

        Args:
            end: Ends the process (`os._exit`), for `ending_at_once` (default: nothing does).
        """
        self._count = 0
        self._end = end
        self._at_once = False

    @property
    def count(self) -> int:
        """Number of signals caught so far."""
        self._read = time.monotonic()
        return self._count

    @count.setter
    def count(self, value: int) -> None:
        self._count = value

    def catch(self) -> None:
        """Count signals from now on."""
        for number in CAUGHT:
            signal.signal(number, self._on_signal)

    @contextmanager
    def ending_at_once(self) -> Iterator[None]:
        """End the process on a signal, without clean-up, also if it was caught before.

        For what takes long and leaves nothing, such as imports.
        """
        self._at_once = True
        try:
            if self._count:
                self._end_once()
            yield
        finally:
            self._at_once = False

    def ignore(self) -> None:
        """Ignore signals from now on, so that none disturbs the interpreter while it exits."""
        self._ignored = True
        for number in CAUGHT:
            signal.signal(number, signal.SIG_IGN)

    def exit_on_second(self, end: Callable[[], object]) -> None:
        """End the process on a second request to end, whatever its main thread does then.

        A process that still reads `count` reacts to signals by itself, and has `MAX_GRACE` to end. A
        process that does not, since it is in a long calculation or waits for something, has `GRACE`. A
        thread watches over this, for Python runs signal handlers only between instructions of the main
        thread. Code that holds Python's interpreter lock delays it.

        Args:
            end: Ends the process (`os._exit`); called from the thread.
        """
        # Slow to import. No pipe, because Windows needs a socket.
        import socket

        reader, writer = socket.socketpair()
        writer.setblocking(False)
        # Not closed.
        signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
        # What was caught before is not in the pipe.
        watch = threading.Thread(
            target=self._watch, args=(reader, self._count > 0, end), name='signals', daemon=True
        )
        watch.start()

    def _watch(self, reader: socket, requested: bool, end: Callable[[], object]) -> None:
        with reader:
            first = time.monotonic() if requested else None
            while True:
                if reader.recv(1)[0] not in CAUGHT:
                    continue
                now = time.monotonic()
                if first is None:
                    first = now
                elif now - first >= TOGETHER:
                    break
            while not self._ignored:
                left = min(max(now, self._read) + GRACE, now + MAX_GRACE) - time.monotonic()
                if left <= 0.0:
                    end()
                    return
                time.sleep(min(left, 0.1))

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._count += 1
        self._end_once()

    def _end_once(self) -> None:
        # Another signal may come before the process has ended.
        if self._at_once:
            self._at_once = False
            self._end()


@contextmanager
def one_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt only once for the SIGINTs of one request (`TOGETHER`).

    What is done after the first one would be cut short by the second. Another handler than Python's own
    remains, and so does that of a thread.
    """
    before = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if not main or before is not signal.default_int_handler:
        yield
        return
    last = -math.inf

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= TOGETHER:
            last = now
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def counting_interrupts() -> Iterator[Signals]:
    """Count SIGINTs, and raise KeyboardInterrupt at the end if there was one.

    A second request does so at once. An exception in the middle of a callback would be lost, or leave
    the robot driving. Another handler than Python's own remains, and so does that of a thread.
    """
    signals = Signals()
    before = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if not main or before is not signal.default_int_handler:
        yield signals
        return
    first = math.inf

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal first
        now = time.monotonic()
        if now - first >= TOGETHER:
            raise KeyboardInterrupt
        first = min(first, now)
        signals.count += 1

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield signals
    finally:
        signal.signal(signal.SIGINT, before)
    if signals.count:
        raise KeyboardInterrupt
