"""Lockstep: simulated time that advances only when every node has processed its inputs.

One step publishes /clock and executes the callbacks of all messages, service calls and timers that are
due, and of all that they cause. Then time advances to the next timer. Nothing waits for the wall clock,
so a run is as fast as the machine. Its results are the same each time, bit for bit.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, ClassVar, TypeVar

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.lockstep._errors import InitializedError, LockstepError
from diffdrive_jacobian.lockstep._executor import QuiescentExecutor
from diffdrive_jacobian.lockstep._external_answers import Expectation
from diffdrive_jacobian.lockstep._guard import Guard
from diffdrive_jacobian.lockstep._messaging import described
from diffdrive_jacobian.lockstep._processes import Processes
from diffdrive_jacobian.lockstep._requirements import Requirements
from diffdrive_jacobian.lockstep._simulated_time import checked_nanoseconds
from diffdrive_jacobian.messages.topics import CLOCK
from diffdrive_jacobian.ros.fastdds_profiles import withdraw
from diffdrive_jacobian.ros.rclpy_internals import refuse_init, wrap_sleep
from diffdrive_jacobian.ros.runner import UserError, environment, ros_context

ISOLATED = ('--ros-args', '-p', 'start_type_description_service:=false')
"""ROS arguments of a world without external nodes, before those of the user: only tools in other
processes call that service, and it takes time to create."""
N = TypeVar('N', bound=Node)


class Lockstep(Requirements, Processes):
    """Executes nodes in the default context of rclpy, in simulated time.

    Nodes are created as usual, after the `Lockstep`, and added to it. `use_sim_time` is true for all of
    them. They are isolated: no other process receives their messages. Without external nodes
    `start_type_description_service` is false, unless `args` say otherwise.

        with Lockstep() as world:
            controller = world.add(MyController())
            world.run_for(2.0)

    An exception in a callback is raised by the method that executed it. If a node publishes from a
    thread of its own, the next method raises an error, because the end of that work cannot be detected.
    Timers on another clock than that of the node run on wall time. Only for the main thread, and on
    systems with POSIX signals.
    """

    _open: ClassVar[Lockstep | None] = None

    def __init__(
        self,
        args: Sequence[str] = (),
        *,
        start: float = 1.0,
        patience: float = 10.0,
        external: Iterable[Expectation] | None = None,
        domain_id: int | None = None,
    ) -> None:
        """Initialize rclpy and start without nodes.

        Args:
            args: ROS arguments for all nodes, as for `rclpy.init`: `['--ros-args', '-p', 'x:=1.0']`.
            start: Simulated time at the start (s).
            patience: Longest wall time for one simulated time (s). Beyond it an error names the
                callbacks.
            external: What nodes in other processes on this machine send (`Answers`, `Every`, `Idle`).
                Time does not advance before it has been received. None: no other process is discovered.
            domain_id: The ROS domain in which they are; None: one that is not in use, see `domain_id`.
                Only with `external`.

        Raises:
            LockstepError: rclpy is already initialized, for example by another `Lockstep`, the arguments
                are invalid, or this is not the main thread.
            ValueError: `start` or `patience` is not positive, or too long, or `external` or `domain_id`
                is invalid.
        """
        super().__init__(checked_nanoseconds('start', start))
        checked_nanoseconds('patience', patience)
        if args and args[0] != '--ros-args':
            raise LockstepError(f"args must begin with '--ros-args', got {args[0]!r}")
        if Lockstep._open is not None:
            raise LockstepError('another Lockstep is open in this process: close it first')
        if rclpy.ok():
            raise LockstepError('rclpy is already initialized: only lockstep may do that')
        self._thread = threading.get_ident()
        self._on_new: list[Callable[[], None]] = []
        self._closing = ExitStack()
        try:
            defaults = ISOLATED if external is None else ()
            self._enter([*defaults, *args], patience, self._variables(external, domain_id))
            if external is not None:
                self._open_to(external)
        except BaseException:
            Lockstep._open = None
            self._closing.close()
            raise

    def _enter(self, args: Sequence[str], patience: float, variables: Mapping[str, str | None]) -> None:
        arguments = ['lockstep', *args, '--ros-args', '-p', 'use_sim_time:=true']
        try:
            with environment(variables):
                context = self._closing.enter_context(ros_context(arguments, default=True))
        except UserError as error:
            raise LockstepError(str(error)) from error
        refuse_init(context, _refuse_init)
        withdraw()
        self._executor = QuiescentExecutor(context, self._on_registered)
        self._closing.callback(self._destroy_nodes)
        try:
            self._guard = Guard(patience, lambda: self._executor.nodes)
        except ValueError as error:
            raise LockstepError('Lockstep must be created and used in the main thread') from error
        self._closing.callback(self._guard.close)
        self._traffic.start(self._executor.deliveries, self._executor.note_thread)
        self._closing.callback(self._traffic.close)
        self.node = Node('lockstep', start_parameter_services=False, enable_rosout=False)
        self._executor.clocks.publisher = self.node.create_publisher(Clock, CLOCK, 1)
        self._executor.add(self.node)
        Lockstep._open = self
        self._publish_clock()

    # --- Life

    def __enter__(self) -> Lockstep:
        """Return this object."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    @property
    def is_open(self) -> bool:
        """Whether it was not closed."""
        return Lockstep._open is self

    def close(self) -> None:
        """Destroy the nodes and shut rclpy down. Further calls have no effect."""
        if Lockstep._open is self:
            Lockstep._open = None
            self._closing.close()

    def _destroy_nodes(self) -> None:
        nodes = self._executor.nodes
        self._executor.close()
        for node in nodes:
            node.destroy_node()

    def add(self, node: N, *, observer: bool = False) -> N:
        """Add a node. It receives the time, and its callbacks that are due are executed.

        Args:
            node: The node.
            observer: Whether the node belongs to the test, as a recorder does: only faults that name it
                affect the messages that it receives.

        Returns:
            The node.

        Raises:
            LockstepError: The node was already added, is in another context or executor, or runs on wall
                time; or it is no node.
        """
        self._check_open()
        self._check_new(node)
        if self._busy:
            name = node.get_fully_qualified_name()
            raise LockstepError(f'node {name} cannot be added within a callback')
        if observer:
            self._observers.add(node)
        self._executor.add(node)
        self._publish_clock()
        return node

    def _check_new(self, node: Node) -> None:
        if not isinstance(node, Node):
            hint = f'; create one: add({node.__name__}(...))' if isinstance(node, type) else ''
            raise LockstepError(f'add takes a node, got {described(node)}{hint}')
        try:
            name = node.get_fully_qualified_name()
        except InvalidHandle as error:
            raise LockstepError('the node was destroyed before it was added') from error
        if node in self._executor.nodes:
            raise LockstepError(f'node {name} was already added')
        if any(other.get_fully_qualified_name() == name for other in self._executor.nodes):
            raise LockstepError(f'another node has the name {name}: give one of them a namespace')
        if node.context is not self.node.context:
            raise LockstepError(
                f'node {name} is in another context: create it without context=, after Lockstep()'
            )
        if node.executor is not None:
            raise LockstepError(f'node {name} is in another executor: remove it from there')
        self._check_sim_time(node)

    def remove(self, node: Node) -> None:
        """Remove and destroy a node without stopping it, as if its process was killed.

        Raises:
            LockstepError: The node was not added.
        """
        self._check_open()
        if node is self.node or node not in self._executor.nodes:
            raise LockstepError('the node to remove was not added')
        self._executor.killed.add(node)
        with self._watched():
            self._executor.remove(node)
            node.destroy_node()

    def _check_open(self) -> None:
        if Lockstep._open is not self:
            raise LockstepError('this Lockstep is closed')
        if threading.get_ident() != self._thread:
            raise LockstepError('Lockstep must be created and used in the main thread')

    def _on_registered(self, node: Node) -> None:
        self._check_sim_time(node)
        if node is not self.node and any(publisher.topic_name == CLOCK for publisher in node.publishers):
            name = node.get_fully_qualified_name()
            raise LockstepError(f'node {name} publishes /clock, which only lockstep may do')
        self._refuse_sleep(node)
        for callback in self._on_new:
            callback()

    def on_new_topics(self, callback: Callable[[], None]) -> None:
        """Call a function whenever a node is added, or has created or destroyed an entity."""
        self._on_new.append(callback)

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

    def _on_discovery(self) -> None:
        super()._on_discovery()
        for callback in self._on_new:
            callback()

    @staticmethod
    def _check_sim_time(node: Node) -> None:
        if not node.get_parameter('use_sim_time').value:
            raise LockstepError(
                f'node {node.get_fully_qualified_name()} runs on wall time: '
                'its parameter use_sim_time must be true'
            )


def _refuse_init(*_: Any, **__: Any) -> None:
    """Raise the error of a second `rclpy.init`."""
    raise InitializedError(
        'lockstep has initialized rclpy: leave out rclpy.init() and rclpy.shutdown(), which belong into '
        'the main() of a program; ROS arguments: Lockstep(args=...), @pytest.mark.lockstep(args=...)'
    )
