"""A world in which simulated time advances only when every node has answered.

One step: publish /clock, let every node handle all messages, service calls and due timers, and all that
follows from them; then go on to the instant at which the next timer is due. Nothing waits for the wall
clock and nothing depends on it, so a run is as fast as the machine, and gives the same bits each time.
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
from diffdrive_jacobian.lockstep._simulated_time import SimulatedTime, nanoseconds
from diffdrive_jacobian.ros.runner import UserError, closed_world, ros_context

N = TypeVar('N', bound=Node)

LISTENING_DEPTH = 1000
"""How many messages of a topic may come at one instant until `listen` loses one."""


class Lockstep(SimulatedTime):
    """Nodes in the default context of rclpy, with simulated time that this world drives.

    Nodes are made as always, after the world, and added to it; `use_sim_time` is true for all of them.
    No other process hears them, nor another world in another process.

        with Lockstep() as world:
            controller = world.add(MyController())
            world.run_for(2.0)

    What a callback raises is raised by the call during which it ran. Nodes must not start threads that
    send messages, for nobody could tell when those are done; timers on another clock than the node's own
    run on wall time. Only for the main thread, and on systems with POSIX signals.
    """

    _open: ClassVar[Lockstep | None] = None

    def __init__(self, args: Sequence[str] = (), *, start: float = 1.0, patience: float = 10.0) -> None:
        """Begin a world without nodes but its own.

        Args:
            args: ROS arguments for all nodes, as for `rclpy.init`: `['--ros-args', '-p', 'x:=1.0']`.
            start: Simulated time at the beginning (s).
            patience: Wall time that one instant may take before it is called stuck (s).

        Raises:
            LockstepError: rclpy is initialised already, by another world for example, or does not
                understand the arguments, or this is not the main thread.
            ValueError: `start` or `patience` is not positive, or too long.
        """
        super().__init__(nanoseconds('start', start))
        nanoseconds('patience', patience)
        if args and args[0] != '--ros-args':
            raise LockstepError(f"args must begin with '--ros-args', got {args[0]!r}")
        if Lockstep._open is not None:
            raise LockstepError('another world is open in this process: close it first')
        if rclpy.ok():
            raise LockstepError('rclpy is initialised already: the world does that, leave it to it')
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
            with closed_world():
                context = self._closing.enter_context(ros_context(arguments, default=True))
        except UserError as error:
            raise LockstepError(str(error)) from error
        self._executor = QuiescentExecutor(context, self._on_registered)
        self._closing.callback(self._destroy_nodes)
        try:
            self._guard = Guard(patience, lambda: self._executor.nodes)
        except ValueError as error:
            raise LockstepError('a world must be made and used in the main thread') from error
        self._closing.callback(self._guard.close)
        self._traffic.listen()
        self._closing.callback(self._traffic.close)
        self.node = Node('lockstep', start_parameter_services=False, enable_rosout=False)
        """The world's own node, for the publishers, subscriptions and clients of a test."""
        self._clock_publisher = self.node.create_publisher(Clock, '/clock', 1)
        self._executor.add(self.node)
        Lockstep._open = self
        self._tell_time()

    # --- Life

    def __enter__(self) -> Lockstep:
        """Hold the world."""
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()

    def close(self) -> None:
        """Destroy the nodes and shut rclpy down; a second time it does nothing."""
        if Lockstep._open is self:
            Lockstep._open = None
            self._closing.close()

    def _destroy_nodes(self) -> None:
        nodes = self._executor.nodes
        self._executor.close()
        for node in nodes:
            node.destroy_node()

    def add(self, node: N) -> N:
        """Serve a node; it learns the time and does at once what it has to do.

        Raises:
            LockstepError: It is in this world already, in another context, served by another executor,
                or runs on wall time.
        """
        self._check_open()
        try:
            name = node.get_fully_qualified_name()
        except InvalidHandle as error:
            raise LockstepError('the node was destroyed before it was added') from error
        if node in self._executor.nodes:
            raise LockstepError(f'node {name} was added already')
        if any(one.get_fully_qualified_name() == name for one in self._executor.nodes):
            raise LockstepError(f'another node is called {name}: give one of them a namespace')
        if node.context is not self.node.context:
            raise LockstepError(
                f'node {name} is in another context: make it without context=, after the world'
            )
        if node.executor is not None:
            raise LockstepError(f'node {name} is served by an executor of its own: remove it from there')
        self._check_sim_time(node)
        if self._busy:
            raise LockstepError(f'node {name} cannot be added within a callback')
        self._executor.add(node)
        self._tell_time()
        return node

    def remove(self, node: Node) -> None:
        """Let a node vanish, as one that was killed; it is destroyed.

        Raises:
            LockstepError: It is not in this world.
        """
        self._check_open()
        if node is self.node or node not in self._executor.nodes:
            raise LockstepError('the node to remove is not in this world')
        with self._watched():
            self._executor.remove(node)
            node.destroy_node()

    def _check_open(self) -> None:
        if Lockstep._open is not self:
            raise LockstepError('this world is closed')
        if threading.get_ident() != self._thread:
            raise LockstepError('a world must be made and used in the main thread')

    def _on_registered(self, node: Node) -> None:
        self._check_sim_time(node)
        if node is not self.node and any(one.topic_name == '/clock' for one in node.publishers):
            name = node.get_fully_qualified_name()
            raise LockstepError(f'node {name} publishes /clock, which the world does')
        self._refuse_sleep(node)
        for callback in self._on_new:
            callback()

    def on_new_topics(self, callback: Callable[[], None]) -> None:
        """Have a function called whenever nodes come, or make or destroy something."""
        self._on_new.append(callback)

    def _refuse_sleep(self, node: Node) -> None:
        """Let no callback sleep until an instant that cannot come before it returns.

        rclpy would wait for that where no signal reaches it.
        """
        clock = node.get_clock()
        if 'sleep_until' in vars(clock):
            return
        sleep_until, name = clock.sleep_until, node.get_fully_qualified_name()

        def refuse(until: Any, *args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() == self._thread:
                raise LockstepError(
                    f'node {name} sleeps on its clock within a callback: simulated time cannot pass '
                    'before the callback returns'
                )
            return sleep_until(until, *args, **kwargs)

        clock.sleep_until = refuse

    @staticmethod
    def _check_sim_time(node: Node) -> None:
        if not node.get_parameter('use_sim_time').value:
            raise LockstepError(
                f'node {node.get_fully_qualified_name()} runs on wall time: '
                'its parameter use_sim_time must be true'
            )

    # --- Talking to the nodes

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message, reliably, and let every node answer it (within a callback: later).

        Raises:
            LockstepError: Nobody reads the topic, or it is of another type.
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
                f'nobody reads {publisher.topic_name} as {_type_name(type(message))}\n{self.report()}'
            )
        publisher.publish(message)
        self._settle_unless_busy()

    def listen(self, message_type: type, topic: str, *, latched: bool = False) -> list[Any]:
        """Collect the messages of a topic in the list that is returned.

        Args:
            message_type: Type of the topic.
            topic: Its name.
            latched: Also those that were sent before, if it is a latched topic.

        Raises:
            LockstepError: The topic is of another type.
        """
        self._check_open()
        received: list[Any] = []
        profile = QoSProfile(depth=LISTENING_DEPTH)
        if latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        else:
            # It matches every publisher, and within a process nothing is lost.
            profile.reliability = ReliabilityPolicy.BEST_EFFORT
        create = self.node.create_subscription
        self._with_type(topic, create, message_type, topic, received.append, profile)
        self._settle_unless_busy()
        return received

    def call(self, service_type: Any, name: str, request: Any = None, *, timeout: float = 10.0) -> Any:
        """Call a service and give its response.

        Args:
            service_type: Type of the service.
            name: Its name.
            request: The request; None: an empty one.
            timeout: Simulated time that the response may take (s); most take none.

        Raises:
            LockstepError: There is no such service, or no response in time.
        """
        self._check_open()
        name = self.node.resolve_service_name(name)
        services = dict(self.node.get_service_names_and_types())
        wanted = _type_name(service_type, 'srv')
        if wanted not in services.get(name, []):
            others = ', '.join(one for one, kinds in services.items() if not _is_of_rclpy(kinds))
            raise LockstepError(
                f'there is no service {name} of {wanted}; there are: {others or "none"}'
                if name not in services
                else f'{name} is {services[name][0]}, not {wanted}'
            )
        client = self.node.create_client(service_type, name)
        try:
            future = client.call_async(request or service_type.Request())
            self.run_until(future.done, timeout, f'a response of {name}')
            return future.result()
        finally:
            self.node.destroy_client(client)

    def _settle_unless_busy(self) -> None:
        """Settle; within a callback that follows anyway."""
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
                f'{name} is {", ".join(types) or "not to be had"}, not {_type_name(args[0])}'
            ) from error


def _type_name(interface: Any, kind: str = 'msg') -> str:
    return f'{interface.__module__.split(".")[0]}/{kind}/{interface.__name__}'


def _is_of_rclpy(types: list[str]) -> bool:
    """Whether it is a service that every node has."""
    return types[0].startswith(('rcl_interfaces/', 'type_description_interfaces/'))
