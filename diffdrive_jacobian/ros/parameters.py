"""The parameters of a node declared to rclpy, and their changes: see `parameters.declaration`."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from diffdrive_jacobian.parameters.declaration import (
    NodeParameters,
    ParameterError,
    Specification,
    as_declared,
    changed,
    default_of,
    from_ros,
    specifications,
)

P = TypeVar('P', bound=NodeParameters)


def descriptor(specification: Specification, default: Any) -> ParameterDescriptor:
    """Write a specification as the descriptor that ROS tools show."""
    constraint = specification.constraint or specification.allowed
    made = ParameterDescriptor(
        description=specification.description,
        read_only=specification.read_only,
        additional_constraints=f'must be {constraint}' if constraint else '',
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
                descriptor(specification, default_of(parameters, field)),
            )
            for name, (field, specification) in specifications(parameters).items()
        ],
        ignore_override=True,
    )
    return initial


def accept_integers(parameters: type[NodeParameters], changes: list[Parameter]) -> list[Parameter]:
    """Turn integers into doubles where doubles are declared: the callback before parameters are set."""
    return [
        Parameter(change.name, value=as_declared(parameters, change.name, change.value))
        if change.type_ == Parameter.Type.INTEGER
        else change
        for change in changes
    ]


def judge(parameters: NodeParameters, changes: Iterable[Parameter]) -> SetParametersResult:
    """Say whether changes lead to a valid set: the callback while parameters are set."""
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
