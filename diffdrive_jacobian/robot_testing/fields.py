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

"""The fields of messages, however these were published."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache, lru_cache
from typing import Any

from rclpy.serialization import deserialize_message

from diffdrive_jacobian.messages.cdr import DecodingError, Reader
from diffdrive_jacobian.messages.structure import field_value

Read = Callable[[type, Any], tuple[Any, ...] | None]


def field_reader(fields_of: Callable[[type], tuple[str, ...]]) -> Read:
    """Return a function that reads fields of a message, from its type and its object or its bytes.

    It returns None if the bytes are not a message of the type.

    Args:
        fields_of: Returns the paths of the fields of a type of messages.
    """

    @cache
    def compiled(message_type: type) -> tuple[tuple[str, ...], Reader]:
        fields = fields_of(message_type)
        return fields, Reader(message_type, fields, deserialize=deserialize_message)

    # Several properties read the same message one after the other.
    @lru_cache(1)
    def read_bytes(message_type: type, message: bytes) -> tuple[Any, ...] | None:
        with suppress(DecodingError):
            fields: tuple[Any, ...] = compiled(message_type)[1](message)
            return fields
        return None

    def read(message_type: type, message: Any) -> tuple[Any, ...] | None:
        fields, _ = compiled(message_type)
        if isinstance(message, bytes):
            return read_bytes(message_type, message)
        return tuple(field_value(message, field) for field in fields)

    return read
