"""Deserialization of recorded messages, and the check whether recorded messages can be deserialized."""

from __future__ import annotations

from collections import Counter
from typing import Any

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.bags.journal import Channel
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, definition, message_class
from diffdrive_jacobian.text import printable


class UndecodableError(ValueError):
    """A recorded message is not a message of its type."""


def decode(data: bytes, message_type: Any) -> Any:
    """Return a message from its CDR.

    Args:
        data: The serialized message.
        message_type: Its Python class.

    Raises:
        UndecodableError: It is not a message of that type.
    """
    try:
        return deserialize_message(data, message_type)
    except (RuntimeError, ValueError, AssertionError, SystemError, MemoryError) as error:
        # MemoryError: a length in the message that was damaged.
        raise UndecodableError(f'not a message of {message_type.__name__}') from error


class DecodingCheck:
    """Counts, by topic, the recorded messages that readers cannot decode."""

    def __init__(self) -> None:
        """Begin without messages."""
        self._total: Counter[str] = Counter()
        self._failed: Counter[str] = Counter()
        self._unchecked: set[str] = set()
        self._types: dict[tuple[str, str], Any] = {}

    def add(self, channel: Channel, data: bytes) -> None:
        """Check a message of a channel."""
        key = channel.type_name, channel.type_hash
        if key not in self._types:
            self._types[key] = _message_type(channel)
        self._total[channel.topic] += 1
        if self._types[key] is None:
            self._unchecked.add(channel.topic)
            return
        try:
            decode(data, self._types[key])
        except UndecodableError:
            self._failed[channel.topic] += 1

    @property
    def undecodable(self) -> list[str]:
        """Messages that cannot be decoded, and topics that could not be checked, in words."""
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


def _message_type(channel: Channel) -> Any:
    """Return the Python class of a type that is installed as it was recorded; None: it is not."""
    try:
        if definition(channel.type_name).type_hash == channel.type_hash:
            return message_class(channel.type_name)
    except UnknownTypeError:
        pass
    return None
