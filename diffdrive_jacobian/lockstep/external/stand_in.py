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
