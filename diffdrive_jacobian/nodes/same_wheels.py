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

"""Whether the nodes that follow wheel speeds have the wheels for which these are computed.

With other dimensions a robot drives at another speed than commanded, and nothing else shows it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.messages.names import is_named, node_of
from diffdrive_jacobian.parameters.wheels import WHEELS, Dimensions, different_wheels
from diffdrive_jacobian.ros.service_client import ServiceClient, is_possible

PATIENCE = 5.0
"""Longest wait for an answer (s)."""
TRIES = 50
"""Number of commands after which nobody is looked for any more."""
MOST = 4
"""Number of nodes that are asked."""


class SameWheels:
    """Asks the nodes that are subscribed to wheel speeds for their wheels, once."""

    def __init__(
        self,
        node: Node,
        speeds: Publisher,
        wheels: Callable[[], Dimensions],
        report: Callable[[str], None],
    ) -> None:
        """Ask nobody yet.

        Args:
            node: The node that publishes the speeds.
            speeds: Their publisher.
            wheels: Returns the dimensions for which they are computed.
            report: Receives what differs.
        """
        self._node, self._speeds, self._wheels, self._report = node, speeds, wheels, report
        self._clients: dict[str, ServiceClient] = {}
        self._tries = 0
        self._asked: set[str] = set()
        self._answered: set[str] = set()

    def advance(self) -> bool:
        """Ask whoever is there, to be called with each command. Return whether this is done."""
        if not self._clients and self._speeds.get_subscription_count():
            # The name of a node may be discovered later than its subscription.
            self._clients, self._tries = self._find(), self._tries + 1
        for name, client in self._clients.items():
            if client.ready and name not in self._asked:
                self._asked.add(name)
                request = GetParameters.Request(names=[*WHEELS])
                client.call(request, partial(self._on_answer, name), partial(self._on_end, name))
            client.advance()
        if not self._clients or self._answered < self._clients.keys():
            # A node that has no name that can be asked, as that of a command line tool.
            return not self._clients and self._tries >= TRIES
        for client in self._clients.values():
            client.destroy()
        return True

    def _find(self) -> dict[str, ServiceClient]:
        found = self._node.get_subscriptions_info_by_topic(self._speeds.topic_name)
        names = sorted({node_of(one) for one in found if is_named(one)})[:MOST]
        services = {name: f'{name}/get_parameters' for name in names}
        return {
            name: ServiceClient(self._node, GetParameters, service, patience=PATIENCE)
            for name, service in services.items()
            if is_possible(service)
        }

    def _on_answer(self, name: str, response: Any) -> None:
        self._on_end(name)
        theirs = wheels_of(response)
        if theirs is not None and (found := different_wheels(self._wheels(), name, theirs)):
            self._report(found)

    def _on_end(self, name: str, _: str = '') -> None:
        self._answered.add(name)


def wheels_of(response: Any) -> Dimensions | None:
    """Return the wheels in the answer to a request for WHEELS. None: the node has no valid ones."""
    values = response.values
    if len(values) != len(WHEELS) or any(one.type != ParameterType.PARAMETER_DOUBLE for one in values):
        return None
    numbers = [float(one.double_value) for one in values]
    found = Dimensions.of(numbers)
    # Of any node, and anything.
    return found if all(0.0 < one < math.inf for one in (*numbers, *found)) else None
