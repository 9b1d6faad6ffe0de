"""Deserialization of messages, in whole or in part."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from builtin_interfaces.msg import Time
from nav_msgs.msg import Goals
from rclpy.serialization import deserialize_message

from diffdrive_jacobian.diagnosis.lasting import Interleaving
from diffdrive_jacobian.messages.cdr import DecodingError, Reader
from diffdrive_jacobian.messages.conversion import MAX_WAYPOINTS
from diffdrive_jacobian.messages.structure import LITTLE_ENDIAN
from diffdrive_jacobian.messages.wire import GOALS
from diffdrive_jacobian.ros.rclpy_internals import with_message_info

T = TypeVar('T')

MAX_OTHER_ENCAPSULATION = 200_000
"""Longest Goals message in an encapsulation that only rclpy reads (bytes): it creates an object for each
of its poses, of which 2,000 have this size."""
MAX_SIZE = 1 << 20
"""Size of the largest message that clients of our nodes decode (bytes). rclpy would take minutes for a
Goals message of 1.5 million poses."""


def deserialized(data: bytes, message_type: type[T]) -> T:
    """Return the message in serialized bytes.

    Raises:
        DecodingError: They are not a message of this type.
    """
    try:
        message: T = deserialize_message(data, message_type)
    except RuntimeError as error:
        raise DecodingError(f'it is not a {message_type.__name__} message') from error
    return message


def checked_reader(message_type: type[T]) -> Callable[[bytes], T]:
    """Return a function as `deserialized` that reads sequences only if they are complete.

    For each other one, the code that rclpy generates for a type writes a line to standard error.
    """
    check = Reader(message_type, ())

    def read(data: bytes) -> T:
        if data[:2] == LITTLE_ENDIAN:
            check(data)
        return deserialized(data, message_type)

    return read


def ignoring_invalid(
    message_type: type[Any], callback: Callable[..., object], fields: Sequence[str] | None = None
) -> Callable[[bytes], None]:
    """Return a callback for serialized messages that ignores invalid ones and those beyond `MAX_SIZE`.

    For each message that it cannot decode, the middleware would write several lines to standard error.

    Args:
        message_type: Type of the messages.
        callback: Called with each message, or with the fields, one argument each.
        fields: Paths of the fields that are read; None: the message as a whole.
    """
    read = _values_reader(message_type, fields)

    def decode(data: bytes) -> None:
        if len(data) > MAX_SIZE:
            return
        try:
            # Our controller refuses more. rclpy writes a line for each that is longer than its message.
            if message_type is Goals and goals_header(data)[1] > MAX_WAYPOINTS:
                return
            values = read(data)
        except DecodingError:
            return
        callback(*values)

    # Reports name a callback.
    decode.__qualname__ = getattr(callback, '__qualname__', decode.__qualname__)
    return decode


def reader(
    message_type: type[Any], fields: Sequence[str], *, whole: bool = True
) -> Callable[[bytes], tuple[Any, ...]]:
    """Return a Reader of these fields, to which rclpy reads the encapsulations that it does not."""
    return Reader(message_type, fields, whole=whole, deserialize=deserialize_message)


def _values_reader(
    message_type: type[Any], fields: Sequence[str] | None
) -> Callable[[bytes], tuple[Any, ...]]:
    """Return a function that reads these fields of serialized messages; None: the message itself."""
    if fields is None:
        read = checked_reader(message_type)
        return lambda data: (read(data),)
    return reader(message_type, fields)


def decoding(
    message_type: type[Any],
    fields: Sequence[str] | None,
    callback: Callable[..., None],
    refused: Callable[[DecodingError], None],
    numbers: Interleaving | None = None,
) -> Callable[..., None]:
    """Return a callback for serialized messages.

    Args:
        message_type: Type of the messages.
        fields: Paths of the fields that are read; None: the message as a whole.
        callback: Called with the fields, one argument each, or with the message.
        refused: Called instead if the bytes are not a message of this type.
        numbers: Receives the sequence number of each message.
    """
    read = _values_reader(message_type, fields)

    def decode(data: bytes) -> None:
        try:
            values = read(data)
        except DecodingError as error:
            refused(error)
            return
        callback(*values)

    chosen: Callable[..., None] = decode
    if numbers is not None:

        def decode_numbered(data: bytes, info: Mapping[str, Any]) -> None:
            # None where the middleware does not number messages.
            numbers.number = info.get('publication_sequence_number')
            try:
                values = read(data)
            except DecodingError as error:
                refused(error)
                return
            callback(*values)

        chosen = with_message_info(decode_numbered)
    # Reports name a callback.
    chosen.__qualname__ = getattr(callback, '__qualname__', chosen.__qualname__)
    return chosen


_read_goals = reader(Goals, GOALS, whole=False)


def goals_header(data: bytes) -> tuple[Time, int]:
    """Return the stamp and the number of poses of a serialized Goals message without its poses.

    Raises:
        DecodingError: The bytes end before the poses, or are too few for them. Or it takes message
            objects to read them, and they are too many for that.
    """
    if data[:2] != LITTLE_ENDIAN and len(data) > MAX_OTHER_ENCAPSULATION:
        raise DecodingError(
            f'a Goals message must have at most {MAX_OTHER_ENCAPSULATION} bytes, unless it is plain '
            f'little-endian CDR, got {len(data)}'
        )
    sec, nanosec, count = _read_goals(data)
    return Time(sec=sec, nanosec=nanosec), count
