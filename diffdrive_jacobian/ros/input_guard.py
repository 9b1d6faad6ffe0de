"""Guards for the two inputs that rclpy parses itself: parameter requests and /clock.

rclpy lets an exception of its own parser out of the callback, which ends the node: a parameter value of
an unknown type, and a clock message with a negative time. Both are refused here before rclpy sees them,
with a throttled warning. Everything else is passed on as it is, and what other callbacks raise is not
caught.

The names of rclpy used for this: `Node.services`, `Service.srv_type` and `Service.callback`;
`Node._time_source`, `TimeSource.clock_callback` and `TimeSource._clock_sub`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.messages.conversion import MessageError, from_time
from diffdrive_jacobian.text import printable

THROTTLE = 2.0
"""Shortest time between two log lines about the same kind of input (s)."""
_TYPES = frozenset(member.value for member in Parameter.Type)


def guard_inputs(node: Node) -> None:
    """Make a node survive parameter requests and clock messages that rclpy cannot parse.

    The guard of /clock also holds when `use_sim_time` is switched on later.
    """
    _guard_clock(node)
    for service in node.services:
        if service.srv_type is SetParameters:
            service.callback = _guarded_set_parameters(node, service.callback)
        elif service.srv_type is SetParametersAtomically:
            service.callback = _guarded_set_parameters_atomically(node, service.callback)


def _guard_clock(node: Node) -> None:
    source = node._time_source
    accept, log = source.clock_callback, node.get_logger()

    def on_clock(message: Clock) -> None:
        try:
            from_time(message.clock)
        except MessageError as error:
            log.warning(f'/clock dropped: {error}', throttle_duration_sec=THROTTLE)
            return
        accept(message)

    source.clock_callback = on_clock
    if source._clock_sub is not None:
        source._clock_sub.callback = on_clock


def _guarded_set_parameters(
    node: Node, accept: Callable[[Any, Any], Any]
) -> Callable[[SetParameters.Request, SetParameters.Response], SetParameters.Response]:
    log = node.get_logger()

    def on_request(
        request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        results = [_refusal(parameter) for parameter in request.parameters]
        refusal = next((result for result in results if result is not None), None)
        if refusal is None:
            return accept(request, response)
        log.warning(f'parameter request refused: {refusal.reason}', throttle_duration_sec=THROTTLE)
        request.parameters = [
            parameter
            for parameter, result in zip(request.parameters, results, strict=True)
            if result is None
        ]
        accepted = iter(accept(request, response).results)
        response.results = [next(accepted) if result is None else result for result in results]
        return response

    return on_request


def _guarded_set_parameters_atomically(
    node: Node, accept: Callable[[Any, Any], Any]
) -> Callable[
    [SetParametersAtomically.Request, SetParametersAtomically.Response],
    SetParametersAtomically.Response,
]:
    log = node.get_logger()

    def on_request(
        request: SetParametersAtomically.Request, response: SetParametersAtomically.Response
    ) -> SetParametersAtomically.Response:
        for parameter in request.parameters:
            refusal = _refusal(parameter)
            if refusal is not None:
                log.warning(
                    f'parameter request refused: {refusal.reason}', throttle_duration_sec=THROTTLE
                )
                response.result = refusal
                return response
        return accept(request, response)

    return on_request


def _refusal(parameter: ParameterMessage) -> SetParametersResult | None:
    """Return why rclpy cannot handle a parameter of a request; None: it can."""
    if parameter.value.type not in _TYPES:
        return SetParametersResult(
            successful=False,
            reason=f"parameter '{printable(parameter.name)}' must have a type in 0 to {max(_TYPES)}, "
            f'got type {parameter.value.type}',
        )
    if not parameter.name:
        # rclpy does not notice that such a parameter is not declared, and sets it.
        return SetParametersResult(successful=False, reason='a parameter must have a name, got none')
    return None
