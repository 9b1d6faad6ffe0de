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

"""A recording, from its first message to the bag."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from diffdrive_jacobian import __version__
from diffdrive_jacobian.bags.bag_writer import Summary, build_bag, check_target
from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import (
    LEFT_OUT,
    LOST,
    OVERHEAD,
    Channel,
    JournalWriter,
    Message,
    Record,
    Text,
)
from diffdrive_jacobian.bags.salvage import Topic, read_mcap
from diffdrive_jacobian.errors import NotDoneError, UserError
from diffdrive_jacobian.plots.output_files import names_by_time
from diffdrive_jacobian.text import printable

FLUSH_PERIOD = 0.1
"""Period at which records are handed to the operating system (s)."""
SYNC_PERIOD = 0.3
"""Period at which they are synced to the disk (s)."""
CAPACITY = 128 << 20
"""Memory for records that wait to be written (bytes): four seconds of 1 MB at 30 Hz."""
EARLY = 4 << 20
"""Waiting records of this size are written before the period is over (bytes)."""
MAX_REASON = 500
"""Largest length of the report on a topic that was left out (characters)."""
MAX_LEFT_OUT = 100
"""Largest number of topics that were left out and are named."""


class JournalThread:
    """Writes records to a journal in a thread. Until they are written they wait in bounded memory."""

    def __init__(
        self,
        journal: JournalWriter,
        *,
        lossless: bool = False,
        before_sync: Callable[[], None] = lambda: None,
    ) -> None:
        """Start the thread.

        Args:
            journal: Where the records are written.
            lossless: Whether `add` waits when `CAPACITY` is used up. Otherwise it drops messages.
            before_sync: Called in the thread before each sync.
        """
        self._journal = journal
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
            Whether it was queued. False: the queue is full, which holds for messages only, or writing
            has failed.
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
            return waiting == 0 or waiting + size <= CAPACITY or self.error is not None

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
                    if not self._journal.in_place():
                        raise OSError(f'{self._journal.path} was removed, renamed or replaced')
                    synced = time.monotonic()
                else:
                    self._journal.flush()
            except OSError as error:
                self.error = error
            with self._changed:
                self._changed.notify_all()
            if closing:
                return


class RecordingError(NotDoneError):
    """A recording is not complete. The message says why, and where the recorded messages are."""

    def __init__(self, message: str, summary: Summary | None = None) -> None:
        """Create the error, with the content of the bag; None: there is no bag."""
        super().__init__(message)
        self.summary = summary


class Recording:
    """A journal that is on the disk within half a second, and is converted to a bag at the end."""

    def __init__(
        self,
        bag: Path,
        *,
        lossless: bool = False,
        replace: bool = False,
    ) -> None:
        """Start to record. The directory of the bag is created at the end.

        Args:
            bag: Directory of the bag. Its journal must not exist.
            lossless: Whether `add` waits for a disk that is too slow. Otherwise messages are dropped.
            replace: Whether the bag may replace another one, which stays until then.

        Raises:
            FileExistsError: The journal exists, or the bag, and it is not to be replaced or is no bag.
            OSError: They cannot be written there.
        """
        check_target(bag, replace=replace)
        journal = journal_of(bag)
        if journal.exists():
            raise FileExistsError(
                f'{journal} exists already: recover_run {journal} writes the bag from it'
            )
        self.bag = bag
        self.journal = JournalWriter(journal)
        self._replace = replace
        self.started = time.monotonic()
        self._channels: dict[int, Channel] = {}
        self._added: Counter[int] = Counter()
        self._dropped: Counter[int] = Counter()
        self._missed: dict[str, int] = {}
        self._left_out: dict[str, str] = {}
        self._noted: list[Text] = []
        self._unread: list[str] = []
        self._open = True
        self.journal.add(Text('recorder', f'diffdrive_jacobian {__version__}'))
        try:
            self.journal.flush()
        except OSError:
            self.journal.close()
            journal.unlink()
            raise
        self._thread = JournalThread(self.journal, lossless=lossless, before_sync=self._note_losses)

    @property
    def error(self) -> OSError | None:
        """Why nothing more can be recorded. None: no error. `finish` raises it."""
        return self._thread.error

    @property
    def lost(self) -> dict[str, int]:
        """Number of messages known to be lost so far, by topic."""
        lost = Counter(dict(self._missed))
        for channel, number in list(self._dropped.items()):
            lost[self._channels[channel].topic] += number
        return {topic: number for topic, number in sorted(lost.items()) if number}

    def add(self, record: Record) -> None:
        """Add a record. After the end of the recording this does nothing."""
        if not self._open:
            return
        if isinstance(record, Channel):
            self._channels[record.id] = record
        added = self._thread.add(record)
        if isinstance(record, Message):
            (self._added if added else self._dropped)[record.channel] += 1

    def set_missed(self, topic: str, messages: int) -> None:
        """Set the number of messages of a topic that are known to be missed so far."""
        self._missed[topic] = messages

    def set_left_out(self, topic: str, why: str) -> None:
        """Note that a topic, or its publishers of one type, are not recorded. `finish` raises it."""
        if len(self._left_out) < MAX_LEFT_OUT or topic in self._left_out:
            self._left_out[topic] = why
        else:
            # Other processes choose the names, and how many there are.
            self._left_out['others'] = f'more than {MAX_LEFT_OUT} topics cannot be recorded'

    def finish(self) -> Summary:
        """Write the bag, read it back, and remove the journal.

        Raises:
            RecordingError: Messages are known to be lost, or the disk failed, or the bag cannot be
                written. The recorded messages are in the bag, if the error has a summary, or in a
                journal.
        """
        self._open = False
        self._thread.close()
        journal = self.journal.path
        if not self.journal.in_place():
            self.journal.close()
            raise RecordingError(
                f'{journal} was removed, renamed or replaced while it was being recorded: no bag is '
                'written. If the file still exists elsewhere, recover_run writes the bag from it'
            )
        try:
            if self.error is not None:
                # Messages that were queued, but could not be written, are lost.
                written = Counter(one.channel for one in self._read() if isinstance(one, Message))
                self._dropped += self._added - written
            summary = build_bag(
                self._channels.values(),
                chain(self._read(), self._notes()),
                self.bag,
                replace=self._replace,
            )
        # Whatever rosbags raises: the user must know that the journal exists.
        except Exception as error:
            why = getattr(error, 'strerror', None) or str(error) or repr(error)
            raise RecordingError(
                f'{self.bag} cannot be written: {why}. The recorded messages are in {journal}: '
                f'recover_run {journal} writes the bag from it, where there is space{self._missing()}'
            ) from error
        finally:
            self.journal.close()
        summary = replace(summary, lost=self.lost)
        if self.error is not None:
            raise RecordingError(
                f'the recording was aborted: {self.error.strerror or self.error}. {self.bag} contains '
                f'the messages recorded before, and so does {journal}{self._missing()}',
                summary,
            )
        if summary.messages != self._added.total():
            raise RecordingError(
                f'{self._added.total()} messages were recorded, but {self.bag} contains '
                f'{summary.messages}. The journal {journal} is kept',
                summary,
            )
        if self._unread:
            raise RecordingError(
                f'{self.bag} does not contain all that was recorded: {"; ".join(self._unread)}. '
                f'The journal {journal} is kept',
                summary,
            )
        journal.unlink()
        if summary.lost or self._left_out:
            raise RecordingError(self._describe_losses(), summary)
        return summary

    def discard(self) -> None:
        """Remove the recording."""
        self._open = False
        self._thread.close()
        ours = self.journal.in_place()
        self.journal.close()
        if ours:
            self.journal.path.unlink(missing_ok=True)

    def _read(self) -> Iterator[Message | Text]:
        """Yield what the journal contains that a bag can contain."""
        ids = {(one.topic, one.type_name): one.id for one in self._channels.values()}
        numbers: dict[int, int] = {}
        self._unread.clear()
        with open(self.journal.path, 'rb') as file:
            for found in read_mcap(file, self._unread.append, lambda doubt: None):
                if isinstance(found, Topic):
                    numbers[found.id] = ids[found.name, found.type_name]
                elif isinstance(found, Text):
                    yield found
                elif isinstance(found, Message):
                    yield Message(numbers[found.channel], found.stamp, found.data)

    def _notes(self) -> list[Text]:
        """Return the losses so far as entries of the custom data."""
        notes: dict[str, dict[str, Any]] = {LOST: self.lost, LEFT_OUT: dict(self._left_out)}
        return [Text(key, json.dumps(note)) for key, note in notes.items() if note]

    def _note_losses(self) -> None:
        """Write the losses so far into the journal, for recover_run."""
        notes = self._notes()
        for note in notes:
            if note not in self._noted:
                self.journal.add(note)
        self._noted = notes

    def _missing(self) -> str:
        """Return how many messages are neither in the journal nor in the bag; '': none that is known."""
        number = sum(self.lost.values())
        return f'. {number} {"message is" if number == 1 else "messages are"} missing' if number else ''

    def _describe_losses(self) -> str:
        causes = []
        if dropped := self._dropped.total():
            causes.append(f'{dropped} were received faster than the disk could write them')
        if missed := sum(self._missed.values()):
            causes.append(f'{missed} were not received by the recorder')
        topics = ', '.join(f'{topic} {number}' for topic, number in self.lost.items())
        parts = [f'messages are lost: {"; ".join(causes)} ({topics})'] if causes else []
        parts += [
            printable(f'{topic} was not recorded: {why}', MAX_REASON)
            for topic, why in sorted(self._left_out.items())
        ]
        return '; '.join(parts)


def open_recording(
    prefix: str, output: str | None, *, lossless: bool = False, replace: bool = False
) -> Recording:
    """Start a recording to a path of the user, or in the current directory as `PREFIX_DATE-TIME`.

    Raises:
        UserError: The bag exists or cannot be written. The message names it.
    """
    try:
        if output is not None:
            return Recording(Path(output), lossless=lossless, replace=replace)
        for name in names_by_time(prefix):
            # Other processes may take the same name.
            with suppress(FileExistsError):
                return Recording(Path(name), lossless=lossless)
    except OSError as error:
        where = output or 'this directory'
        why = error.strerror.lower() if error.strerror else str(error)
        raise UserError(f'cannot record to {where}: {why}') from error
    raise AssertionError('there is always another name')


@contextmanager
def saved_on_error(recording: Recording | None) -> Iterator[None]:
    """Finish a recording if an exception is raised; discard it if that is a `UserError`.

    Without an exception the recording stays open.
    """
    try:
        yield
    except UserError:
        # Nothing ran.
        if recording is not None:
            recording.discard()
        raise
    except BaseException:
        # The first error is the one to report.
        if recording is not None:
            with suppress(RecordingError):
                recording.finish()
        raise
