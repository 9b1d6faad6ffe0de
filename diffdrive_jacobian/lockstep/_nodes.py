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

"""The nodes of a world: checked and added, and created again."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.lockstep._errors import LockstepError, described
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.messages.topics import CLOCK
from diffdrive_jacobian.ros.rclpy_internals import wrap_sleep


class Nodes:
    """The nodes of a world."""

    def __init__(self, scheduler: Scheduler) -> None:
        """Create the node of the test.

        Args:
            scheduler: Executes the nodes.
        """
        self._scheduler = scheduler
        self._thread = threading.get_ident()
        self._factories: dict[str, Callable[[], Node]] = {}
        self.own = Node('lockstep', start_parameter_services=False, enable_rosout=False)
        """The node of the test."""
        scheduler.clocks.publish_with(self.own.create_publisher(Clock, CLOCK, 1))
        self.observers = {self.own}
        """Nodes that belong to the test."""
        self.on_change: list[Callable[[], None]] = []
        """Called whenever a node is added, or has created or destroyed an entity."""
        scheduler.registered = self._on_registered
        scheduler.add(self.own)

    def add(self, node: Node, *, observer: bool) -> None:
        """Add a node, as `Lockstep.add`."""
        if observer:
            self.observers.add(node)
        self._scheduler.add(node)

    def check_new(self, node: Node) -> None:
        """Raise LockstepError if a node cannot be added."""
        if not isinstance(node, Node):
            hint = f'; create one: add({node.__name__}(...))' if isinstance(node, type) else ''
            raise LockstepError(f'add takes a node, got {described(node)}{hint}')
        try:
            name = node.get_fully_qualified_name()
        except InvalidHandle as error:
            raise LockstepError('the node was destroyed before it was added') from error
        if node in self._scheduler.nodes:
            raise LockstepError(f'node {name} was already added')
        self._scheduler.forget_destroyed()
        if any(other.get_fully_qualified_name() == name for other in self._scheduler.nodes):
            raise LockstepError(
                f'another node has the name {name}: give one of them a namespace, such as by '
                "'--ros-args', '-r', '__ns:=/other'"
            )
        if node.context is not self.own.context:
            raise LockstepError(
                f'node {name} is in another context: create it without context=, after Lockstep()'
            )
        if node.executor is not None:
            raise LockstepError(f'node {name} is in another executor: remove it from there')
        _check_sim_time(node)

    # --- Created by functions

    def created(self, node: Node, factory: Callable[[], Node]) -> None:
        """Note the function that has created a node."""
        self._factories[node.get_fully_qualified_name()] = factory

    def forget(self, name: str) -> None:
        """Forget the function that has created the node of a name."""
        self._factories.pop(name, None)

    def restartable(self, name: str) -> bool:
        """Return whether the node of a name can be created again."""
        return name in self._factories

    def restart(self, name: str) -> None:
        """Create the node of a name again."""
        node = self._factories[name]()
        if node not in self._scheduler.nodes:
            self.check_new(node)
            self._scheduler.add(node)
        if not self._scheduler.clocks.pauses:
            self._scheduler.clocks.set()

    # --- Registered

    def _on_registered(self, node: Node) -> None:
        """Check a node that is new, or has created or destroyed an entity."""
        _check_sim_time(node)
        if node is not self.own and any(publisher.topic_name == CLOCK for publisher in node.publishers):
            name = node.get_fully_qualified_name()
            raise LockstepError(f'node {name} publishes /clock, which only lockstep may do')
        self._refuse_sleep(node)
        self.note_change()

    def note_change(self) -> None:
        """Note that nodes or topics may have changed."""
        for callback in self.on_change:
            callback()

    def _refuse_sleep(self, node: Node) -> None:
        """Make `sleep_until` of a node's clock raise an error within callbacks.

        The time could not come before the callback returns, and rclpy would wait where no signal handler
        runs.
        """
        name = node.get_fully_qualified_name()

        def refusing(sleep_until: Callable[..., Any]) -> Callable[..., Any]:
            def refuse(until: Any, *args: Any, **kwargs: Any) -> Any:
                if threading.get_ident() == self._thread:
                    raise LockstepError(
                        f'node {name} sleeps on its clock within a callback: simulated time cannot '
                        'advance before the callback returns'
                    )
                return sleep_until(until, *args, **kwargs)

            return refuse

        wrap_sleep(node.get_clock(), refusing)


def _check_sim_time(node: Node) -> None:
    if not node.get_parameter('use_sim_time').value:
        raise LockstepError(
            f'node {node.get_fully_qualified_name()} runs on wall time: '
            'its parameter use_sim_time must be true'
        )
