"""Messages with a wrong value in one of their fields."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from diffdrive_jacobian.faults.fault import Filter, TopicFault
from diffdrive_jacobian.messages import conversion
from diffdrive_jacobian.messages.structure import FieldType, MessageField, Number, Text, is_stamp
from diffdrive_jacobian.numerics.checks import Probability
from diffdrive_jacobian.numerics.fields import Name, one_of
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
    path (`'velocity[5]'`) arrives unchanged.

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
            if not _is_number(amount) or not math.isfinite(amount):
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

        def corrupt(_: int, data: bytes) -> list[tuple[int, bytes]]:
            if rng.random() < self.probability:
                try:
                    message = deserialize_message(data, message_type)
                except RuntimeError:
                    # Not a message of this type: the receiver decides what to do with it.
                    return [(0, data)]
                if field.replace(message, change):
                    return [(0, serialize_message(message))]
            return [(0, data)]

        return corrupt

    def _changer(self, field: MessageField) -> Callable[[Any], Any]:
        """Return a function of a value that returns the wrong one.

        Raises:
            ValueError: The change is not possible for the type.
        """
        kind = field.type
        numeric = _is_number(self.amount)
        match kind:
            case Number(is_float=True) if numeric:
                return self._of_float(kind)
            case Number(limits=(low, high)) if numeric and self._fits_integers((low, high)):
                return self._of_integer((low, high))
            case Number(code='?') if self.change == 'negate':
                return lambda value: not value
            case Number(code='?') if isinstance(self.amount, bool):
                return lambda _: self.amount
            case Text() if self.change == 'set' and isinstance(self.amount, str):
                return self._of_text(kind)
            case _ if is_stamp(kind) and self.change in ('offset', 'set') and numeric:
                return self._of_stamp()
        amount = f' with amount {self.amount!r}' if self.change in _WITH_AMOUNT else ''
        raise ValueError(
            f"change {self.change!r}{amount} is not possible for field '{field.path}' of type "
            f'{kind}: {_possible(kind)}'
        )

    def _of_float(self, kind: Number) -> Callable[[float], float]:
        amount = float(self.amount)
        if self.change in _VALUES:
            fixed = _VALUES[self.change]
            return lambda _: fixed
        if self.change == 'subnormal':
            return lambda value: math.copysign(_SUBNORMAL[kind.code], value)
        if self.change == 'negate':
            return lambda value: -value
        rounded = _float32 if kind.code == 'f' else float
        if self.change == 'offset':
            return lambda value: rounded(value + amount)
        if self.change == 'scale':
            return lambda value: rounded(value * amount)
        return lambda _: rounded(amount)

    def _fits_integers(self, limits: tuple[int, int]) -> bool:
        if self.change == 'negate':
            return limits[0] < 0
        if self.change == 'scale':
            return True
        # No other change has an amount.
        if self.change not in _WITH_AMOUNT or self.amount != int(self.amount):
            return False
        return self.change == 'offset' or limits[0] <= self.amount <= limits[1]

    def _of_integer(self, limits: tuple[int, int]) -> Callable[[int], int]:
        low, high = limits
        if self.change == 'negate':
            return lambda value: min(-value, high)
        if self.change == 'scale':
            factor = float(self.amount)
            return lambda value: int(max(low, min(_rounded(value * factor), high)))
        amount = int(self.amount)
        if self.change == 'offset':
            return lambda value: max(low, min(value + amount, high))
        return lambda _: amount

    def _of_text(self, kind: Text) -> Callable[[str], str]:
        text: str = self.amount
        if kind.most is not None and len(text.encode()) > kind.most:
            raise ValueError(f'amount must fit into {kind}, got {len(text.encode())} bytes')
        return lambda _: text

    def _of_stamp(self) -> Callable[[Any], Any]:
        low, high = _STAMP_LIMITS
        # Beyond these limits a float would give an error, or a long integer.
        amount = round(max(-(2.0**33), min(float(self.amount), 2.0**33)) * NANOSECONDS)
        shift = self.change == 'offset'

        def change(stamp: Any) -> Any:
            time = amount + (stamp.sec * NANOSECONDS + stamp.nanosec if shift else 0)
            conversion.set_time(stamp, max(low, min(time, high)))
            return stamp

        return change


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


def _rounded(value: float) -> float:
    """Return an integer, or an infinite number."""
    return round(value) if math.isfinite(value) else value
