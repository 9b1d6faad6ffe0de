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

"""Recovery: a new bag with what can be read of one that is damaged or was never finished."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from diffdrive_jacobian.bags.bag_reader import find_damage, noted_losses
from diffdrive_jacobian.bags.bag_writer import Summary, build_bag
from diffdrive_jacobian.bags.damaged_bag import DamagedBag
from diffdrive_jacobian.bags.files import JOURNAL, is_journal, journal_of
from diffdrive_jacobian.bags.files import NotABagError as NotABagError
from diffdrive_jacobian.bags.journal import (
    LEFT_OUT,
    LOST,
    Channel,
    Message,
    Record,
    is_being_written,
)
from diffdrive_jacobian.bags.message_definitions import (
    UnknownTypeError,
    definition,
    installed_structure,
    known_definition,
    known_structure,
)
from diffdrive_jacobian.errors import InterruptionError, NotDoneError
from diffdrive_jacobian.messages.cdr import DecodingError, Reader
from diffdrive_jacobian.text import printable

Decoder = Callable[[bytes], Any]
"""Decodes a message, or raises DecodingError."""
RECOVERED = '_recovered'
"""Ends the name of a recovered bag."""


def _decoder(channel: Channel) -> Decoder | None:
    """Return a function that decodes the messages of a channel; None: its definition is not known."""
    name = channel.type_name
    for known, types in ((known_definition, known_structure), (definition, installed_structure)):
        # The type is not installed, or has what is not read here.
        with suppress(UnknownTypeError, TypeError):
            if known(name).type_hash == channel.type_hash:
                return Reader(types(name), ())
    return None


class NothingToSaveError(NotDoneError):
    """There is nothing to recover; the arguments are the reason and what could not be read."""


class UncheckedError(NothingToSaveError):
    """Nothing is missing as far as could be checked; the arguments are that, and what could not be."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Recovery:
    """A recovered bag, and what could not be recovered."""

    bag: Path
    """Directory of the new bag."""
    summary: Summary
    """Its content."""
    damaged: str
    """Why readers refuse the old bag; '' if they do not, or if it is a journal."""
    lost: tuple[str, ...]
    """Descriptions of what could not be read."""
    unchecked: tuple[str, ...]
    """What could not be checked, so that other losses would not have been noticed."""
    lost_before: tuple[str, ...]
    """What the recorder reported as lost, one description for each topic."""
    topics_left_out: bool
    """Whether there are topics whose messages were read but could not be written."""
    undecodable: tuple[str, ...]
    """Descriptions of messages that were saved but cannot be decoded, and of topics not checked."""


def recover(
    what: Path,
    output: Path | None = None,
    *,
    replace: bool = False,
    interrupted: Callable[[], bool] = lambda: False,
) -> Recovery:
    """Write a new bag with what can be read of another one, which stays as it is.

    Args:
        what: A bag's directory, one of its files, a journal, or the bag that a journal belongs to.
        output: The new bag's directory. By default it is beside the old one.
        replace: Whether the new bag may replace another one than the old one.
        interrupted: Is called for each record; once it returns True nothing is left of the new bag.

    Raises:
        NotABagError: There is nothing like a bag.
        UncheckedError: Nothing is missing as far as could be checked, which is not all.
        NothingToSaveError: The bag is complete, or not a message can be read.
        FileExistsError: The new bag exists, and is not to be replaced or is the old one.
        OSError: The old bag cannot be read, or the new one not be written.
        InterruptionError: `interrupted` returned True.
    """
    if not what.exists() and journal_of(what).is_file():
        what = journal_of(what)
    with tempfile.TemporaryDirectory(prefix='recover_run_') as scratch:
        old = DamagedBag(what, Path(scratch))
        target = output or _default_target(what)
        if target.exists() and not replace:
            raise FileExistsError(f'{target} exists already')
        if target.exists() and target.resolve() in (what.resolve(), what.resolve().parent):
            raise FileExistsError(f'{target} is the bag to recover: it is not replaced')
        if is_journal(what) and is_being_written(what):
            raise NothingToSaveError(f'{what} is being recorded now: end record_run first')

        def records() -> Iterator[Record]:
            for record in old.records():
                if interrupted():
                    raise InterruptionError('no bag was written')
                yield record

        survey = _Survey(records())
        lost, unchecked = tuple(old.found.losses), tuple(old.found.unchecked)
        undecodable = survey.undecodable
        # A journal is no bag, whole as it may be.
        damaged = '' if is_journal(what) else find_damage(what)
        count = survey.kinds[Message]
        whole = old.metadata.message_count == count or (what.suffix == '.mcap' and what.is_file())
        if whole and not lost and not damaged and not is_journal(what):
            if unchecked:
                found = f'nothing was found missing in {what}, but it cannot be called complete:'
                raise UncheckedError(found, *unchecked, *undecodable)
            complete = f'{what} is complete: nothing to recover'
            raise NothingToSaveError('; '.join([complete, *undecodable]))
        if not count:
            nothing = f'{what} holds no message that can be saved'
            if is_journal(what) and not lost:
                nothing += ': the recording ended before one was received, so it can be deleted'
            raise NothingToSaveError(nothing, *lost)
        # The file may still grow: the same records as in the survey are written.
        surveyed = survey.kinds.total()
        summary = build_bag(
            survey.channels.values(),
            islice(records(), surveyed),
            target,
            replace=replace,
        )
        return Recovery(
            bag=target,
            summary=summary,
            damaged=damaged,
            lost=lost,
            unchecked=unchecked,
            lost_before=tuple(noted_losses(survey.notes)),
            topics_left_out=bool(old.found.left_out),
            undecodable=undecodable,
        )


class _Survey:
    """Topics, number of records by their kind, noted losses, and messages that cannot be decoded.

    Types of ROS 2 Jazzy are decoded without ROS, others if their package is installed as it was
    recorded.
    """

    def __init__(self, records: Iterable[Record]) -> None:
        self.kinds: Counter[type[Record]] = Counter()
        self.notes: dict[str, str] = {}
        """The custom data of the keys `LOST` and `LEFT_OUT`."""
        self.channels: dict[int, Channel] = {}
        self._messages: Counter[str] = Counter()
        self._undecodable: Counter[str] = Counter()
        self._unchecked: set[str] = set()
        decoders: dict[tuple[str, str], Decoder | None] = {}
        for record in records:
            self.kinds[type(record)] += 1
            if isinstance(record, Channel):
                self.channels[record.id] = record
                key = record.type_name, record.type_hash
                if key not in decoders:
                    decoders[key] = _decoder(record)
            elif isinstance(record, Message):
                channel = self.channels[record.channel]
                self._messages[channel.topic] += 1
                decoder = decoders[channel.type_name, channel.type_hash]
                if decoder is None:
                    self._unchecked.add(channel.topic)
                    continue
                try:
                    decoder(record.data)
                except DecodingError:
                    self._undecodable[channel.topic] += 1
            elif record.key in (LOST, LEFT_OUT):
                self.notes[record.key] = record.value

    @property
    def undecodable(self) -> tuple[str, ...]:
        """Descriptions of messages that cannot be decoded, and of topics that were not checked."""
        return (
            *(
                f'{count} of {self._messages[topic]} messages on {printable(topic)} cannot be decoded '
                'as little-endian CDR'
                for topic, count in self._undecodable.items()
            ),
            *(
                f'the {self._messages[topic]} messages on {printable(topic)} were not checked: their '
                'type is not installed as it was recorded'
                for topic in sorted(self._unchecked)
            ),
        )


def _default_target(what: Path) -> Path:
    if is_journal(what):
        return what.with_name(what.name.removesuffix(JOURNAL))
    stem = what.stem if what.is_file() else what.resolve().name
    return what.resolve().with_name(stem + RECOVERED)
