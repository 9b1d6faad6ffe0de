"""A recording from its first message to the bag."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from datetime import datetime
from itertools import count
from pathlib import Path

from diffdrive_jacobian import __version__
from diffdrive_jacobian.bags.building import Summary, build_bag
from diffdrive_jacobian.bags.journal import JournalWriter, Text, read_journal

FLUSH_PERIOD = 0.1
"""How much a killed recorder may lose (s)."""
SYNC_PERIOD = 0.4
"""How much a power cut may lose, beside that and the time that the disk takes (s)."""
JOURNAL = '.journal'
"""Ends the name of a journal; before it stands the name of the bag."""


def journal_of(bag: Path) -> Path:
    """Give the journal that lies beside a bag while it is recorded, and after a crash."""
    return bag.with_name(bag.name + JOURNAL)


class Recording:
    """A journal that is on the disk within half a second, and becomes a bag at the end."""

    def __init__(self, bag: Path, storage: str) -> None:
        """Begin; the bag's directory appears at the end.

        Args:
            bag: The bag's directory; neither it nor its journal may exist.
            storage: `mcap` or `sqlite3`.

        Raises:
            FileExistsError: One of them exists.
            OSError: It cannot be written there.
        """
        if bag.exists():
            raise FileExistsError(f'{bag} exists already')
        self.bag = bag
        journal = journal_of(bag)
        if journal.exists():
            raise FileExistsError(
                f'{journal} exists already: recover_run {journal} makes the bag of what is in it'
            )
        self.journal = JournalWriter(journal)
        self._storage = storage
        self.begun = time.monotonic()
        self._flushed = self.begun
        self.error: OSError | None = None
        """Why nothing more can be written; None: all is well."""
        self._ended = threading.Event()
        self._syncing = threading.Thread(target=self._sync, name='journal sync', daemon=True)
        self.journal.add(Text('recorder', f'diffdrive_jacobian {__version__}'))
        self.journal.add(Text('storage', storage))
        self.journal.flush()
        self._syncing.start()

    @classmethod
    def named_by_time(cls, prefix: str, storage: str) -> Recording:
        """Begin one in the present directory, named `prefix_DATE-TIME`, or so and a number.

        Raises:
            OSError: It cannot be written there.
        """
        name = f'{prefix}_{datetime.now():%Y_%m_%d-%H_%M_%S}'
        for number in count(2):
            try:
                return cls(Path(name), storage)
            except FileExistsError:
                name = f'{name.split("__")[0]}__{number}'
        raise AssertionError('there is always another number')

    def tend(self) -> None:
        """Flush when it is time; to be called often."""
        now = time.monotonic()
        if now - self._flushed >= FLUSH_PERIOD and self.error is None:
            self._flushed = now
            self._try(self.journal.flush)

    def finish(self) -> Summary:
        """Make the bag, and let the journal go once that is on the disk.

        Raises:
            OSError: The bag cannot be written. The journal stays, for `recover_run`.
        """
        if self.error is None:
            self._try(self.journal.flush)
        self._ended.set()
        self._syncing.join()
        self.journal.close()
        path = self.journal.path
        summary = build_bag(lambda: read_journal(path), self.bag, self._storage)
        if self.error is None:
            path.unlink()
        return summary

    def discard(self) -> None:
        """Let go of what was recorded: nothing has begun."""
        self._ended.set()
        self._syncing.join()
        self.journal.close()
        self.journal.path.unlink()

    def _sync(self) -> None:
        while not self._ended.wait(SYNC_PERIOD):
            self._try(self.journal.sync)

    def _try(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            self.error = error
