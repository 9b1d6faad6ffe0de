"""A hash of all messages of a world: two worlds with the same hash are the same bit for bit."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from unique_identifier_msgs.msg import UUID

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.ros.rclpy_internals import wrap_publish

OMITTED = ('/clock', '/rosout', '/parameter_events', '/fault_events')
"""Topics that are not part of the hash: they do not belong to the nodes, or to their behaviour."""


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
                if self.topic_name not in OMITTED:
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
        words = (str(self._world.now), publisher.topic_name, *self._values(message))
        self._hash.update('\0'.join(words).encode())

    def _values(self, value: Any) -> list[str]:
        """Return the fields of a message as text, with every bit of the numbers."""
        if isinstance(value, UUID):
            identifier = bytes(value.uuid)
            number = self._identifiers.setdefault(identifier, len(self._identifiers))
            return [str(number) if any(identifier) else 'none']
        if hasattr(value, 'get_fields_and_field_types'):
            names = value.get_fields_and_field_types()
            return [word for name in names for word in self._values(getattr(value, name))]
        if isinstance(value, float):
            return [value.hex()]
        if isinstance(value, np.ndarray):
            return [value.tobytes().hex()]
        if isinstance(value, (str, bytes, int, bool)):
            return [repr(value)]
        return [str(len(value)), *(word for one in value for word in self._values(one))]
