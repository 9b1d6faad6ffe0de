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

"""Tasks and coroutines of the nodes, and the executor that a node sees, which creates them."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.task import Task

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._gate import Gate
from diffdrive_jacobian.ros.rclpy_internals import new_task

__tracebackhide__ = True


class Tasks:
    """Tasks that are not done."""

    def __init__(self) -> None:
        """Start without tasks."""
        self.waiting: list[_Task] = []

    def create(self, owner: Node, gate: Gate, callback: Any, args: Any, kwargs: Any) -> Task:
        """Add a function or a coroutine of a node with a gate. Return its future."""
        if _is_async(callback):
            callback, args, kwargs = callback(*args, **kwargs), (), {}
        task = _Task(callback, new_task(callback, args, kwargs, owner.executor), owner, gate)
        self.waiting.append(task)
        return task.future

    def run(self) -> bool:
        """Continue each task once. Return whether any made progress.

        It is not known what a coroutine waits for, so it is continued and may wait again. Those of a
        node whose gate is closed are not continued.
        """
        progress = False
        tasks, self.waiting = self.waiting, []
        waiting = []
        try:
            while tasks:
                task = tasks.pop(0)
                if task.gate.closed:
                    waiting.append(task)
                    continue
                progress |= task.proceed()
                if (error := task.future.exception()) is not None:
                    raise error
                if not (task.future.done() or task.future.cancelled()):
                    waiting.append(task)
        finally:
            self.waiting = [*waiting, *tasks, *self.waiting]
        return progress

    def cancel(self, owner: Node | None = None) -> None:
        """Cancel all, or those of a node."""
        for task in self.waiting:
            if owner is None or task.owner is owner:
                task.future.cancel()
        self.waiting = [task for task in self.waiting if not task.future.cancelled()]


class _Task:
    """A task and the point at which its coroutine waits."""

    def __init__(self, handler: Any, future: Task, owner: Node, gate: Gate) -> None:
        self.future = future
        self.owner = owner
        self.gate = gate
        self._handler = handler
        # A reference is kept so that no later object has the same identity.
        self._waits_for: Any = self

    def proceed(self) -> bool:
        """Continue the task. Return whether it made progress."""
        before = self._waits_for
        self.future()
        self._waits_for = self._innermost()
        return bool(self.future.done()) or self._waits_for is not before

    def _innermost(self) -> Any:
        """Return the innermost object that the coroutine awaits."""
        point = self._handler
        while (
            inner := getattr(point, 'cr_await', None) or getattr(point, 'gi_yieldfrom', None)
        ) is not None:
            point = inner
        return point


def _is_async(callback: Any) -> bool:
    return inspect.iscoroutinefunction(callback) or inspect.iscoroutinefunction(
        getattr(callback, '__call__', None)  # noqa: B004
    )


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
                'executor, as by rclpy.spin, spin_once or spin_until_future_complete. A callback that '
                'needs a response awaits the future of call_async; a test lets time pass by '
                'lockstep.run_for, and calls services by lockstep.call'
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
