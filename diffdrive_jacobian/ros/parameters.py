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
import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    # Not at run time: tools that need no ROS read parameters, too.
    from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
    from rclpy.node import Node
    from rclpy.parameter import Parameter

from diffdrive_jacobian.text import printable

MAX_LENGTH = 256
"""Longest string that a parameter may be (characters)."""
NOT_EMPTY = f'not empty and at most {MAX_LENGTH} characters'


class ParameterError(ValueError):
    """A set of parameters that a node cannot run with; the message names parameter, value and range."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Specification:
    """What is known of one parameter beside its type and default."""

    name: str | None
    description: str
    low: float | None
    high: float | None
    above: float | None
    choices: tuple[str, ...]
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
    choices: tuple[str, ...] = (),
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
        nan_is_none: NaN is allowed and means: none. ROS ranges reject NaN, so the descriptor of such
            a parameter carries no range; the description and the validation do.
        read_only: Fixed once the node runs.
    """
    low, high = bounds if bounds else (None, None)
    specification = _Specification(
        name=name,
        description=description,
        low=None if above is not None else low,
        high=high,
        above=above,
        choices=choices,
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
            value, wanted = getattr(self, field), type(_default(type(self), field))
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


def specifications(parameters: type[NodeParameters]) -> dict[str, tuple[str, _Specification]]:
    """Map each ROS name to its field and its specification."""
    found = {}
    for field in dataclasses.fields(parameters):
        specification: _Specification = field.metadata['parameter']
        found[specification.name or field.name] = (field.name, specification)
    return found


def _default(parameters: type[NodeParameters], field: str) -> Any:
    return parameters.__dataclass_fields__[field].default


def descriptor(specification: _Specification, default: Any) -> ParameterDescriptor:
    """Write a specification as the descriptor that ROS tools show."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    made = ParameterDescriptor(
        description=specification.description,
        read_only=specification.read_only,
        additional_constraints=f'must be {specification.allowed}' if specification.allowed else '',
    )
    low = specification.low if specification.above is None else specification.above
    if low is None or specification.high is None or specification.nan_is_none:
        return made
    if isinstance(default, float):
        made.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(specification.high))
        ]
    else:
        made.integer_range = [
            IntegerRange(from_value=int(low), to_value=int(specification.high), step=1)
        ]
    return made


def _as_declared(parameters: type[NodeParameters], name: str, value: Any) -> Any:
    """Take an integer for a double, as `-p kp:=1` gives it."""
    known = specifications(parameters)
    if name in known and type(value) is int and type(_default(parameters, known[name][0])) is float:
        return float(value)
    return value


def declare(node: Node, parameters: type[P]) -> P:
    """Declare all parameters of a node with the values that its user gave.

    Raises:
        ParameterError: These values are not a valid set. Nothing is declared then.
    """
    # rclpy has no public look at the overrides before a parameter is declared.
    overrides = node._parameter_overrides
    initial = from_ros(parameters, {name: given.value for name, given in overrides.items()})
    node.declare_parameters(
        '',
        [
            (
                name,
                getattr(initial, field),
                descriptor(specification, _default(parameters, field)),
            )
            for name, (field, specification) in specifications(parameters).items()
        ],
        ignore_override=True,
    )
    return initial


def from_ros(parameters: type[P], values: Mapping[str, Any]) -> P:
    """Make the set that a node would have with values by their ROS names; others' are passed over.

    Raises:
        ParameterError: The set would not be valid.
    """
    known = specifications(parameters)
    return parameters(
        **{
            known[name][0]: _as_declared(parameters, name, value)
            for name, value in values.items()
            if name in known
        }
    )


def accept_integers(parameters: type[NodeParameters], changes: list[Parameter]) -> list[Parameter]:
    """Turn integers into doubles where doubles are declared: the callback before parameters are set."""
    from rclpy.parameter import Parameter

    return [
        Parameter(change.name, value=_as_declared(parameters, change.name, change.value))
        if change.type_ == Parameter.Type.INTEGER
        else change
        for change in changes
    ]


def changed(parameters: P, changes: Iterable[Parameter]) -> P:
    """Make the set that results from changes; parameters of others among them are passed over.

    Returns:
        The new set; the very same one if nothing among the changes is of it.

    Raises:
        ParameterError: The set would not be valid.
    """
    known = specifications(type(parameters))
    values = {known[change.name][0]: change.value for change in changes if change.name in known}
    return dataclasses.replace(parameters, **values) if values else parameters


def judge(parameters: NodeParameters, changes: Iterable[Parameter]) -> SetParametersResult:
    """Say whether changes lead to a valid set: the callback while parameters are set."""
    from rcl_interfaces.msg import SetParametersResult

    try:
        changed(parameters, changes)
    except ParameterError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def report_unknown(nodes: Sequence[Node]) -> None:
    """Warn of parameters that the user gave and that no node of this process has.

    The nodes of one process share its command line, so what one of them has is not a mistake.
    """
    declared = {name for node in nodes for name in node._parameters}
    unknown: dict[str, Node] = {}
    for node in nodes:
        for name in set(node._parameter_overrides) - declared:
            unknown.setdefault(name, node)
    known = sorted(name for name in declared if not name.startswith(_OF_RCLPY))
    for name, node in sorted(unknown.items()):
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean '{close[0]}'?" if close else f'there are: {", ".join(known)}'
        node.get_logger().warning(f"unknown parameter '{name}' is ignored; {hint}")


_OF_RCLPY = ('qos_overrides.', 'start_type_description_service', 'use_sim_time')
