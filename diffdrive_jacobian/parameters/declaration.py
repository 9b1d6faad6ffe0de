"""ROS parameters declared once, as a frozen dataclass per node.

    @dataclass(frozen=True, kw_only=True, slots=True)
    class Parameters(NodeParameters):
        kp: float = parameter(3.0, 'Gain on the heading error [1/s].', above=0.0)

The dataclass defines name, type, default, description, unit and range of each parameter. The descriptors
that `ros2 param describe` shows are derived from it. It validates its values when it is created. A
`ParameterizedNode` has one instance, and replaces it when parameters change.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.numerics import checks
from diffdrive_jacobian.text import printable

MAX_LENGTH = 256
"""Largest length of a string parameter (characters)."""
NOT_EMPTY = f'not empty and at most {MAX_LENGTH} characters'


class ParameterError(DiffdriveError, ValueError):
    """Invalid parameters. The message names the parameter, its value and its range."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Specification:
    """Properties of a parameter other than its type and its default."""

    description: str
    """One sentence with the unit in brackets."""
    name: str | None = None
    """ROS name, if it differs from the name of the field (`linear.x.max_velocity`)."""
    low: float | None = None
    """Smallest value allowed."""
    high: float | None = None
    """Largest value allowed."""
    above: float | None = None
    """Lower bound that is itself not allowed."""
    choices: Collection[str] = ()
    """The strings allowed."""
    constraint: str = ''
    """Text for the descriptor instead of the list of choices, where these are searched for."""
    nan_is_none: bool = False
    """Whether NaN is allowed and means "none". Ranges of ROS reject NaN, so its descriptor has none."""
    read_only: bool = False
    """Whether the parameter cannot change while the node runs."""

    @property
    def allowed(self) -> str:
        """The values allowed, in words."""
        words = []
        if self.choices:
            words.append(checks.choices(self.choices))
        if self.low is not None and self.high is not None:
            words.append(checks.interval(self.low, self.high, self.above))
        if self.nan_is_none:
            words.append('or .nan for none')
        return ' '.join(words)

    @property
    def range(self) -> tuple[float, float] | None:
        """Range in the descriptor. None: there is none, as where it would reject NaN."""
        low = self.low if self.above is None else self.above
        if low is None or self.high in (None, math.inf) or self.nan_is_none:
            return None
        assert self.high is not None
        return low, self.high

    def permits(self, value: Any) -> bool:
        """Return whether a value of the right type is allowed."""
        if self.choices:
            return value in self.choices
        if isinstance(value, str):
            return 0 < len(value) <= MAX_LENGTH
        if isinstance(value, float) and math.isnan(value):
            return self.nan_is_none
        if self.low is None or self.high is None:
            return True
        return checks.inside(value, self.low, self.high, self.above)


def parameter(
    default: Any,
    description: str,
    *,
    bounds: tuple[float, float] | None = None,
    above: float | None = None,
    **others: Any,
) -> Any:
    """Declare a field of a `NodeParameters` class.

    Args:
        default: Default value; bool, int, float or str.
        description: As in `Specification`, as the other arguments.
        bounds: `low` and `high`.
        above: Lower bound that is itself not allowed, besides `bounds`.
        others: Further fields of the `Specification`.
    """
    low, high = bounds or ((None, None) if above is None else (-math.inf, math.inf))
    specification = Specification(description=description, low=low, high=high, above=above, **others)
    return dataclasses.field(default=default, metadata={'parameter': specification})


P = TypeVar('P', bound='NodeParameters')


@dataclass(frozen=True, kw_only=True, slots=True)
class NodeParameters:
    """Base class of the parameters of a node. Every instance is valid.

    Raises:
        ParameterError: A value has the wrong type or is out of range, or values contradict each other.
    """

    def __post_init__(self) -> None:
        """Validate every value, then all together."""
        for name, (field, specification) in specifications(type(self)).items():
            value, wanted = getattr(self, field), type(default_of(type(self), field))
            if type(value) is not wanted:
                raise ParameterError(
                    f"parameter '{name}' must be {_TYPE_NAMES[wanted]}, got {_got(value)}"
                )
            if not specification.permits(value):
                raise ParameterError(
                    f"parameter '{name}' must be {specification.allowed or NOT_EMPTY}, got {_got(value)}"
                )
        self.check()

    def check(self) -> None:
        """Raise ParameterError if values contradict each other. For subclasses."""

    @classmethod
    def extended(cls: type[P], values: Mapping[str, Any]) -> type[P]:
        """Return the class with the parameters that others with these values, by ROS name, need."""
        return cls


def _got(value: object) -> str:
    """Return a value for an error message, with limited length."""
    if not isinstance(value, str):
        return printable(repr(value))
    length = f' ({len(value)} characters)' if len(value) > MAX_LENGTH else ''
    return f"'{printable(value)}'{length}"


_TYPE_NAMES = {
    bool: 'a bool (true or false)',
    int: 'an integer',
    float: 'a double (as 1.0)',
    str: 'a string',
}


def specifications(parameters: type[NodeParameters]) -> dict[str, tuple[str, Specification]]:
    """Map each ROS name to its field and its specification."""
    found = {}
    for field in dataclasses.fields(parameters):
        specification: Specification = field.metadata['parameter']
        found[specification.name or field.name] = (field.name, specification)
    return found


def default_of(parameters: type[NodeParameters], field: str) -> Any:
    """Return the default value of a field."""
    return parameters.__dataclass_fields__[field].default


def as_declared(parameters: type[NodeParameters], name: str, value: Any) -> Any:
    """Return a value, converted to a double if it is an integer for a double (`-p kp:=1`)."""
    known = specifications(parameters)
    if name in known and type(value) is int and type(default_of(parameters, known[name][0])) is float:
        return float(value)
    return value


def from_ros(parameters: type[P], values: Mapping[str, Any]) -> P:
    """Return the parameters with values by their ROS names. Unknown names are ignored.

    Raises:
        ParameterError: The values are invalid.
    """
    parameters = parameters.extended(values)
    known = specifications(parameters)
    given = {name: as_declared(parameters, name, value) for name, value in values.items()}
    return parameters(**{known[name][0]: value for name, value in given.items() if name in known})


def changed(parameters: P, values: Mapping[str, Any]) -> P:
    """Return the parameters with new values by their ROS names. Unknown names are ignored.

    It is the same object if no value applies.

    Raises:
        ParameterError: The new values are invalid.
    """
    before = ros_values(parameters)
    return (
        from_ros(type(parameters), {**before, **values}) if before.keys() & values.keys() else parameters
    )


def ros_values(parameters: NodeParameters) -> dict[str, Any]:
    """Return the values of parameters by their ROS names."""
    known = specifications(type(parameters))
    return {name: getattr(parameters, field) for name, (field, _) in known.items()}
