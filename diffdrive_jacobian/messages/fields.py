"""The fields of message objects, by their paths: `pose.pose.position.x`, `velocity[0]`, `len(goals)`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

from diffdrive_jacobian.messages.structure import (
    COUNT,
    Array,
    FieldType,
    Number,
    Sequence,
    Structure,
    Text,
    structure,
)

LENGTH = re.compile(r'len\(([\w.]+)\)')
_STEP = re.compile(r'([A-Za-z]\w*)(?:\[(\d+)\])?')


def walk(
    kind: FieldType, value: Any, path: str = '', *, whole: Callable[[FieldType], bool] = lambda _: False
) -> Iterator[tuple[str, FieldType, Any]]:
    """Yield path, type and value of each field of a message.

    An array or a sequence of numbers or strings is one value. One of messages is its length,
    `len(path)`, and then the fields of its elements, `path[0].x`.

    Args:
        kind: Type of the message.
        value: The message.
        path: What precedes the paths.
        whole: Says which other types are one value, too.
    """
    match kind:
        case _ if whole(kind):
            yield path, kind, value
        case Structure() if value is not None:
            for name, field in kind.fields:
                inner = f'{path}.{name}' if path else name
                yield from walk(field, getattr(value, name), inner, whole=whole)
        case Array(Structure() as element) | Sequence(Structure() as element):
            yield f'len({path})', COUNT, len(value)
            for index, one in enumerate(value):
                yield from walk(element, one, f'{path}[{index}]', whole=whole)
        case _:
            yield path, kind, value


def plain(value: Any) -> Any:
    """Return an array or a sequence of numbers or strings as a tuple of Python's; others as they are."""
    if isinstance(value, (str, bytes, int, float)):
        return value
    return tuple(value.tolist() if hasattr(value, 'tolist') else value)


def is_stamp(kind: FieldType) -> bool:
    """Whether a type is a time or a duration, with `sec` and `nanosec`."""
    return isinstance(kind, Structure) and kind.name in (
        'builtin_interfaces/Time',
        'builtin_interfaces/Duration',
    )


def is_identifier(kind: FieldType) -> bool:
    """Whether a type is a UUID, with the bytes `uuid`."""
    return isinstance(kind, Structure) and kind.name == 'unique_identifier_msgs/UUID'


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
        kind: FieldType = structure(message_class)
        for step in path.split('.'):
            matched = _STEP.fullmatch(step)
            fields = dict(kind.fields) if isinstance(kind, Structure) else {}
            if matched is None or matched[1] not in fields:
                nested = isinstance(kind, (Array, Sequence))
                there = ', '.join(fields) or ('elements [0], [1], ...' if nested else 'none')
                raise ValueError(
                    f"field '{path}' does not exist: {kind} has no {step!r}; its fields: {there}"
                )
            kind = fields[matched[1]]
            index = None if matched[2] is None else int(matched[2])
            if index is not None:
                if not isinstance(kind, (Array, Sequence)):
                    raise ValueError(f"field '{path}' does not exist: '{matched[1]}' has a single value")
                if isinstance(kind, Array) and index >= kind.count:
                    raise ValueError(
                        f"field '{path}' does not exist: '{matched[1]}' has {kind.count} elements"
                    )
                kind = kind.element
            self._steps.append((matched[1], index))
        self.path = path
        self.is_array = isinstance(kind, (Array, Sequence))
        """Whether the field is an array or a sequence with all its elements."""
        self.type = kind.element if isinstance(kind, (Array, Sequence)) else kind
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


def field_value(message: Any, field: str) -> Any:
    """Return a field of a message object, as `cdr.Reader` returns it."""
    length = LENGTH.fullmatch(field)
    if length:
        return len(_value(message, length[1]))
    before, sequence, after = field.partition('[].')
    if sequence:
        return tuple(plain(_value(one, after)) for one in _value(message, before))
    return plain(_value(message, field))


def _value(message: Any, path: str) -> Any:
    for name in path.split('.'):
        message = getattr(message, name)
    return message


def check_readable(kind: Structure, field: str) -> None:
    """Raise ValueError unless `cdr.Reader` can return this field."""
    length = LENGTH.fullmatch(field)
    found: FieldType = kind
    steps = (length[1] if length else field).split('.')
    for step in steps:
        name = step.removesuffix('[]')
        inner = dict(found.fields) if isinstance(found, Structure) else {}
        if name not in inner:
            raise ValueError(
                f"a field of {kind.short_name} must be a path to one of its fields, got '{field}'; "
                f'{name!r} is none of {list(inner)}'
            )
        found = inner[name]
        if step != name and isinstance(found, Sequence):
            found = found.element
    if length:
        readable = isinstance(found, Sequence)
    else:
        simple = found.element if isinstance(found, (Array, Sequence)) else found
        readable = isinstance(simple, (Number, Text)) and field.count('[]') <= 1
    if not readable:
        raise ValueError(
            f'a field of {kind.short_name} must be a number, a string, an array or sequence of them, '
            f"such a field of each element of one sequence ('goals[].pose'), or len() of a sequence, "
            f"got '{field}'"
        )
