"""Fields of messages of any type, by their paths, such as `pose.pose.position.x` and `velocity[0]`.

The types come from the description that rosidl generates into each class.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

_NESTED = re.compile(r'(?P<array>[^\[<]+)\[(?P<count>\d+)\]|sequence<(?P<sequence>[^,]+)(?:, \d+)?>')
_STRUCTURE = re.compile(r'(\w+)/(\w+)')
_STEP = re.compile(r'([A-Za-z]\w*)(?:\[(\d+)\])?')
_FLOATS = {'float', 'double'}
_INTEGERS = {
    **{f'int{bits}': (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f'uint{bits}': (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
}
_STAMPS = {'builtin_interfaces/Time', 'builtin_interfaces/Duration'}


@dataclass(frozen=True, slots=True)
class FieldType:
    """Type of a field, or of the elements of an array."""

    name: str
    """Name as in the definition of the message: `double`, `string<10>`, `builtin_interfaces/Time`."""

    @property
    def is_float(self) -> bool:
        """Whether it is a `double` or a `float`."""
        return self.name in _FLOATS

    @property
    def limits(self) -> tuple[int, int] | None:
        """Least and largest value of an integer type; None: it is none."""
        return _INTEGERS.get(self.name)

    @property
    def is_boolean(self) -> bool:
        """Whether it is a boolean."""
        return self.name == 'boolean'

    @property
    def is_text(self) -> bool:
        """Whether it is a string."""
        return self.name.startswith(('string', 'wstring'))

    @property
    def is_stamp(self) -> bool:
        """Whether it is a time or a duration, with `sec` and `nanosec`."""
        return self.name in _STAMPS


class MessageField:
    """A field of a message class: a value, a structure, or all elements of an array of values."""

    def __init__(self, message_class: Any, path: str) -> None:
        """Find the field.

        Args:
            message_class: The class.
            path: Names of the fields, separated by dots, each with the index of an element if it is an
                array or a sequence: `poses[0].pose.position.x`. Without an index at its end it means all
                elements of an array.

        Raises:
            ValueError: There is no such field. The message names those that there are.
        """
        self._steps: list[tuple[str, int | None]] = []
        kind, inner, nested = _type_name(message_class), message_class, False
        for step in path.split('.'):
            matched = _STEP.fullmatch(step)
            fields = inner.get_fields_and_field_types() if inner is not None and not nested else {}
            if matched is None or matched[1] not in fields:
                there = ', '.join(fields) or ('elements [0], [1], ...' if nested else 'none')
                raise ValueError(
                    f"field '{path}' does not exist: {kind} has no {step!r}; its fields: {there}"
                )
            index = None if matched[2] is None else int(matched[2])
            kind = fields[matched[1]]
            found = _NESTED.fullmatch(kind)
            nested = found is not None and index is None
            if index is not None and (found is None or index >= int(found['count'] or index + 1)):
                size = 'a single value' if found is None else f'{found["count"]} elements'
                raise ValueError(f"field '{path}' does not exist: '{matched[1]}' has {size}")
            element = (found['array'] or found['sequence']) if found is not None else kind
            if not nested:
                kind = element
            inner = _class(element)
            self._steps.append((matched[1], index))
        self.path = path
        self.is_array = nested
        """Whether the field is an array or a sequence with all its elements."""
        self.type = FieldType(element)
        """Type of the value, or of the elements."""

    def replace(self, message: Any, change: Callable[[Any], Any]) -> bool:
        """Replace the value in a message, or each element of an array.

        Args:
            message: The message.
            change: Returns the new value. A structure is changed in place by it and returned.

        Returns:
            Whether there is anything else than before. There is not if the message has no such element.
        """
        holder = message
        *steps, (name, last) = self._steps
        for step, index in steps:
            holder = getattr(holder, step)
            if index is not None:
                if index >= len(holder):
                    return False
                holder = holder[index]
        if last is None and not self.is_array:
            old = getattr(holder, name)
            before = repr(old)
            setattr(holder, name, new := change(old))
            return repr(new) != before
        values = getattr(holder, name)
        changed = False
        for index in range(len(values)) if last is None else [last] * (last < len(values)):
            old = values[index].item() if hasattr(values[index], 'item') else values[index]
            before = repr(old)
            values[index] = new = change(old)
            changed |= repr(new) != before
        return changed


def _type_name(message_class: Any) -> str:
    package, _, _ = message_class.__module__.partition('.')
    return f'{package}/{message_class.__name__}'


@cache
def _class(kind: str) -> Any:
    """Return the class of a type; None: it is a value."""
    found = _STRUCTURE.fullmatch(kind)
    # Fields of messages are messages; those of services and actions too.
    return getattr(importlib.import_module(f'{found[1]}.msg'), found[2]) if found else None
