"""A hash of all messages of a world: two worlds with the same hash are the same bit for bit."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.structure import (
    Array,
    FieldType,
    Number,
    Sequence,
    Structure,
    is_identifier,
    plain,
    structure,
    walk,
)
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS
from diffdrive_jacobian.ros.rclpy_internals import wrap_publish


class MessageDigest:
    """Hashes time, topic and fields of every message that a node publishes, as a context manager.

    Serialized bytes are not hashed as they are, because their padding is arbitrary. Random identifiers
    of goals are replaced by their numbers in the order in which they appear.
    """

    def __init__(self, world: Lockstep) -> None:
        """Start without messages."""
        self._world = world
        self._hash = hashlib.sha256()
        self._identifiers: dict[bytes, int] = {}
        self._restore: Callable[[], None] | None = None

    def __enter__(self) -> MessageDigest:
        """Start to hash."""
        add = self._add

        def hashing(publish: Callable[..., None]) -> Callable[..., None]:
            def hashed(self: Publisher, msg: Any) -> None:
                publish(self, msg)
                if self.topic_name not in NOT_OF_ROBOTS:
                    add(self, msg)

            return hashed

        self._restore = wrap_publish(hashing)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        if self._restore is not None:
            self._restore()

    def value(self) -> str:
        """Return the hash of the messages so far."""
        return self._hash.hexdigest()[:32]

    def _add(self, publisher: Publisher, message: Any) -> None:
        if isinstance(message, bytes):
            message = deserialize_message(message, publisher.msg_type)
        words = [str(self._world.now), publisher.topic_name]
        for _, kind, value in walk(structure(type(message)), message, whole=is_identifier):
            words += self._words(kind, value)
        self._hash.update('\0'.join(words).encode())

    def _words(self, kind: FieldType, value: Any) -> list[str]:
        """Return a field of a message as text, with every bit of the numbers."""
        match kind:
            case Structure():
                identifier = bytes(value.uuid)
                number = self._identifiers.setdefault(identifier, len(self._identifiers))
                return [str(number) if any(identifier) else 'none']
            case Array() if hasattr(value, 'tobytes'):
                return [value.tobytes().hex()]
            case Array(element=element) | Sequence(element=element):
                values = plain(value)
                return [
                    str(len(values)),
                    *(word for one in values for word in self._words(element, one)),
                ]
            case Number() if isinstance(value, float):
                return [value.hex()]
        return [repr(value)]
