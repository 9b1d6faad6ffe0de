"""Check whether messages that were saved can be decoded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from diffdrive_jacobian.bags.journal import Channel
from diffdrive_jacobian.bags.known_types import known_definition
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, definition
from diffdrive_jacobian.messages.cdr import DecodingError, Reader
from diffdrive_jacobian.messages.structure import DefinitionError, defined
from diffdrive_jacobian.text import printable

Decoder = Callable[[bytes], Any]
"""Decodes a message, or raises DecodingError."""


class DecodingCheck:
    """Counts, by topic, the messages that readers cannot decode.

    Types of ROS 2 Jazzy are checked without ROS, others if their package is installed as it was
    recorded.
    """

    def __init__(self) -> None:
        """Start without messages."""
        self._total: Counter[str] = Counter()
        self._failed: Counter[str] = Counter()
        self._unchecked: set[str] = set()
        self._decoders: dict[tuple[str, str], Decoder | None] = {}

    def add(self, channel: Channel, data: bytes) -> None:
        """Check a message of a channel."""
        key = channel.type_name, channel.type_hash
        if key not in self._decoders:
            self._decoders[key] = _decoder(channel)
        decoder = self._decoders[key]
        self._total[channel.topic] += 1
        if decoder is None:
            self._unchecked.add(channel.topic)
            return
        try:
            decoder(data)
        except DecodingError:
            self._failed[channel.topic] += 1

    @property
    def undecodable(self) -> list[str]:
        """Description of the messages that cannot be decoded, and of topics that were not checked."""
        found = [
            f'{count} of {self._total[topic]} messages on {printable(topic)} cannot be decoded'
            for topic, count in self._failed.items()
        ]
        found += [
            f'the {self._total[topic]} messages on {printable(topic)} were not checked: their type '
            'is not installed as it was recorded'
            for topic in sorted(self._unchecked)
        ]
        return found


def _decoder(channel: Channel) -> Decoder | None:
    """Return a function that decodes the messages of a channel; None: its definition is not known."""
    name = channel.type_name
    for known in (known_definition, definition):
        try:
            found = known(name)
            if found.type_hash == channel.type_hash:
                return Reader(defined(name, found.text), (), bounded=False)
        except (UnknownTypeError, DefinitionError, TypeError):
            # The type is not installed, or has what is not read here.
            continue
    return None
