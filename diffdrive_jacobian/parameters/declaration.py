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

"""ROS parameters declared once, as a frozen dataclass per node.

    @dataclass(frozen=True, kw_only=True, slots=True)
    class Parameters(NodeParameters):
        kp: float = parameter(3.0, 'Gain on the heading error [1/s].', between(0.0, 100.0, above=0.0))

The dataclass defines name, type, default, description, unit and range of each parameter. The descriptors
that `ros2 param describe` shows are derived from it. It validates its values when it is created. A
`ParameterizedNode` has one instance, and replaces it when parameters change.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeVar

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.numerics.checks import Range, choices
from diffdrive_jacobian.text import printable

MAX_LENGTH = 256
"""Largest length of a string parameter (characters)."""
_TYPE_NAMES = {
    bool: 'a bool (true or false)',
    int: 'an integer',
    float: 'a double (as 1.0)',
    str: 'a string',
}


class ParameterError(DiffdriveError, ValueError):
    """Invalid parameters. The message names the parameter, its value and its range."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Parameter:
    """A parameter of a node."""

    name: str
    """ROS name, such as `linear.x.max_velocity`."""
    field: str
    """Name of its field, or of the attribute with its value."""
    default: Any
    """Default value; bool, int, float or str, which is its type."""
    description: str
    """One sentence with the unit in brackets."""
    within: Range | None = None
    """The numbers allowed; None: all."""
    choices: Collection[str] = ()
    """The strings allowed; empty: all up to MAX_LENGTH."""
    constraint: str = ''
    """Text for the descriptor instead of the list of choices, where these are searched for."""
    nan_is_none: bool = False
    """Whether NaN is allowed and means "none". Ranges of ROS reject NaN, so its descriptor has none."""
    read_only: bool = False
    """Whether it cannot change while the node runs."""

    @property
    def allowed(self) -> str:
        """The values allowed, in words."""
        words = [choices(self.choices)] if self.choices else []
        words += [str(self.within)] if self.within is not None else []
        return ' '.join([*words, *['or .nan for none'] * self.nan_is_none])

    @property
    def limits(self) -> tuple[float, float] | None:
        """The limits in the descriptor; None: there are none, as where they would reject NaN."""
        if self.within is None or self.within.high == math.inf or self.nan_is_none:
            return None
        low = self.within.low if self.within.above is None else self.within.above
        return low, self.within.high

    def converted(self, value: Any) -> Any:
        """Return a value, converted to a double if it is an integer for a double (`-p kp:=1`)."""
        return float(value) if type(value) is int and type(self.default) is float else value

    def check(self, value: Any) -> None:
        """Raise ParameterError if a value has another type or is not allowed."""
        if must_be := self._refusal(value):
            raise ParameterError(f"parameter '{self.name}' must be {must_be}, got {_got(value)}")

    def _refusal(self, value: Any) -> str:
        """Return what a value must be; '': it is allowed."""
        wanted = type(self.default)
        if type(value) is not wanted:
            return _TYPE_NAMES[wanted]
        if self.choices:
            return '' if value in self.choices else self.allowed
        if wanted is str:
            fits = 0 < len(value) <= MAX_LENGTH
            return '' if fits else f'not empty and at most {MAX_LENGTH} characters'
        if self.within is None or value in self.within or (self.nan_is_none and math.isnan(value)):
            return ''
        return self.allowed


def _got(value: object) -> str:
    """Return a value for an error message, with limited length."""
    if not isinstance(value, str):
        return printable(repr(value))
    length = f' ({len(value)} characters)' if len(value) > MAX_LENGTH else ''
    return f"'{printable(value)}'{length}"


def parameter(
    default: Any, description: str, within: Range | None = None, *, name: str = '', **others: Any
) -> Any:
    """Declare a field of a `NodeParameters` class.

    Args:
        default: As in `Parameter`, as the other arguments.
        description: One sentence with the unit in brackets.
        within: The numbers allowed.
        name: ROS name, if it differs from that of the field.
        others: Further fields of the `Parameter`.
    """
    declared = {'name': name, 'description': description, 'within': within, **others}
    return dataclasses.field(default=default, metadata={'parameter': declared})


P = TypeVar('P', bound='NodeParameters')


@dataclass(frozen=True, kw_only=True, slots=True)
class NodeParameters:
    """Base class of the parameters of a node. Every instance is valid.

    A subclass calls `NodeParameters.changed(self, ...)`: with slots `super()` does not work.

    Raises:
        ParameterError: A value has the wrong type or is out of range, or values contradict each other.
    """

    def __post_init__(self) -> None:
        """Validate every value, then all together."""
        for one in self.declared().values():
            one.check(getattr(self, one.field))
        self.check()

    def check(self) -> None:
        """Raise ParameterError if values contradict each other. For subclasses."""

    def declared(self) -> dict[str, Parameter]:
        """Return the parameters by their ROS names."""
        kind: Any = type(self)
        return _declared_fields(kind)

    def by_name(self) -> dict[str, Any]:
        """Return the values by their ROS names."""
        return {name: getattr(self, one.field) for name, one in self.declared().items()}

    def changed(self: P, values: Mapping[str, Any]) -> P:
        """Return the parameters with new values by their ROS names. Unknown names are ignored.

        It is the same object if no value applies.

        Raises:
            ParameterError: The new values are invalid.
        """
        known = self.declared()
        given = {
            known[name].field: known[name].converted(value)
            for name, value in values.items()
            if name in known
        }
        return replace(self, **given) if given else self

    def at_start(self: P, values: Mapping[str, Any]) -> P:
        """Return these defaults with the values that the user gave, as `changed`."""
        return self.changed(values)


@cache
def _declared_fields(kind: Any) -> dict[str, Parameter]:
    found = {}
    for field in dataclasses.fields(kind):
        if 'parameter' in field.metadata:
            declared = {'field': field.name, 'default': field.default, **field.metadata['parameter']}
            declared['name'] = declared['name'] or field.name
            found[declared['name']] = Parameter(**declared)
    return found
