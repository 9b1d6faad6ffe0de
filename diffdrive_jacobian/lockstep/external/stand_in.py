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

"""The node of the world that stands for a node of a process."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from rclpy.parameter import Parameter

from diffdrive_jacobian.lockstep.external.graph import NodeGraph


class StandIn(Node):  # type: ignore[misc]
    """A node of the world for a node of a process. If it is destroyed, the process is ended."""

    def __init__(self, graph: NodeGraph, end: Callable[[StandIn], None]) -> None:
        """Create it with the name of the node, without topics."""
        super().__init__(
            graph.name,
            namespace=graph.namespace,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[
                Parameter('use_sim_time', value=True),
                Parameter('start_type_description_service', value=False),
            ],
        )
        self._end = end

    def destroy_node(self) -> None:
        """Destroy the node, and end the process."""
        self._end(self)
        super().destroy_node()
