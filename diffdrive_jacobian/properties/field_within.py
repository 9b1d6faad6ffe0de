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

"""Limits of a number in messages of any type."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from rclpy.publisher import Publisher

from diffdrive_jacobian.faults.fault import RosName
from diffdrive_jacobian.faults.message_field import MessageField
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.messages.structure import Number
from diffdrive_jacobian.numerics.checks import Name, number
from diffdrive_jacobian.properties.base import RECENT, Property


def _limit(name: str, value: Any) -> float:
    """Require a number that is not NaN. An integer stays one: a float may be another number."""
    if type(value) is int:
        return value
    result = number(name, value, lambda _, __: None)
    if math.isnan(result):
        raise ValueError(f'{name} must be a number, got nan')
    return result


Limit = Annotated[float, _limit]
OCTET = 'c'
"""Code of a type whose values are bytes of Python."""
FEW = 64
"""Number of elements from which on they are compared by NumPy, with limits that are floats."""


@dataclass(repr=False)
class FieldWithin(Property):
    """A number in the messages of a topic is within limits: `low <= value <= high`.

    Each published message counts, whoever publishes it, and whether or not it is delivered. NaN is a
    violation, and so are bytes that are not a message. A message that does not have the element of the
    path (`'position[5]'`) is none. It is an error if no message had it: nothing was checked.

    Attributes:
        topic: The topic, of any type.
        field: Path of the number: `'pose.pose.position.x'`, `'position[0]'`, or `'position'` for all
            elements of an array.
        low: Least value; -infinity: there is none.
        high: Largest value; infinity: there is none.
    """

    topic: RosName
    field: Name
    low: Limit
    high: Limit

    def __post_init__(self) -> None:
        """Check the fields, and that there are values between the limits."""
        super().__post_init__()
        if self.low > self.high:
            raise ValueError(f'FieldWithin: low must be at most high, got {self.low:g}, {self.high:g}')

    def begin(self) -> None:
        """Begin to observe the topic."""
        self._fields: dict[type, MessageField] = {}
        self._seen = False
        self._topic = self.on_published(self.topic, self._on_message)

    def _on_message(self, publisher: Publisher, message: Any) -> None:
        field = self._field(publisher.msg_type)
        values = field.values(message)
        if not len(values):
            return
        self._seen = True
        if isinstance(field.type, Number) and field.type.code == 'f':
            # As they arrive.
            values = np.asarray(values, np.float32).tolist()
        if (wrong := self._outside(values)) is not None:
            self.found(
                f'{self._topic}: {self.field} is {wrong:.9g}; allowed: from {self.low:g} to '
                f'{self.high:g}'
            )
        shown = ', '.join(map(str, values[:RECENT]))
        self.note(f'{self._topic}: {self.field} is {shown}{", ..." * (len(values) > RECENT)}')

    def _outside(self, values: Any) -> float | None:
        """Return the first value that is not within the limits; None: all are."""
        if len(values) > FEW:
            numbers = np.asarray(values)
            (places,) = np.nonzero(~((numbers >= self.low) & (numbers <= self.high)))
            return float(numbers[places[0]]) if len(places) else None
        return next((value for value in values if not self.low <= value <= self.high), None)

    def finish(self) -> str | None:
        """Return None.

        Raises:
            LockstepError: No message had the field.
        """
        if not self._seen:
            raise LockstepError(
                f'{self}: no message on {self._topic} had {self.field}, so nothing was checked'
            )
        return None

    def _field(self, kind: type) -> MessageField:
        """Return the field of a type of messages.

        Raises:
            LockstepError: There is no such field, or it is no number.
        """
        if kind not in self._fields:
            try:
                found = MessageField(kind, self.field)
            except ValueError as error:
                raise LockstepError(f'{self}: {error}') from error
            if not isinstance(found.type, Number) or found.type.code == OCTET:
                raise LockstepError(f"{self}: field '{self.field}' is no number but {found.type}")
            self._fields[kind] = found
        return self._fields[kind]
