"""Deserialization of recorded messages without ROS.

rosbags generates Python code from definitions of message types, and executes it. So only the definitions
that come with rosbags, and the one in this module, are used for it, and never a definition in a bag.
Where a bag has the hash of a type (RIHS01, REP 2011), it is compared with that of the known definition.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from typing import Any

from rosbags.interfaces import Connection, Msgdef, Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from diffdrive_jacobian.bags.message_definitions import Definition, UnknownTypeError
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.text import printable

GOALS = 'nav_msgs/msg/Goals'
GOALS_DEFINITION = """std_msgs/Header header
geometry_msgs/PoseStamped[] goals
"""
"""The only type of ROS 2 Jazzy that is read here and that rosbags lacks."""
_HASH = re.compile('RIHS01_[0-9a-f]{64}')
_ERRORS = (
    *(SerdeError, struct.error, ValueError, IndexError, AssertionError),
    *(MemoryError, OverflowError, RecursionError),
)
"""What generated code raises on data that is not a message of its type."""
_MAX_REPAIRS = 50
MAX_OBJECTS = 500_000
"""Largest number of nested messages that are decoded of one message.

The smallest ones take thirty times more memory as Python objects than as CDR.
"""
MAX_TEXTS = 1 << 24
"""Size of the largest message that is decoded of a type with sequences of strings (bytes)."""
_SMALL = 1 << 20
"""Size up to which messages are decoded without counting (bytes)."""


class UndecodableError(DiffdriveError, ValueError):
    """A recorded message is not a valid message of its type."""


class _CountingTypes:
    """The part of a typestore that generated code uses, for one message of unknown origin."""

    def __init__(self, store: Typestore) -> None:
        self.max_sequence_length = store.max_sequence_length
        self._store = store
        self._counting: dict[str, Msgdef[object]] = {}
        self._objects = 0

    def get_msgdef(self, name: str) -> Msgdef[object]:
        """Return a type, whose constructor raises SerdeError beyond `MAX_OBJECTS`."""
        if name not in self._counting:
            found = self._store.get_msgdef(name)
            self._counting[name] = replace(found, cls=self._count(found.cls))
        return self._counting[name]

    def _count(self, constructor: Callable[..., object]) -> Any:
        def construct(*values: object) -> object:
            self._objects += 1
            if self._objects > MAX_OBJECTS:
                raise SerdeError(f'more than {MAX_OBJECTS} nested messages')
            return constructor(*values)

        return construct


@cache
def _has_texts(type_name: str) -> bool:
    """Return whether a type, or one of its fields, has a sequence of strings."""

    def has(description: Any) -> bool:
        kind, content = description
        if kind == Nodetype.NAME:
            return _has_texts(content)
        if kind == Nodetype.SEQUENCE and content[0][0] == Nodetype.BASE:
            return bool(content[0][1][0] == 'string')
        return kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and has(content[0])

    return any(has(description) for _, description in _typestore().fielddefs[type_name][1])


@cache
def _typestore() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(GOALS_DEFINITION, GOALS))
    return store


def is_known(type_name: str) -> bool:
    """Return whether messages of a type (`package/msg/Name`) can be decoded without ROS."""
    return type_name in _typestore().fielddefs


@cache
def known_definition(type_name: str) -> Definition:
    """Return the definition of a type that is known without ROS.

    Args:
        type_name: `package/msg/Name`.

    Raises:
        UnknownTypeError: It is not known.
    """
    if not is_known(type_name):
        raise UnknownTypeError(f'{printable(type_name)} is not a type of ROS 2 Jazzy')
    store = _typestore()
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return Definition(name=type_name, text=text, type_hash=store.hash_rihs01(type_name))


def decode(data: bytes, type_name: str) -> Any:
    """Return a message from its CDR, little-endian or big-endian.

    Fields have the names of ROS. Arrays of numbers are NumPy arrays. In a text that is not UTF-8 each
    invalid byte is replaced by `?`.

    Args:
        data: The serialized message.
        type_name: Its type, `package/msg/Name`.

    Raises:
        UndecodableError: It is not a message of that type, the type is not known, or the message would
            take far more memory than its size (`MAX_OBJECTS`, `MAX_TEXTS`).
    """
    if not is_known(type_name):
        raise UndecodableError(f'{printable(type_name)} is not a type of ROS 2 Jazzy')
    for _ in range(_MAX_REPAIRS):
        try:
            return _deserialized(data, type_name)
        except UnicodeDecodeError as error:
            repaired = _with_valid_text(data, error.object)
            if repaired is None:
                raise UndecodableError(f'not a message of {type_name}') from error
            data = repaired
        except _ERRORS as error:
            raise UndecodableError(f'not a message of {type_name}') from error
    raise UndecodableError(f'not a message of {type_name}: more than {_MAX_REPAIRS} texts are not UTF-8')


def _deserialized(data: bytes, type_name: str) -> Any:
    """Return a message from its CDR, whatever follows it.

    rosbags' own `deserialize_cdr` refuses more than 3 bytes behind a message. Fast CDR writes 4 behind
    some messages with empty arrays of float64, such as JointState, and ignores any number of them.
    """
    if data[:2] not in (b'\x00\x00', b'\x00\x01') or len(data) < 4:
        raise SerdeError(f'the encapsulation must be CDR, got {data[:2].hex()}')
    if len(data) > MAX_TEXTS and _has_texts(type_name):
        raise SerdeError(f'more than {MAX_TEXTS} bytes with sequences of strings')
    store: Any = _typestore()
    if len(data) > _SMALL:
        store = _CountingTypes(store)
    message_definition = store.get_msgdef(type_name)
    little = message_definition.deserialize_cdr_le
    deserialize = little if data[1] else message_definition.deserialize_cdr_be
    message, _ = deserialize(memoryview(data)[4:], 0, message_definition.cls, store)
    return message


def _with_valid_text(data: bytes, text: bytes) -> bytes | None:
    """Return a message in which a text that is not UTF-8 is made valid; None: it is not found."""
    length = struct.pack('<I' if data[1] & 1 else '>I', len(text) + 1)
    # With its length and its terminator it is not mistaken for another field.
    at = data.find(length + text + b'\0')
    if at < 0:
        return None
    # Each invalid byte becomes a surrogate, and that a `?`: the length stays the same.
    valid = text.decode(errors='surrogateescape').encode(errors='replace')
    return data[: at + 4] + valid + data[at + 4 + len(text) :]


def recorded_definition_differs(type_name: str, type_hashes: Iterable[str]) -> bool:
    """Return whether a type was recorded with another definition than the known one.

    Args:
        type_name: `package/msg/Name`; it is known.
        type_hashes: Hashes that a bag has for it. Those that are empty or no RIHS01 hash do not count.
    """
    known = _typestore().hash_rihs01(type_name)
    return any(_HASH.fullmatch(one) and one != known for one in type_hashes)


def type_hashes(connection: Connection, stored: Iterable[Connection]) -> list[str]:
    """Return what a bag says about the hash of a topic's type: in metadata.yaml and in its data files.

    Args:
        connection: The topic, as metadata.yaml has it.
        stored: The topics of the data files.
    """
    alike = (one for one in stored if (one.topic, one.msgtype) == (connection.topic, connection.msgtype))
    return [str(one.digest) for one in (connection, *alike)]
