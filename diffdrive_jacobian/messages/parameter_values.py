"""Values of parameters in messages of rcl_interfaces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from diffdrive_jacobian.messages.conversion import MessageError


def _list(values: Any) -> list[Any]:
    return [value.item() if hasattr(value, 'item') else value for value in values]


def _bytes(values: Any) -> list[bytes]:
    return [value if isinstance(value, bytes) else bytes([int(value) & 0xFF]) for value in values]


# By the constants of rcl_interfaces/msg/ParameterType.
_READERS: dict[int, Callable[[Any], Any]] = {
    0: lambda value: None,
    1: lambda value: value.bool_value,
    2: lambda value: value.integer_value,
    3: lambda value: value.double_value,
    4: lambda value: value.string_value,
    5: lambda value: _bytes(value.byte_array_value),
    6: lambda value: _list(value.bool_array_value),
    7: lambda value: _list(value.integer_array_value),
    8: lambda value: _list(value.double_array_value),
    9: lambda value: _list(value.string_array_value),
}


def parameter_value(message: Any) -> Any:
    """Return the value in a ParameterValue message; None: it is not set.

    Raises:
        MessageError: Its type is unknown.
    """
    if message.type not in _READERS:
        raise MessageError(f'the type of a parameter must be 0 to {max(_READERS)}, got {message.type}')
    return _READERS[message.type](message)


def changed_parameters(event: Any) -> dict[str, Any]:
    """Return the new values in a ParameterEvent message.

    Raises:
        MessageError: The type of a value is unknown.
    """
    changes = [*event.new_parameters, *event.changed_parameters]
    return {one.name: parameter_value(one.value) for one in changes}
