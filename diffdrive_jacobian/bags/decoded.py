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

"""The messages of a bag as values, and why some of them are skipped.

A further reason to skip a message is a further line where they are counted: notes, `Run.skipped` and
`verify_run` have it then. Messages come by the time of their recording, as rosbags sorts them.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bag_reader import messages, stored_connections
from diffdrive_jacobian.bags.message_definitions import (
    known_structure,
    recorded_definition_differs,
    type_hashes,
)
from diffdrive_jacobian.errors import InterruptionError
from diffdrive_jacobian.messages.cdr import DecodingError
from diffdrive_jacobian.messages.codecs import Codec
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.text import printable

Take = Callable[[Connection, int, Any], None]
"""Receives the topic, the time of recording (ns) and the value of a message, or raises MessageError."""


@dataclass(slots=True)
class Tally:
    """How many messages there were, by the name of their topic in the bag."""

    expected: Counter[str] = field(default_factory=Counter)
    """As the bag counts them."""
    read: Counter[str] = field(default_factory=Counter)
    reasons: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    """How many were skipped, by topic and reason."""

    @property
    def skipped(self) -> dict[str, int]:
        """How many were skipped."""
        return {topic: counts.total() for topic, counts in self.reasons.items() if counts}

    @property
    def missing(self) -> Counter[str]:
        """How many the bag counts that are not there."""
        return self.expected - self.read

    def notes(self) -> Iterator[str]:
        """Describe the messages that were skipped, or are not there or too many."""
        for topic in sorted(self.expected):
            read, expected = self.read[topic], self.expected[topic]
            for why, count in sorted(self.reasons.get(topic, {}).items()):
                yield f'{count} of {read} messages on {printable(topic)} {why} and were skipped'
            if read != expected:
                yield (
                    f'{read} messages on {printable(topic)} were found, the bag should have {expected}'
                )


def read_messages(
    reader: Reader, codecs: Mapping[int, Codec[Any]], take: Take, interrupted: Callable[[], bool]
) -> Tally:
    """Read messages of an open bag, and return how many there were.

    Args:
        reader: The bag.
        codecs: The codec of each topic that is read, by the id of the connection.
        take: Is called with each message that can be used.
        interrupted: Is called for each message; once it returns True, reading ends.

    Raises:
        InterruptionError: `interrupted` returned True.
        BagError: The bag is damaged.
    """
    tally, unreadable = Tally(), Counter[str]()
    connections = [one for one in reader.connections if one.id in codecs]
    decode = {one.id: codecs[one.id].reader(known_structure(one.msgtype)) for one in connections}
    stored = stored_connections(reader)
    foreign = {
        one.id
        for one in connections
        if recorded_definition_differs(one.msgtype, type_hashes(one, stored))
    }
    for connection in connections:
        tally.expected[connection.topic] += connection.msgcount
    for connection, received, data in messages(reader, connections, unreadable):
        if interrupted():
            raise InterruptionError
        tally.read[connection.topic] += 1
        reasons = tally.reasons[connection.topic]
        if connection.id in foreign:
            reasons[f'were recorded with another definition of {connection.msgtype}'] += 1
            continue
        try:
            take(connection, received, decode[connection.id](data))
        except DecodingError:
            reasons['cannot be decoded as little-endian CDR'] += 1
        except MessageError:
            # The nodes drop it as well.
            reasons['hold invalid or implausible values'] += 1
    for topic, count in unreadable.items():
        tally.read[topic] += count
        tally.reasons[topic]['cannot be decoded'] += count
    return tally
