"""Deserialization of messages, in whole or in part."""

from __future__ import annotations

import struct
from typing import TypeVar

from builtin_interfaces.msg import Time
from rclpy.serialization import deserialize_message

from diffdrive_jacobian.messages.conversion import MessageError

T = TypeVar('T')


def deserialized(data: bytes, message_type: type[T]) -> T:
    """Return the message in serialized bytes.

    Raises:
        MessageError: They are not a message of this type.
    """
    try:
        message: T = deserialize_message(data, message_type)
    except RuntimeError as error:
        raise MessageError(f'it is not a {message_type.__name__} message') from error
    return message


def goals_header(data: bytes) -> tuple[Time, int]:
    """Return the stamp and the number of poses of a serialized Goals message without its poses.

    The layout is that of CDR. Of the 4 bytes of the encapsulation the second is odd for little-endian.
    The stamp follows, then the frame as length and text, and aligned to 4 bytes the number of poses.

    Raises:
        MessageError: The bytes are too short.
    """
    try:
        order = '<' if data[1] & 1 else '>'
        sec, nanosec, length = struct.unpack_from(f'{order}iII', data, 4)
        (count,) = struct.unpack_from(f'{order}I', data, 16 + (length + 3) // 4 * 4)
    except (IndexError, struct.error) as error:
        raise MessageError('it is not a Goals message') from error
    return Time(sec=sec, nanosec=nanosec), count
