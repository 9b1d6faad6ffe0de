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

"""From the bytes of a subscription to the value that a callback takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.messages.cdr import DecodingError
from diffdrive_jacobian.messages.codecs import Codec
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.ros.graph_faults import Interleaving
from diffdrive_jacobian.ros.rclpy_internals import request_message_info

V = TypeVar('V')

MAX_SIZE = 1 << 21
"""Size of the largest message that is read (bytes). A path of the greatest length has half of it. One of
that size takes at most a second."""


def receiver(
    codec: Codec[V],
    message_type: type[Any],
    callback: Callable[[V], object],
    refused: Callable[[MessageError], object],
    numbers: Interleaving | None = None,
) -> Callable[..., None]:
    """Return a callback for serialized messages, which calls another one with their values.

    Args:
        codec: What is read of them.
        message_type: Their type.
        callback: Takes the value of each. It refuses one by a MessageError.
        refused: Called instead if the bytes are no message of the type or too many (`DecodingError`), if
            the value is invalid, and if the callback refuses it.
        numbers: Receives the sequence number of each message.
    """
    read = codec.reader(message_type, deserialize_message)

    def receive(data: Any, info: Mapping[str, Any] | None = None) -> None:
        if numbers is not None:
            if info is None:
                # The EventsExecutor passes one tuple.
                data, info = data
            # None where the middleware does not number messages.
            numbers.number = info.get('publication_sequence_number')
        try:
            if len(data) > MAX_SIZE:
                raise DecodingError(f'it must have at most {MAX_SIZE} bytes, got {len(data)}')
            callback(read(data))
        except MessageError as error:
            refused(error)

    if numbers is not None:
        request_message_info(receive)
    # Reports of lockstep name a callback.
    receive.__qualname__ = getattr(callback, '__qualname__', receive.__qualname__)
    return receive


def ignoring_invalid(
    codec: Codec[V],
    message_type: type[Any],
    callback: Callable[[V], object],
    refused: Callable[[MessageError], object] = lambda _: None,
) -> Callable[[bytes], None]:
    """Return a callback as `receiver` does, for clients: they ignore what cannot be decoded."""

    def report(error: MessageError) -> None:
        if not isinstance(error, DecodingError):
            refused(error)

    return receiver(codec, message_type, callback, report)
