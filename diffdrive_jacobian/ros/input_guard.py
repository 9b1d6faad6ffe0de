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

"""Guards for inputs that rclpy and rcl parse themselves: parameter requests, type hashes and /clock.

A parameter value of an unknown type or a clock message with a negative time raises an exception in
rclpy, which ends the node. A malformed type hash, which can be of any length, is written in full into
the log by rcl. They are refused before rclpy receives them, with a throttled warning. Other inputs are
passed on unchanged, and exceptions of other callbacks are not caught.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from type_description_interfaces.srv import GetTypeDescription

from diffdrive_jacobian.messages.conversion import MessageError, from_time
from diffdrive_jacobian.ros.rclpy_internals import wrap_clock_callback, wrap_service_callback
from diffdrive_jacobian.text import printable

THROTTLE = 2.0
"""Shortest time between two log lines about one kind of input (s)."""
_TYPE_HASH = re.compile(r'RIHS01_[0-9a-fA-F]{64}')
_TYPES = frozenset(member.value for member in Parameter.Type)


def guard_inputs(node: Node) -> None:
    """Refuse parameter requests, type hashes and clock messages that rclpy or rcl cannot parse.

    /clock is also guarded when `use_sim_time` becomes true later.
    """
    # Each guard takes the node and the function that it guards before the arguments of that function.
    wrap_clock_callback(node, partial(partial, _on_clock, node))
    for service, guard in (
        (SetParameters, _on_set_parameters),
        (SetParametersAtomically, _on_set_parameters_atomically),
        (GetTypeDescription, _on_get_type_description),
    ):
        wrap_service_callback(node, service, partial(partial, guard, node))


def _on_clock(node: Node, accept: Callable[[Clock], None], message: Clock) -> None:
    try:
        from_time(message.clock.sec, message.clock.nanosec)
    except MessageError as error:
        node.get_logger().warning(f'/clock dropped: {error}', throttle_duration_sec=THROTTLE)
        return
    accept(message)


def _on_set_parameters(
    node: Node, accept: Callable[[Any, Any], Any], request: Any, response: Any
) -> Any:
    refusals = [_refusal(parameter) for parameter in request.parameters]
    if not any(refusals):
        return accept(request, response)
    _warn(node, refusals)
    pairs = zip(request.parameters, refusals, strict=True)
    request.parameters = [parameter for parameter, refusal in pairs if not refusal]
    accepted = iter(accept(request, response).results)
    response.results = [_refused(refusal) if refusal else next(accepted) for refusal in refusals]
    return response


def _on_set_parameters_atomically(
    node: Node, accept: Callable[[Any, Any], Any], request: Any, response: Any
) -> Any:
    refusals = [_refusal(parameter) for parameter in request.parameters]
    if not any(refusals):
        return accept(request, response)
    response.result = _refused(_warn(node, refusals))
    return response


def _on_get_type_description(
    node: Node, accept: Callable[[Any, Any], Any], request: Any, response: Any
) -> Any:
    if _TYPE_HASH.fullmatch(request.type_hash):
        return accept(request, response)
    response.successful = False
    # The hash may have any length, so it is not repeated.
    response.failure_reason = (
        'type_hash must be RIHS01_ and 64 hexadecimal digits, got '
        f'{len(request.type_hash)} other characters'
    )
    node.get_logger().warning(
        f'type description request refused: {response.failure_reason}', throttle_duration_sec=THROTTLE
    )
    return response


def _refusal(parameter: ParameterMessage) -> str:
    """Return why rclpy cannot handle a parameter; '': it can."""
    if parameter.value.type not in _TYPES:
        return (
            f"parameter '{printable(parameter.name)}' must have a type in 0 to {max(_TYPES)}, "
            f'got type {parameter.value.type}'
        )
    # rclpy would set it, although it is not declared.
    return '' if parameter.name else 'a parameter must have a name, got none'


def _warn(node: Node, refusals: list[str]) -> str:
    """Log the first refusal, and return it."""
    first = next(filter(None, refusals))
    node.get_logger().warning(f'parameter request refused: {first}', throttle_duration_sec=THROTTLE)
    return first


def _refused(why: str) -> SetParametersResult:
    return SetParametersResult(successful=False, reason=why)
