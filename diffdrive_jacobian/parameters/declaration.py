"""ROS parameters declared once, as a frozen dataclass per node.

    @dataclass(frozen=True, kw_only=True, slots=True)
    class Parameters(NodeParameters):
        kp: float = parameter(3.0, 'Gain on the heading error [1/s].', above=0.0)

The dataclass is the only place where name, type, default, description, unit and range stand. The
descriptors that `ros2 param describe` shows are made from it, and it validates itself: an object of
it is always a valid set. `ParameterizedNode` keeps one, and replaces it whole when parameters change.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from diffdrive_jacobian.text import printable

MAX_LENGTH = 256
"""Longest string that a parameter may be (characters)."""
NOT_EMPTY = f'not empty and at most {MAX_LENGTH} characters'


class ParameterError(ValueError):
    """A set of parameters that a node cannot run with; the message names parameter, value and range."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Specification:
    """What is known of one parameter beside its type and default."""

    name: str | None
    description: str
    low: float | None
    high: float | None
    above: float | None
    choices: Collection[str]
    constraint: str
    nan_is_none: bool
    read_only: bool

    @property
    def allowed(self) -> str:
        """Say in words what is allowed."""
        words = []
        if self.choices:
            words.append('one of ' + ', '.join(repr(choice) for choice in self.choices))
        if self.above is not None and self.high is not None:
            words.append(f'in ({self.above:g}, {self.high:g}]')
        elif self.low is not None and self.high is not None:
            words.append(f'in [{self.low:g}, {self.high:g}]')
        if self.nan_is_none:
            words.append('or .nan for none')
        return ' '.join(words)

    def permits(self, value: Any) -> bool:
        """Tell whether a value of the right type is allowed."""
        if self.choices:
            return value in self.choices
        if isinstance(value, str):
            return 0 < len(value) <= MAX_LENGTH
        if isinstance(value, float) and math.isnan(value):
            return self.nan_is_none
        return (
            (self.low is None or value >= self.low)
            and (self.high is None or value <= self.high)
            and (self.above is None or value > self.above)
        )


def parameter(
    default: Any,
    description: str,
    *,
    name: str | None = None,
    bounds: tuple[float, float] | None = None,
    above: float | None = None,
    choices: Collection[str] = (),
    constraint: str = '',
    nan_is_none: bool = False,
    read_only: bool = False,
) -> Any:
    """Declare a field of a `NodeParameters` class.

    Args:
        default: Default value; bool, int, float or str.
        description: One sentence with the unit in brackets.
        name: ROS name where it differs from the field's (`linear.x.max_velocity`).
        bounds: Smallest and largest value allowed.
        above: With `bounds`: the smallest value is itself not allowed, and stands here.
        choices: The strings allowed.
        constraint: Text for the descriptor instead of the list of choices, where these are searched for.
        nan_is_none: NaN is allowed and means: none. ROS ranges reject NaN, so the descriptor of such
            a parameter carries no range; the description and the validation do.
        read_only: Fixed once the node runs.
    """
    low, high = bounds if bounds else (None, None)
    specification = Specification(
        name=name,
        description=description,
        low=None if above is not None else low,
        high=high,
        above=above,
        choices=choices,
        constraint=constraint,
        nan_is_none=nan_is_none,
        read_only=read_only,
    )
    return dataclasses.field(default=default, metadata={'parameter': specification})


@dataclass(frozen=True, kw_only=True, slots=True)
class NodeParameters:
    """Base of the parameters of a node. An instance that exists is valid.

    Raises:
        ParameterError: A value has the wrong type or is out of range, or values contradict each other.
    """

    def __post_init__(self) -> None:
        """Validate every value, then all together."""
        for name, (field, specification) in specifications(type(self)).items():
            value, wanted = getattr(self, field), type(default_of(type(self), field))
            if type(value) is not wanted:
                raise ParameterError(
                    f"parameter '{name}' must be a {_TYPE_NAMES[wanted]}"
                    f'{_example(wanted)}, got {_got(value)}'
                )
            if not specification.permits(value):
                raise ParameterError(
                    f"parameter '{name}' must be {specification.allowed or NOT_EMPTY}, got {_got(value)}"
                )
        self.check()

    def check(self) -> None:
        """Reject values that contradict each other; overridden where some can."""


P = TypeVar('P', bound=NodeParameters)


def _got(value: object) -> str:
    """Return a value as it is quoted in an error message, of limited length."""
    if not isinstance(value, str):
        return printable(repr(value))
    length = f' ({len(value)} characters)' if len(value) > MAX_LENGTH else ''
    return f"'{printable(value)}'{length}"


_TYPE_NAMES = {bool: 'bool', int: 'integer', float: 'double', str: 'string'}


def _example(wanted: type) -> str:
    examples: dict[type, str] = {bool: ' (true or false)', float: ' (as 1.0)'}
    return examples.get(wanted, '')


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
    """Return a double for an integer, as `-p kp:=1` gives it."""
    known = specifications(parameters)
    if name in known and type(value) is int and type(default_of(parameters, known[name][0])) is float:
        return float(value)
    return value


def from_ros(parameters: type[P], values: Mapping[str, Any]) -> P:
    """Make the set that a node would have with values by their ROS names; others' are passed over.

    Raises:
        ParameterError: The set would not be valid.
    """
    known = specifications(parameters)
    return parameters(
        **{
            known[name][0]: as_declared(parameters, name, value)
            for name, value in values.items()
            if name in known
        }
    )


class Change(Protocol):
    """A new value of a parameter, as `rclpy.parameter.Parameter`."""

    @property
    def name(self) -> str:
        """ROS name."""

    @property
    def value(self) -> Any:
        """The value in Python."""


def changed(parameters: P, changes: Iterable[Change]) -> P:
    """Make the set that results from changes; parameters of others among them are passed over.

    Returns:
        The new set; the very same one if nothing among the changes is of it.

    Raises:
        ParameterError: The set would not be valid.
    """
    known = specifications(type(parameters))
    values = {known[change.name][0]: change.value for change in changes if change.name in known}
    return dataclasses.replace(parameters, **values) if values else parameters
