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

"""Why rclpy cannot create a publisher or a subscription, in words that say what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain

from rclpy.node import Node

from diffdrive_jacobian.messages.names import type_name
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros.rclpy_internals import parameter_overrides, reason
from diffdrive_jacobian.text import printable


@contextmanager
def whole_or_nothing(node: Node) -> Iterator[None]:
    """Destroy a node if it cannot be completed: half of one would stay in the graph."""
    try:
        yield
    except BaseException:
        node.destroy_node()
        raise


@contextmanager
def explaining_failure(node: Node, message: type, topic: str) -> Iterator[None]:
    """Explain why rclpy cannot create a publisher or a subscription of a node.

    Within a process Fast DDS refuses a topic of two types, which rclpy reports as "invalid allocator".
    `qos_overrides` may be a combination that does not exist (RuntimeError), or a number that does not
    fit the profile of the middleware (TypeError).

    Raises:
        ParameterError: The topic has another type in this process, or `qos_overrides` are invalid.
    """
    try:
        yield
    except (RuntimeError, TypeError, ValueError, OverflowError) as error:
        explanation = _explanation(node, message, node.resolve_topic_name(topic), error)
        if explanation is None:
            raise
        raise ParameterError(explanation) from error


def _explanation(node: Node, message: type, name: str, error: Exception) -> str | None:
    """Return why a topic cannot be created; None: the error is not about its type or its QoS."""
    wanted = type_name(message)
    others: list[str] = []
    if isinstance(error, RuntimeError):
        types = dict(node.get_topic_names_and_types()).get(name, [])
        others = [printable(other) for other in types if other != wanted]
    if others:
        used = {
            type_name(endpoint.msg_type)
            for endpoint in chain(node.publishers, node.subscriptions)
            if endpoint.topic_name == name
        }
        if own := sorted(used - {wanted}):
            return (
                f'two topics of this node have the name {name}, one with type {wanted}, the other with '
                f'{", ".join(own)}: remap them to different names'
            )
        stamped = 'Twist' in wanted and any('Twist' in other for other in others)
        hint = ' (is enable_stamped_cmd_vel the same for both?)' if stamped else ''
        return (
            f'{name} must have one type within a process: this node uses {wanted}, another one '
            f'{", ".join(others)}{hint}'
        )
    prefix = f'qos_overrides.{name}.'
    given = [
        f'{key.removeprefix(prefix)}: {override.value}'
        for key, override in sorted(parameter_overrides(node).items())
        if key.startswith(prefix)
    ]
    if not given:
        return None
    why = reason(error) if isinstance(error, RuntimeError) else 'a number is out of range'
    return f'the qos_overrides of {name} are invalid: {why} (got {printable(", ".join(given))})'
