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

"""Query of all parameters of any node, robust against invalid answers."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from diffdrive_jacobian.ros.service_client import ServiceClient

PATIENCE = 5.0
"""Longest time for each answer of a node (s)."""
MAX_PARAMETERS = 10_000
"""Largest number of parameters of a node that are recorded."""
MAX_TEXT = 1 << 20
"""Largest total size of the parameters of a node that are recorded (characters)."""
MAX_NAMED = 5
"""Largest number of missing parameters that a message lists."""


class ParameterQuery:
    """The parameters of one node, queried once.

    A node may declare parameters without a value. It lists them, and rclcpp answers a request that
    contains one of them without any values. If there are not as many values as names, each half of the
    names is therefore requested alone, and so on down to the single parameters without a value.
    """

    def __init__(
        self,
        node: Node,
        target: str,
        on_values: Callable[[dict[str, Any]], None],
        on_trouble: Callable[[str], None],
    ) -> None:
        """Create the clients. `advance` sends the requests when the services are available.

        Args:
            node: The node that sends the requests.
            target: Fully qualified name of the node that is to answer.
            on_values: Called once with the values by name that were received.
            on_trouble: Called at most once, before that, with a description of what is missing.
        """
        self._on_values = on_values
        self._on_trouble = on_trouble
        self._values: dict[str, Any] = {}
        self._missing: list[str] = []
        self._waiting: list[list[str]] = []
        self._size = 0
        self._asked = self._done = False
        self._clients: list[ServiceClient] = []
        try:
            for service_type, name in ((ListParameters, 'list'), (GetParameters, 'get')):
                service = f'{target}/{name}_parameters'
                self._clients.append(ServiceClient(node, service_type, service, patience=PATIENCE))
        except (RuntimeError, NameValidationException) as error:
            self._finish(f'its services cannot be called: {_short(error)}')

    def advance(self) -> None:
        """Send the request if the services are available, and end on a timeout; to be called often."""
        if self._done:
            self.destroy()
        elif not self._asked and all(client.ready for client in self._clients):
            self._asked = True
            self._clients[0].call(ListParameters.Request(), self._on_names, self._finish)
        for client in self._clients:
            client.advance()

    def destroy(self) -> None:
        """Destroy the clients; nothing is called any more."""
        self._done = True
        while self._clients:
            self._clients.pop().destroy()

    def _on_names(self, response: Any) -> None:
        names = list(dict.fromkeys(response.result.names))
        if len(names) > MAX_PARAMETERS:
            self._missing += names[MAX_PARAMETERS:]
            del names[MAX_PARAMETERS:]
        if names:
            self._waiting.append(names)
        self._ask()

    def _ask(self) -> None:
        if not self._waiting:
            self._finish('')
            return
        names = self._waiting.pop()
        request = GetParameters.Request(names=names)
        self._clients[1].call(request, partial(self._on_answer, names), self._finish)

    def _on_answer(self, names: list[str], response: Any) -> None:
        if len(response.values) == len(names):
            for name, value in zip(names, response.values, strict=True):
                self._keep(name, value)
        elif len(names) == 1:
            self._missing += names
        else:
            middle = len(names) // 2
            self._waiting += [names[middle:], names[:middle]]
        self._ask()

    def _keep(self, name: str, value: Any) -> None:
        try:
            if value.type == ParameterType.PARAMETER_NOT_SET:
                raise ValueError('it has no value')
            found = parameter_value_to_python(value)
            size = len(json.dumps({name: found}, default=list))
            if self._size + size > MAX_TEXT:
                raise ValueError('it is too large')
        # rclpy raises RuntimeError for an unknown type.
        except (RuntimeError, TypeError, ValueError):
            self._missing.append(name)
            return
        self._size += size
        self._values[name] = found

    def _finish(self, trouble: str) -> None:
        if self._done:
            return
        self._done = True
        self._missing += [name for names in self._waiting for name in names]
        self._waiting.clear()
        if self._missing:
            shown = ', '.join(_short(name) for name in self._missing[:MAX_NAMED])
            more = len(self._missing) - MAX_NAMED
            missing = f'{shown} and {more} more' if more > 0 else shown
            trouble = f'{trouble}; missing: {missing}' if trouble else f'no value of {missing}'
        if trouble:
            self._on_trouble(trouble)
        if self._values or not trouble:
            self._on_values(self._values)


def _short(text: object) -> str:
    """Return the beginning of an untrusted text, in printable characters."""
    line = str(text).split(', at /')[0]
    return ascii(line[:80])[1:-1] + ('...' if len(line) > 80 else '')
