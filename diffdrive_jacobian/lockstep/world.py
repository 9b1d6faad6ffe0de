"""Lockstep: simulated time that advances only when every node has processed its inputs.

One step publishes /clock and executes the callbacks of all messages, service calls and timers that are
due, and of all that they cause. Then time advances to the next timer. Nothing waits for the wall clock,
so a run is as fast as the machine. Its results are the same each time, bit for bit.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, ClassVar, TypeVar

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._executor import QuiescentExecutor
from diffdrive_jacobian.lockstep._guard import Guard
from diffdrive_jacobian.lockstep._simulated_time import SimulatedTime, checked_nanoseconds
from diffdrive_jacobian.ros.rclpy_internals import SERVICES_OF_RCLPY, wrap_sleep
from diffdrive_jacobian.ros.runner import UserError, discovery_off, ros_context

N = TypeVar('N', bound=Node)

LISTENING_DEPTH = 1000
"""Queue size of `listen`: the number of messages of a topic at one simulated time."""


class Lockstep(SimulatedTime):
    """Executes nodes in the default context of rclpy, in simulated time.

    Nodes are created as usual, after the `Lockstep`, and added to it. `use_sim_time` is true for all of
    them. They are isolated: no other process receives their messages.

        with Lockstep() as world:
            controller = world.add(MyController())
            world.run_for(2.0)

    An exception in a callback is raised by the method that executed it. Nodes must not publish from
    threads of their own, because the end of their work cannot be detected. Timers on another clock than
    that of the node run on wall time. Only for the main thread, and on systems with POSIX signals.
    """

    _open: ClassVar[Lockstep | None] = None

    def __init__(self, args: Sequence[str] = (), *, start: float = 1.0, patience: float = 10.0) -> None:
        """Initialize rclpy and start without nodes.

        Args:
            args: ROS arguments for all nodes, as for `rclpy.init`: `['--ros-args', '-p', 'x:=1.0']`.
            start: Simulated time at the start (s).
            patience: Longest wall time for one simulated time (s). Beyond it an error names the
                callbacks.

        Raises:
            LockstepError: rclpy is already initialized, for example by another `Lockstep`, the arguments
                are invalid, or this is not the main thread.
            ValueError: `start` or `patience` is not positive, or too long.
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
        self._publishers: dict[tuple[type, str], Publisher] = {}
        self._on_new: list[Callable[[], None]] = []
        self._closing = ExitStack()
        try:
            self._enter(args, patience)
        except BaseException:
            Lockstep._open = None
            self._closing.close()
            raise

    def _enter(self, args: Sequence[str], patience: float) -> None:
        arguments = ['lockstep', *args, '--ros-args', '-p', 'use_sim_time:=true']
        try:
            with discovery_off():
                context = self._closing.enter_context(ros_context(arguments, default=True))
        except UserError as error:
            raise LockstepError(str(error)) from error
        self._executor = QuiescentExecutor(context, self._on_registered)
        self._closing.callback(self._destroy_nodes)
        try:
            self._guard = Guard(patience, lambda: self._executor.nodes)
        except ValueError as error:
            raise LockstepError('Lockstep must be created and used in the main thread') from error
        self._closing.callback(self._guard.close)
        self._traffic.start(self._executor.deliveries)
        self._closing.callback(self._traffic.close)
        self.node = Node('lockstep', start_parameter_services=False, enable_rosout=False)
        """Node for the publishers, subscriptions and clients of a test."""
        self._executor.clock = self.node.create_publisher(Clock, '/clock', 1)
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

    def add(self, node: N) -> N:
        """Add a node. It receives the time, and its callbacks that are due are executed.

        Returns:
            The node.

        Raises:
            LockstepError: The node was already added, is in another context or executor, or runs on wall
                time.
        """
        self._check_open()
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
        if self._busy:
            raise LockstepError(f'node {name} cannot be added within a callback')
        self._executor.add(node)
        self._publish_clock()
        return node

    def remove(self, node: Node) -> None:
        """Remove and destroy a node without stopping it, as if its process was killed.

        Raises:
            LockstepError: The node was not added.
        """
        self._check_open()
        if node is self.node or node not in self._executor.nodes:
            raise LockstepError('the node to remove was not added')
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
        if node is not self.node and any(
            publisher.topic_name == '/clock' for publisher in node.publishers
        ):
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

    @staticmethod
    def _check_sim_time(node: Node) -> None:
        if not node.get_parameter('use_sim_time').value:
            raise LockstepError(
                f'node {node.get_fully_qualified_name()} runs on wall time: '
                'its parameter use_sim_time must be true'
            )

    # --- Messages and services

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message and execute all callbacks that it causes (within a callback: later).

        Raises:
            LockstepError: The topic has no subscription, or another type.
        """
        self._check_open()
        key = type(message), topic
        if key not in self._publishers:
            create = self.node.create_publisher
            self._publishers[key] = self._with_type(topic, create, *key, 10)
        publisher = self._publishers[key]
        self._settle_unless_busy()
        if publisher.get_subscription_count() == 0:
            raise LockstepError(
                f'{publisher.topic_name} has no subscription of type {_type_name(type(message))}\n'
                f'{self.report()}'
            )
        publisher.publish(message)
        self._settle_unless_busy()

    def listen(self, message_type: type, topic: str, *, latched: bool = False) -> list[Any]:
        """Return a list to which the messages of a topic are appended.

        Args:
            message_type: Type of the topic.
            topic: Name of the topic.
            latched: Whether to include earlier messages of a latched topic.

        Raises:
            LockstepError: The topic has another type.
        """
        self._check_open()
        received: list[Any] = []
        profile = QoSProfile(depth=LISTENING_DEPTH)
        if latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        else:
            # Matches every publisher. Within a process no message is lost.
            profile.reliability = ReliabilityPolicy.BEST_EFFORT
        create = self.node.create_subscription
        self._with_type(topic, create, message_type, topic, received.append, profile)
        self._settle_unless_busy()
        return received

    def call(self, service_type: Any, name: str, request: Any = None, *, timeout: float = 10.0) -> Any:
        """Call a service and return the response.

        Args:
            service_type: Type of the service.
            name: Name of the service.
            request: The request; None: an empty one.
            timeout: Longest simulated time for the response (s).

        Raises:
            LockstepError: There is no such service, or it does not respond in time.
        """
        self._check_open()
        name = self.node.resolve_service_name(name)
        services = dict(self.node.get_service_names_and_types())
        wanted = _type_name(service_type, 'srv')
        if wanted not in services.get(name, []):
            others = ', '.join(other for other, kinds in services.items() if not _is_of_rclpy(kinds))
            raise LockstepError(
                f'there is no service {name} of type {wanted}; services: {others or "none"}'
                if name not in services
                else f'{name} is of type {services[name][0]}, not {wanted}'
            )
        client = self.node.create_client(service_type, name)
        try:
            future = client.call_async(request or service_type.Request())
            self.run_until(future.done, timeout, f'a response of {name}')
            return future.result()
        finally:
            self.node.destroy_client(client)

    def _settle_unless_busy(self) -> None:
        """Settle, except within a callback, after which it happens anyway."""
        if not self._busy:
            self.settle()

    def _with_type(self, topic: str, create: Callable[..., Any], *args: Any) -> Any:
        try:
            return create(*args)
        except RuntimeError as error:
            # Within one process Fast DDS refuses a topic of two types.
            name = self.node.resolve_topic_name(topic)
            types = dict(self.node.get_topic_names_and_types()).get(name, [])
            raise LockstepError(
                f'{name} is of type {", ".join(types) or "unknown"}, not {_type_name(args[0])}'
            ) from error


def _type_name(interface: Any, kind: str = 'msg') -> str:
    return f'{interface.__module__.split(".")[0]}/{kind}/{interface.__name__}'


def _is_of_rclpy(types: list[str]) -> bool:
    """Return whether a service is one that rclpy provides for every node."""
    return types[0].startswith(SERVICES_OF_RCLPY)
