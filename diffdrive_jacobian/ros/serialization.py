"""Serialized messages: deserialized whole, or read in part."""

from __future__ import annotations

import struct
from typing import TypeVar

from builtin_interfaces.msg import Time
from rclpy.serialization import deserialize_message

from diffdrive_jacobian.messages.conversion import MessageError

T = TypeVar('T')


def deserialized(data: bytes, message_type: type[T]) -> T:
    """Return the message that serialized bytes hold.

    Raises:
        MessageError: They hold no such message.
    """
    try:
        message: T = deserialize_message(data, message_type)
    except RuntimeError as error:
        raise MessageError(f'it is no {message_type.__name__} message') from error
    return message


def goals_header(data: bytes) -> tuple[Time, int]:
    """Return the stamp and the number of poses of a serialized Goals message, and convert nothing else.

    The layout is that of CDR: 4 bytes of encapsulation, of which the second is odd for little-endian;
    the stamp, the frame as length and text, and the number of poses, aligned to 4 bytes.

    Raises:
        MessageError: The bytes are too short.
    """
    try:
        order = '<' if data[1] & 1 else '>'
        sec, nanosec, length = struct.unpack_from(f'{order}iII', data, 4)
        (count,) = struct.unpack_from(f'{order}I', data, 16 + (length + 3) // 4 * 4)
    except (IndexError, struct.error) as error:
        raise MessageError('it is no Goals message') from error
    return Time(sec=sec, nanosec=nanosec), count
