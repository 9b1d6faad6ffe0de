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

"""Messages that arrive with a wrong value in one field."""

from __future__ import annotations

import math
import operator
import random
import sys
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from diffdrive_jacobian.faults.fault import Filter, TopicFault
from diffdrive_jacobian.faults.message_field import MessageField
from diffdrive_jacobian.messages import conversion
from diffdrive_jacobian.messages.structure import FieldType, Number, Text, is_stamp
from diffdrive_jacobian.numerics.checks import Name, Probability, one_of
from diffdrive_jacobian.time_units import NANOSECONDS

_VALUES = {'nan': math.nan, 'inf': math.inf, '-inf': -math.inf}
_WITH_AMOUNT = ('offset', 'scale', 'set')
CHANGES = (*_VALUES, 'subnormal', 'negate', *_WITH_AMOUNT)
"""What can happen to a field."""
_SUBNORMAL = {'d': 2.0**-1074, 'f': 2.0**-149}
"""Least positive number of each type."""
_STAMP_LIMITS = -(2**31) * NANOSECONDS, 2**31 * NANOSECONDS - 1
"""Least and largest time that `sec` and `nanosec` can represent (ns)."""


@dataclass(frozen=True, repr=False)
class Corrupt(TopicFault):
    """Messages arrive with a wrong value in one field. Everything else in them is unchanged.

    | change | of | the receiver reads |
    |---|---|---|
    | 'nan', 'inf', '-inf' | floats | that value |
    | 'subnormal' | floats | the least number above zero of the type, with the sign of the value |
    | 'negate' | floats, signed integers, booleans | the value with the other sign, or `not` it |
    | 'offset' | floats, integers, stamps | the value plus `amount`; of a stamp in s, negative: past |
    | 'scale' | floats, integers | the value times `amount` |
    | 'set' | all but structures | `amount`; of a stamp in s |

    Integers and stamps stay within the range of their type. `'header.stamp.nanosec'` can be set to more
    than a second, and `'header.stamp.sec'` below zero. A message that does not have the element of the
    path (`'velocity[5]'`) arrives unchanged; if none has it, the fault has met nothing.

    Attributes:
        field: Path of the field: `'pose.pose.position.x'`, `'header.stamp'`, `'velocity[0]'`, or
            `'velocity'` for all its elements.
        change: One of the changes of the table.
        amount: Amount of 'offset' and 'scale', value of 'set': a number, a bool or a str.
        probability: Probability that a message is changed.
    """

    field: Name
    change: Annotated[str, one_of(*CHANGES)]
    amount: Any = 0.0
    probability: Probability = 1.0

    def __post_init__(self) -> None:
        """Check the fields, and whether the amount suits the change."""
        super().__post_init__()
        amount = self.amount
        if isinstance(amount, np.generic):
            amount = amount.item()
            object.__setattr__(self, 'amount', amount)
        if self.change == 'set' and isinstance(amount, (bool, str)):
            return
        if self.change in _WITH_AMOUNT:
            if not _is_number(amount) or not abs(amount) <= sys.float_info.max:
                others = ", a bool or a str (for others there are 'nan', 'inf', '-inf')"
                raise ValueError(
                    f'Corrupt: amount of {self.change!r} must be a finite number'
                    f'{others * (self.change == "set")}, got {amount!r}'
                )
        elif amount != 0.0:
            raise ValueError(
                f'Corrupt: amount must not be given with change {self.change!r}, got {amount!r}'
            )

    def begin(self, rng: random.Random, message_type: type) -> Filter:
        """Return the filter of one subscription.

        Raises:
            ValueError: The message type has no such field, or the change is not possible for it.
        """
        try:
            field = MessageField(message_type, self.field)
            change = self._changer(field)
        except ValueError as error:
            raise ValueError(f'Corrupt: {error}') from error

        return _Corrupting(self, rng, message_type, field, change)

    def _changer(self, field: MessageField) -> Callable[[Any], Any]:
        """Return a function of a value that returns the wrong one.

        Raises:
            ValueError: The change is not possible for the type.
        """
        kind, change, amount = field.type, self.change, self.amount
        numeric = _is_number(amount)
        match kind:
            case Number(is_float=True) if numeric:
                if change == 'subnormal':
                    return lambda value: math.copysign(_SUBNORMAL[kind.code], value)
                wrong, rounded = self._operation(float(amount)), _float32 if kind.code == 'f' else float
                return lambda value: rounded(wrong(value))
            case Number(limits=(low, high)) if numeric and self._fits_integers((low, high)):
                wrong = self._operation(float(amount) if change == 'scale' else int(amount))
                return lambda value: round(max(low, min(wrong(value), high)))
            case Number(code='?') if change == 'negate':
                return lambda value: not value
            case Number(code='?') if isinstance(amount, bool):
                return lambda _: amount
            case Text(most=most) if change == 'set' and isinstance(amount, str):
                if most is not None and (size := len(amount.encode())) > most:
                    raise ValueError(f'amount must fit into {kind}, got {size} bytes')
                return lambda _: amount
            case _ if is_stamp(kind) and change in ('offset', 'set') and numeric:
                return self._of_stamp
        with_amount = f' with amount {amount!r}' if change in _WITH_AMOUNT else ''
        raise ValueError(
            f"change {change!r}{with_amount} is not possible for field '{field.path}' of type {kind}: "
            f'{_possible(kind)}'
        )

    def _operation(self, amount: float) -> Callable[[Any], Any]:
        """Return what the change does to a number."""
        match self.change:
            case 'negate':
                return operator.neg
            case 'offset':
                return lambda value: value + amount
            case 'scale':
                return lambda value: value * amount
            case 'set':
                return lambda _: amount
        return lambda _: _VALUES[self.change]

    def _fits_integers(self, limits: tuple[int, int]) -> bool:
        if self.change == 'negate':
            return limits[0] < 0
        if self.change == 'scale':
            return True
        # No other change has an amount.
        if self.change not in _WITH_AMOUNT or self.amount != int(self.amount):
            return False
        return self.change == 'offset' or limits[0] <= self.amount <= limits[1]

    def _of_stamp(self, stamp: Any) -> Any:
        low, high = _STAMP_LIMITS
        # Beyond these limits a float would give an error, or a long integer.
        time = round(max(-(2.0**33), min(float(self.amount), 2.0**33)) * NANOSECONDS)
        if self.change == 'offset':
            time += stamp.sec * NANOSECONDS + stamp.nanosec
        conversion.set_time(stamp, max(low, min(time, high)))
        return stamp


class _Corrupting:
    """The filter of one subscription."""

    def __init__(
        self,
        fault: Corrupt,
        rng: random.Random,
        message_type: type,
        field: MessageField,
        change: Callable[[Any], Any],
    ) -> None:
        self._fault, self._rng, self._message_type = fault, rng, message_type
        self._field, self._change = field, change
        self.missing: str | None = None
        self._met = False

    def __call__(self, _: int, data: bytes) -> list[tuple[int, bytes]]:
        if self._rng.random() < self._fault.probability:
            try:
                message = deserialize_message(data, self._message_type)
            except RuntimeError:
                # Not a message of this type: the receiver decides what to do with it.
                return [(0, data)]
            self._met = self._met or len(self._field.values(message)) > 0
            self.missing = None if self._met else f'no message had {self._field.path}'
            if self._field.replace(message, self._change):
                return [(0, serialize_message(message))]
        return [(0, data)]


def _possible(kind: FieldType) -> str:
    """Return which changes a type allows, for an error message."""
    match kind:
        case Number(is_float=True):
            return f'it must be one of {", ".join(map(repr, CHANGES))}, with a number as amount'
        case Number(limits=(low, high)):
            signed = "'negate', " * (low < 0)
            return f"it must be {signed}'offset', 'scale' or 'set', with integers from {low} to {high}"
        case Number(code='?'):
            return "it must be 'negate', or 'set' with a bool"
        case Text():
            return "it must be 'set' with a str"
        case _ if is_stamp(kind):
            return "it must be 'offset' or 'set', with a number of seconds"
    return 'name one of its fields that is a number, a bool, a string or a stamp'


def _is_number(amount: Any) -> bool:
    return isinstance(amount, Real) and not isinstance(amount, bool)


def _float32(value: float) -> float:
    with np.errstate(over='ignore'):
        return float(np.float32(value))
