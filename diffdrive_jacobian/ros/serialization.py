"""Deserialization of messages, in whole or in part."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from builtin_interfaces.msg import Time
from nav_msgs.msg import Goals, Path
from rclpy.serialization import deserialize_message

from diffdrive_jacobian.messages.cdr import DecodingError, Reader
from diffdrive_jacobian.messages.codecs import GOALS_HEADER, PATH_HEADER, Codec
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.structure import LITTLE_ENDIAN
from diffdrive_jacobian.ros.rclpy_internals import request_message_info

V = TypeVar('V')

MAX_OTHER_ENCAPSULATION = 200_000
"""Longest message of poses in an encapsulation that only rclpy reads (bytes): it creates an object for
each pose, of which 2,000 have this size."""
MAX_SIZE = 1 << 20
"""Size of the largest message that clients of our nodes decode (bytes). rclpy would take minutes for a
Goals message of 1.5 million poses."""


class Interleaving:
    """Detects several publishers whose messages alternate, by the sequence numbers of the messages.

    The numbers of one publisher increase. Where messages of two of them alternate, they fall again and
    again. A publisher that is restarted lets them fall once.
    """

    def __init__(self) -> None:
        """Start without messages."""
        self.number: int | None = None
        """Sequence number of the present message. None: the middleware has none."""
        self._last = -1
        self._falls = 0

    def count(self) -> None:
        """Count the present message."""
        number = self.number
        if number is not None:
            if number <= self._last:
                self._falls += 1
            self._last = number

    def falls(self) -> int:
        """Return how often the numbers did not increase since the last call."""
        falls, self._falls = self._falls, 0
        return falls


def ignoring_invalid(
    codec: Codec[V],
    message_type: type[Any],
    callback: Callable[[V], object],
    refused: Callable[[MessageError], object] = lambda _: None,
) -> Callable[[bytes], None]:
    """Return a callback for serialized messages that ignores invalid ones and those beyond `MAX_SIZE`.

    For each message that it cannot decode, the middleware would write several lines to standard error.
    `refused` is called if a message has an invalid value.
    """
    read = codec.reader(message_type, deserialize_message)

    def decode(data: bytes) -> None:
        if len(data) > MAX_SIZE:
            return
        try:
            value = read(data)
        except DecodingError:
            return
        except MessageError as error:
            refused(error)
            return
        callback(value)

    # Reports name a callback.
    decode.__qualname__ = getattr(callback, '__qualname__', decode.__qualname__)
    return decode


def reader(
    message_type: type[Any], fields: Sequence[str], *, whole: bool = True
) -> Callable[[bytes], tuple[Any, ...]]:
    """Return a Reader of these fields, to which rclpy reads the encapsulations that it does not."""
    return Reader(message_type, fields, whole=whole, deserialize=deserialize_message)


def decoding(
    message_type: type[Any],
    fields: Sequence[str],
    callback: Callable[..., None],
    refused: Callable[[DecodingError], None],
    numbers: Interleaving | None = None,
) -> Callable[..., None]:
    """Return a callback for serialized messages, which calls another one with their fields.

    `refused` is called instead if the bytes are not a message of this type. `numbers` receives the
    sequence number of each message.
    """
    read = reader(message_type, fields)

    def decode(data: Any, info: Mapping[str, Any] | None = None) -> None:
        if numbers is not None:
            # The EventsExecutor passes one tuple.
            data, info = data if info is None else (data, info)
            # None where the middleware does not number messages.
            numbers.number = info.get('publication_sequence_number')
        try:
            values = read(data)
        except DecodingError as error:
            refused(error)
            return
        callback(*values)

    if numbers is not None:
        request_message_info(decode)
    # Reports name a callback.
    decode.__qualname__ = getattr(callback, '__qualname__', decode.__qualname__)
    return decode


_read_header = {
    Goals: reader(Goals, GOALS_HEADER.fields, whole=False),
    Path: reader(Path, PATH_HEADER.fields, whole=False),
}


def poses_header(data: bytes, kind: type[Any]) -> tuple[Time, int]:
    """Return the stamp and the number of poses of a serialized Goals or Path message without its poses.

    Raises:
        DecodingError: The bytes end before the poses, or are too few for them. Or it takes message
            objects to read them, and they are too many for that.
    """
    if data[:2] != LITTLE_ENDIAN and len(data) > MAX_OTHER_ENCAPSULATION:
        raise DecodingError(
            f'a {kind.__name__} message must have at most {MAX_OTHER_ENCAPSULATION} bytes, unless it is '
            f'little-endian CDR, got {len(data)}'
        )
    sec, nanosec, count = _read_header[kind](data)
    return Time(sec=sec, nanosec=nanosec), count
