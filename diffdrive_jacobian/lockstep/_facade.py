"""The executor that a node in lockstep sees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.task import Task

from diffdrive_jacobian.lockstep._errors import LockstepError


class Facade:
    """The executor of a node, as the node sees it."""

    def __init__(self, changed: Callable[[], None], create_task: Callable[..., Task]) -> None:
        self._changed = changed
        self._create_task = create_task
        self.released = False
        """Whether lockstep is about to remove the node."""

    def add_node(self, node: Node) -> bool:
        """Accept a node. It was added before its `executor` is set."""
        return True

    def remove_node(self, node: Node) -> None:
        """Accept the removal of a node by lockstep.

        Raises:
            LockstepError: Another executor is about to add the node.
        """
        if not self.released:
            raise LockstepError(
                f'node {node.get_fully_qualified_name()} is in lockstep and cannot be spun by another '
                'executor'
            )

    def wake(self) -> None:
        """Note that a node has created or destroyed an entity."""
        self._changed()

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Schedule a function or a coroutine. Return its future."""
        return self._create_task(callback, *args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        raise _NoAttributeError(
            f'a node in lockstep cannot call executor.{name}: lockstep executes its callbacks'
        )


class _NoAttributeError(LockstepError, AttributeError):
    """The executor has no such attribute. `hasattr` returns False."""
