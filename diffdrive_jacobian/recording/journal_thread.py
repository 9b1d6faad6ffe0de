"""A journal that is written in a thread of its own, so that a slow disk delays no callback."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from diffdrive_jacobian.bags.journal import OVERHEAD, JournalWriter, Message, Record
from diffdrive_jacobian.errors import DiffdriveError

FLUSH_PERIOD = 0.1
"""Period at which records are handed to the operating system (s)."""
SYNC_PERIOD = 0.3
"""Period at which they are synced to the disk (s)."""
CAPACITY = 128 << 20
"""Memory for records that wait to be written (bytes): four seconds of 1 MB at 30 Hz."""
EARLY = 4 << 20
"""Waiting records of this size are written before the period is over (bytes)."""


class JournalGoneError(DiffdriveError, OSError):
    """The journal was removed, renamed or replaced while it was being written."""


class JournalThread:
    """Writes records to a journal in a thread. Until they are written they wait in bounded memory."""

    def __init__(
        self,
        journal: JournalWriter,
        *,
        capacity: int = CAPACITY,
        lossless: bool = False,
        before_sync: Callable[[], None] = lambda: None,
    ) -> None:
        """Start the thread.

        Args:
            journal: Where the records are written.
            capacity: Memory for records that wait to be written (bytes).
            lossless: Whether `add` waits when that is used up. Otherwise it drops messages.
            before_sync: Called in the thread before each sync.
        """
        self._journal = journal
        self._capacity = capacity
        self._lossless = lossless
        self._before_sync = before_sync
        self._changed = threading.Condition()
        self._closing = False
        self.error: OSError | None = None
        """Why nothing more can be written. None: no error."""
        # A daemon: an exception in the main thread must be able to end the process.
        self._thread = threading.Thread(target=self._run, name='journal', daemon=True)
        self._thread.start()

    def add(self, record: Record) -> bool:
        """Queue a record.

        Returns:
            Whether it was queued. False: the queue is full, or writing has failed. Only messages are
            dropped because the queue is full.
        """
        if isinstance(record, Message) and not self._has_room(len(record.data) + OVERHEAD):
            return False
        if self._closing or self.error is not None:
            return False
        before = self._journal.waiting
        self._journal.add(record)
        if before < EARLY <= self._journal.waiting:
            with self._changed:
                self._changed.notify_all()
        return True

    def close(self) -> None:
        """Write all queued records, however long the disk takes, and end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()

    def _has_room(self, size: int) -> bool:
        def room() -> bool:
            waiting = self._journal.waiting
            # A message larger than the capacity is accepted when nothing else waits.
            return waiting == 0 or waiting + size <= self._capacity or self.error is not None

        if self._lossless and not room():
            with self._changed:
                self._changed.wait_for(room)
        return room()

    def _run(self) -> None:
        synced = time.monotonic()
        while self.error is None:
            with self._changed:
                if not self._closing and self._journal.waiting < EARLY:
                    self._changed.wait(FLUSH_PERIOD)
                closing = self._closing
            try:
                if closing or time.monotonic() - synced >= SYNC_PERIOD:
                    self._before_sync()
                    self._journal.flush()
                    self._journal.sync()
                    self._check()
                    synced = time.monotonic()
                else:
                    self._journal.flush()
            except OSError as error:
                self.error = error
            with self._changed:
                self._changed.notify_all()
            if closing:
                return

    def _check(self) -> None:
        if not self._journal.in_place():
            raise JournalGoneError(f'{self._journal.path} was removed, renamed or replaced')
