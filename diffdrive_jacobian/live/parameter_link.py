"""The parameters of one node: read once, followed by its parameter events, set by its service."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

from diffdrive_jacobian.live.settings import Range
from diffdrive_jacobian.recording.parameter_query import ParameterQuery
from diffdrive_jacobian.ros.service_client import ServiceClient, ignore
from diffdrive_jacobian.text import printable

PATIENCE = 3.0
"""Longest wait for the answer of a node (s)."""


class ParameterLink:
    """Reads and sets parameters of one node."""

    def __init__(self, node: Node, target: str) -> None:
        """Query the values.

        Args:
            node: The node that asks.
            target: Fully qualified name of the node that has the parameters.
        """
        self.target = target
        self.values: dict[str, Any] = {}
        """Values by name, as far as they are known."""
        self.ranges: dict[str, Range] = {}
        """Ranges of doubles by name, as far as their descriptors have one."""
        self._known: set[str] = set()
        self._undescribed: list[str] = []
        self._query = ParameterQuery(node, target, self.changed, ignore)
        client = partial(ServiceClient, node, patience=PATIENCE, server=printable(target))
        self._describe = client(DescribeParameters, f'{target}/describe_parameters')
        self._set = client(SetParameters, f'{target}/set_parameters')

    def advance(self) -> None:
        """Ask, and check for answers that are late; to be called often."""
        self._query.advance()
        if self._undescribed and self._describe.ready:
            names, self._undescribed = self._undescribed, []
            request = DescribeParameters.Request(names=names)
            self._describe.call(request, partial(self._on_descriptors, names), ignore)
        self._describe.advance()
        self._set.advance()

    def destroy(self) -> None:
        """Destroy the clients. Who waits for an answer gets a refusal."""
        for client in (self._query, self._describe, self._set):
            client.destroy()

    def changed(self, values: Mapping[str, Any]) -> None:
        """Take values from the node itself or from a parameter event."""
        self.values.update(values)
        new = [name for name, value in values.items() if isinstance(value, float)]
        self._undescribed += [name for name in new if name not in self._known]
        self._known.update(new)

    def set(self, name: str, value: float | str | bool, on_refusal: Callable[[str], object]) -> None:
        """Set a parameter.

        Args:
            name: Name of the parameter.
            value: The value.
            on_refusal: Receives the reason if the node does not accept it.
        """

        def on_response(response: Any) -> None:
            result = next(iter(response.results), None)
            if result is None:
                on_refusal('its answer cannot be read')
            elif result.successful:
                self.values[name] = value
            else:
                on_refusal(printable(result.reason, 300))

        parameter = Parameter(name, value=value).to_parameter_msg()
        self._set.call(SetParameters.Request(parameters=[parameter]), on_response, on_refusal)

    def _on_descriptors(self, names: list[str], response: Any) -> None:
        # A node that lacks one of the parameters sends no descriptors at all.
        for name, descriptor in zip(names, response.descriptors, strict=False):
            for one in descriptor.floating_point_range[:1]:
                if -math.inf < one.from_value < one.to_value < math.inf:
                    self.ranges[name] = one.from_value, one.to_value
