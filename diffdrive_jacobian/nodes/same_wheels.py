"""Whether the nodes that follow wheel speeds have the wheels for which these are computed.

With other dimensions a robot drives at another speed than commanded, and nothing else shows it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.messages.names import is_named, node_of
from diffdrive_jacobian.parameters.wheels import WHEELS, different_wheels
from diffdrive_jacobian.ros.service_client import ServiceClient, ignore

PATIENCE = 5.0
"""Longest wait for an answer (s)."""
MOST = 4
"""Number of nodes that are asked."""


class SameWheels:
    """Asks the nodes that are subscribed to wheel speeds for their wheels, once."""

    def __init__(
        self, node: Node, speeds: Publisher, wheels: tuple[float, ...], report: Callable[[str], None]
    ) -> None:
        """Ask nobody yet.

        Args:
            node: The node that publishes the speeds.
            speeds: Their publisher.
            wheels: The values of its parameters WHEELS.
            report: Receives what differs, with the remedy.
        """
        self._node, self._speeds, self._wheels, self._report = node, speeds, wheels, report
        self._waiting: dict[str, ServiceClient] | None = None

    def advance(self) -> bool:
        """Ask whoever is there, to be called with each command. Return whether this is done."""
        if self._waiting is None:
            if not self._speeds.get_subscription_count():
                return False
            self._waiting = self._clients()
        for name, client in list(self._waiting.items()):
            if client.ready:
                del self._waiting[name]
                request = GetParameters.Request(names=[*WHEELS])
                client.call(request, partial(self._on_answer, name), ignore)
        return not self._waiting

    def _clients(self) -> dict[str, ServiceClient]:
        found = self._node.get_subscriptions_info_by_topic(self._speeds.topic_name)
        names = sorted({node_of(one) for one in found if is_named(one)})[:MOST]
        return {
            name: ServiceClient(self._node, GetParameters, f'{name}/get_parameters', patience=PATIENCE)
            for name in names
        }

    def _on_answer(self, name: str, response: Any) -> None:
        theirs = wheels_of(response)
        if theirs is not None and (found := different_wheels(self._wheels, name, theirs)):
            self._report(found)


def wheels_of(response: Any) -> tuple[float, ...] | None:
    """Return the wheels in the answer to a request for WHEELS. None: the node has none."""
    values = response.values
    if len(values) != len(WHEELS) or any(one.type != ParameterType.PARAMETER_DOUBLE for one in values):
        return None
    return tuple(float(one.double_value) for one in values)
