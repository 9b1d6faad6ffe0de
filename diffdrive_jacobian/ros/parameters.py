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

"""Declaration of the parameters of a node in rclpy, and a report of those that no node declares."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import TypeVar
from weakref import WeakKeyDictionary

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
)
from rclpy.context import Context
from rclpy.node import Node

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.declaration import (
    NodeParameters,
    Parameter,
    ParameterError,
)
from diffdrive_jacobian.parameters.file import is_shared, sections
from diffdrive_jacobian.ros.rclpy_internals import (
    PARAMETERS_OF_RCLPY,
    declared_parameters,
    parameter_overrides,
)

P = TypeVar('P', bound=NodeParameters)


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return the descriptor of a parameter, which `ros2 param describe` shows."""
    constraint = parameter.constraint or parameter.allowed
    result = ParameterDescriptor(
        description=parameter.description,
        read_only=parameter.read_only,
        additional_constraints=f'must be {constraint}' if constraint else '',
    )
    if parameter.limits is None:
        return result
    low, high = parameter.limits
    if isinstance(parameter.default, float):
        result.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    else:
        result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return result


def declare(node: Node, defaults: P) -> P:
    """Declare all parameters of a node with the values that the user gave, and return them.

    Raises:
        ParameterError: The values are invalid. No parameter is declared.
    """
    overrides = parameter_overrides(node)
    initial = defaults.at_start({name: given.value for name, given in overrides.items()})
    _declare(node, initial, initial.declared())
    return initial


def with_overrides(node: Node, before: P, after: P) -> P:
    """Return parameters with the values that the user gave for those that were not there before.

    An invalid value is ignored, with a warning.
    """
    overrides = parameter_overrides(node)
    for name in sorted(_new(before, after) & overrides.keys()):
        try:
            after = after.changed({name: overrides[name].value})
        except ParameterError as error:
            node.get_logger().warning(f'{error}; the default is used')
    return after


def declare_new(node: Node, before: NodeParameters, after: NodeParameters) -> None:
    """Declare the parameters that a change of others has added."""
    _declare(node, after, _new(before, after))


def _new(before: NodeParameters, after: NodeParameters) -> set[str]:
    return after.declared().keys() - before.declared().keys()


def _declare(node: Node, parameters: NodeParameters, names: Iterable[str]) -> None:
    known, values = parameters.declared(), parameters.by_name()
    declared = [(name, values[name], descriptor(known[name])) for name in names]
    node.declare_parameters('', declared, ignore_override=True)


def _program(node: Node) -> str:
    """Return the name of the program that runs a node of this class."""
    modules = [one.__module__ for one in type(node).__mro__]
    package = __name__.partition('.')[0]
    ours = [one for one in modules if one.startswith(f'{package}.nodes.')]
    return ours[0].rpartition('.')[2] if ours else str(node.get_name())


_arguments: WeakKeyDictionary[Context, list[tuple[str, str]]] = WeakKeyDictionary()
"""The ROS arguments of contexts, each with the one after it."""


def use_arguments(context: Context, arguments: Sequence[str]) -> None:
    """Note the ROS arguments of a context, for `report_unknown`."""
    _arguments[context] = [*pairwise(arguments)]


def _given(context: Context) -> set[str]:
    """Return the names of the parameters that were given by `-p`, as `NODE:NAME:=VALUE`, too."""
    pairs = _arguments.get(context, ())
    texts = [text for flag, text in pairs if flag in ('-p', '--param')]
    return {text.partition(':=')[0].rpartition(':')[2] for text in texts}


def _shared(context: Context) -> set[str]:
    """Return the names of the parameters that files give to nodes of any name, as under `/**`."""
    found: set[str] = set()
    for path in (text for flag, text in _arguments.get(context, ()) if flag == '--params-file'):
        # What is wrong for rcl is an error before.
        with suppress(UserError):
            found.update(*(values for name, values in sections(path) if is_shared(name)))
    return found


def report_unknown(nodes: Sequence[Node], others: Iterable[Node] = ()) -> None:
    """Report each parameter that the user gave and that no node of this process declares.

    The nodes of a process share its command line, so one of them must declare the parameter. One that is
    given by a file is logged. What a file gives to nodes of any name may be for other processes, unless
    it resembles a parameter that is declared.

    Args:
        nodes: The nodes of this package.
        others: Further nodes, which may declare it.

    Raises:
        ParameterError: One was given by `-p`.
    """
    declared = {name for node in (*nodes, *others) for name in declared_parameters(node)}
    unknown: dict[str, Node] = {}
    for node in nodes:
        for name in parameter_overrides(node).keys() - declared:
            unknown.setdefault(name, node)
    if not unknown:
        return
    # Slow to import.
    from diffdrive_jacobian.control.controllers import names_of_gains
    from diffdrive_jacobian.parameters.arguments import resembling
    from diffdrive_jacobian.parameters.nodes import NODE_PARAMETERS

    ours = {name for one in NODE_PARAMETERS for name in one.declared()}
    known = sorted(name for name in declared if not name.startswith(PARAMETERS_OF_RCLPY))
    programs = sorted({f'{_program(node)} --help' for node in nodes})
    shared = set().union(*(_shared(node.context) for node in nodes))
    given = set().union(*(_given(node.context) for node in nodes))
    for name, node in sorted(unknown.items()):
        close = resembling(name, known)
        if name in shared and (name in ours or not close):
            continue
        meant = ' or '.join(f"'{one}'" for one in close)
        hint = f'did you mean {meant}?' if close else f'see {" or ".join(programs)}'
        if name in given and name not in names_of_gains():
            raise ParameterError(f"no node of this program has the parameter '{name}'; {hint}")
        node.get_logger().warning(f"unknown parameter '{name}' is ignored; {hint}")
