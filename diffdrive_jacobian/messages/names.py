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

"""Names of ROS: of nodes, of topics, and of types."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def full_name(namespace: str, name: str) -> str:
    """Return the fully qualified name of a node, topic or service, such as `/robot1/odom`."""
    return f'{namespace.rstrip("/")}/{name}'


def without_namespace(name: str, namespace: str) -> str:
    """Return a full name as seen from a namespace, with a slash; unchanged if it is not in it."""
    root = namespace.rstrip('/')
    return name[len(root) :] if name.startswith(f'{root}/') else name


def base_name(name: str) -> str:
    """Return a name without its namespace."""
    return name.rpartition('/')[2]


def namespace_of(name: str) -> str:
    """Return the namespace of a fully qualified name, such as `/` or `/robot1`."""
    return name.rpartition('/')[0] or '/'


def node_of(endpoint: Any) -> str:
    """Return the fully qualified name of the node of an endpoint, as the graph describes it."""
    return full_name(endpoint.node_namespace, endpoint.node_name)


def is_named(endpoint: Any) -> bool:
    """Return whether an endpoint belongs to a node with a known name that is not hidden.

    The name of a node may be discovered later than its topics; until then it begins with `_` as well.
    """
    return not endpoint.node_name.startswith('_')


def type_name(interface: type) -> str:
    """Return the name of a class of messages or services, such as `nav_msgs/msg/Odometry`."""
    package, kind, *_ = interface.__module__.split('.')
    return f'{package}/{kind}/{interface.__name__}'


def import_type(name: str) -> Any:
    """Import the class of a type by its name.

    Args:
        name: `package/msg/Name`. It must be trusted: the package is imported.

    Raises:
        ImportError: The package has no Python code.
        AttributeError: The package has no such type.
    """
    package, kind, interface = name.split('/')
    return getattr(import_module(f'{package}.{kind}'), interface)
