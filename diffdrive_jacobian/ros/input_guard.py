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
    wrap_clock_callback(node, partial(_guarded_clock, node))
    wrap_service_callback(node, SetParameters, partial(_guarded_set_parameters, node))
    wrap_service_callback(
        node, SetParametersAtomically, partial(_guarded_set_parameters_atomically, node)
    )
    wrap_service_callback(node, GetTypeDescription, partial(_guarded_get_type_description, node))


def _guarded_clock(node: Node, accept: Callable[[Clock], None]) -> Callable[[Clock], None]:
    log = node.get_logger()

    def on_clock(message: Clock) -> None:
        try:
            from_time(message.clock.sec, message.clock.nanosec)
        except MessageError as error:
            log.warning(f'/clock dropped: {error}', throttle_duration_sec=THROTTLE)
            return
        accept(message)

    return on_clock


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


def _guarded_get_type_description(
    node: Node, accept: Callable[[Any, Any], Any]
) -> Callable[[GetTypeDescription.Request, GetTypeDescription.Response], GetTypeDescription.Response]:
    log = node.get_logger()

    def on_request(
        request: GetTypeDescription.Request, response: GetTypeDescription.Response
    ) -> GetTypeDescription.Response:
        if _TYPE_HASH.fullmatch(request.type_hash):
            return accept(request, response)
        # The hash may have any length, so it is not repeated.
        response.failure_reason = (
            'type_hash must be RIHS01_ and 64 hexadecimal digits, got '
            f'{len(request.type_hash)} other characters'
        )
        log.warning(
            f'type description request refused: {response.failure_reason}',
            throttle_duration_sec=THROTTLE,
        )
        response.successful = False
        return response

    return on_request


def _refusal(parameter: ParameterMessage) -> SetParametersResult | None:
    """Return the result for a parameter that rclpy cannot handle; None: it can."""
    if parameter.value.type not in _TYPES:
        return SetParametersResult(
            successful=False,
            reason=f"parameter '{printable(parameter.name)}' must have a type in 0 to {max(_TYPES)}, "
            f'got type {parameter.value.type}',
        )
    if not parameter.name:
        # rclpy would set it, although it is not declared.
        return SetParametersResult(successful=False, reason='a parameter must have a name, got none')
    return None
