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

"""Lockstep: simulated time that advances only when every node has processed its inputs.

One step sets the clocks of the nodes and executes the callbacks of all messages, service calls and
timers that are due, and of all that they cause. Then time advances to the next timer. Nothing waits for
the wall clock, so a run is as fast as the machine. Its results are the same each time, bit for bit.

A world consists of its nodes (`_nodes`), the links between them (`_links`), and a scheduler, which
executes one callback after the other (`_scheduler`) while time advances (`_simulated_time`). There may
be faults (`_faults`), properties (`_properties`) and nodes in other processes (`external`).
"""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, ClassVar, TypeVar

import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep._errors import (
    InitializedError,
    LockstepError,
    PropertyViolation,
    described,
)
from diffdrive_jacobian.lockstep._fault_log import FaultEvent
from diffdrive_jacobian.lockstep._faults import Faults
from diffdrive_jacobian.lockstep._guard import Guard
from diffdrive_jacobian.lockstep._injection import Fault, absolute_name
from diffdrive_jacobian.lockstep._messaging import Messaging
from diffdrive_jacobian.lockstep._nodes import Nodes
from diffdrive_jacobian.lockstep._pause import Pauses
from diffdrive_jacobian.lockstep._properties import Properties, Property
from diffdrive_jacobian.lockstep._report import describe
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep._simulated_time import SimulatedTime, checked_nanoseconds
from diffdrive_jacobian.lockstep._waits import Waits
from diffdrive_jacobian.lockstep.external.command import Command
from diffdrive_jacobian.lockstep.external.linux import check_platform
from diffdrive_jacobian.lockstep.external.node_process import NodeProcess
from diffdrive_jacobian.lockstep.external.process import end_all
from diffdrive_jacobian.ros.fastdds_profiles import open_to_others, withdraw
from diffdrive_jacobian.ros.rclpy_internals import refuse_init
from diffdrive_jacobian.ros.runner import UserError, discovery_off, ros_context
from diffdrive_jacobian.time_units import NANOSECONDS

__tracebackhide__ = True
# So pytest shows the lines of tests and callbacks, not those between them. Here and in other modules.

ISOLATED = ('--ros-args', '-p', 'start_type_description_service:=false')
"""ROS arguments before those of the user: only tools in other processes call that service, and it takes
time to create."""
N = TypeVar('N', bound=Node)


class Lockstep:
    """Executes nodes in the default context of rclpy, in simulated time.

    Nodes are created as usual, after the `Lockstep`, and added to it. `use_sim_time` is true for all of
    them. They are isolated: no other process receives their messages but those that `start` starts.
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
    ) -> None:
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
        begin = checked_nanoseconds('start', start)
        checked_nanoseconds('patience', patience)
        if args and args[0] != '--ros-args':
            raise LockstepError(f"args must begin with '--ros-args', got {args[0]!r}")
        if Lockstep._open is not None:
            raise LockstepError('another Lockstep is open in this process: close it first')
        if rclpy.ok():
            raise LockstepError('rclpy is already initialized: only lockstep may do that')
        self._thread = threading.get_ident()
        self._start = begin
        self._closing = ExitStack()
        try:
            self._compose(args, patience)
        except BaseException:
            withdraw()
            Lockstep._open = None
            self._closing.close()
            raise

    def _compose(self, args: Sequence[str], patience: float) -> None:
        """Create the parts of the world."""
        arguments = ['lockstep', *ISOLATED, *args, '--ros-args', '-p', 'use_sim_time:=true']
        # For the processes that may be started: read with the first participant of this one.
        open_to_others()
        try:
            with discovery_off():
                context = self._closing.enter_context(ros_context(arguments, default=True))
        except UserError as error:
            raise LockstepError(str(error)) from error
        refuse_init(context, _refuse_init)
        self._scheduler = scheduler = Scheduler(context, self._start)
        self._closing.callback(self._destroy_nodes)
        self._closing.callback(scheduler.links.close)
        try:
            guard = Guard(patience, lambda: scheduler.nodes)
        except ValueError as error:
            raise LockstepError('Lockstep must be created and used in the main thread') from error
        self._closing.callback(guard.close)
        self._nodes = Nodes(scheduler)
        # With its first node the context gets its participant.
        withdraw()
        self.node = self._nodes.own
        """Node for the publishers, subscriptions and clients of a test."""
        self._time = SimulatedTime(
            scheduler,
            guard,
            check_open=self._check_open,
            report=self.report,
        )
        waits = Waits(context, guard, lambda: scheduler.existing, lambda: self._time.busy)
        self._closing.callback(waits.close)
        self._processes: list[NodeProcess] = []
        self._closing.callback(self._close_processes)
        self._time.processes = self._processes
        self._guard = guard
        self.pauses = self._time.pauses = Pauses(self)
        """Where it stops in a debugger."""
        self._messaging = Messaging(scheduler, self._nodes, self._time, self.report)
        self._faults = Faults(scheduler, self._nodes, self.settle)
        self._properties = Properties(scheduler, self._nodes, self.report)
        Lockstep._open = self
        self._time.arrive()

    # --- Opening and closing

    def __enter__(self) -> Lockstep:
        """Return this object."""
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Close it.

        Raises:
            LockstepError: A process that was started has lost messages, and there is no other error.
        """
        try:
            if kind is None and self.is_open:
                self._check_lost()
        finally:
            self.close()

    @property
    def is_open(self) -> bool:
        """Whether it was not closed."""
        return Lockstep._open is self

    def close(self) -> None:
        """Destroy the nodes and shut rclpy down. Further calls have no effect."""
        if Lockstep._open is self:
            Lockstep._open = None
            for time in self.pauses.times:
                warnings.warn(
                    f'pause_at({time / NANOSECONDS:g}): the world has ended at {self.world_seconds:g} s',
                    stacklevel=2,
                )
            self._closing.close()

    def _destroy_nodes(self) -> None:
        nodes = self._scheduler.nodes
        self._scheduler.close()
        for node in nodes:
            node.destroy_node()

    def _close_processes(self) -> None:
        end_all([process.child for process in self._processes])
        for process in self._processes:
            process.close()

    def _check_lost(self) -> None:
        for process in self._processes:
            process.check_lost()

    def _check_open(self) -> None:
        if Lockstep._open is not self:
            raise LockstepError('this Lockstep is closed')
        if threading.get_ident() != self._thread:
            raise LockstepError('Lockstep must be created and used in the main thread')

    # --- Nodes

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
        self._nodes.check_new(node)
        if self._time.busy:
            name = node.get_fully_qualified_name()
            raise LockstepError(f'node {name} cannot be added within a callback')
        self._nodes.add(node, observer=observer)
        self._time.arrive()
        return node

    def create(self, factory: Callable[[], N]) -> N:
        """Create a node with a function, add it, and return it.

        A fault that kills the node calls the function again to start it anew. `find` returns the node
        that is there now.

        Raises:
            LockstepError: As of `add`, or `factory` is no function.
        """
        self._check_open()
        if isinstance(factory, Node) or not callable(factory):
            raise LockstepError(f'create takes a function that returns a node, got {described(factory)}')
        node = self.add(factory())
        self._nodes.created(node, factory)
        return node

    def find(self, name: str) -> Node:
        """Return the node that has a name now.

        Raises:
            LockstepError: There is none.
        """
        self._check_open()
        if not isinstance(name, str):
            raise LockstepError(f'find takes the name of a node, got {described(name)}')
        nodes = {node.get_fully_qualified_name(): node for node in self._scheduler.nodes}
        full = absolute_name(name, self.node)
        if full not in nodes:
            raise LockstepError(f'there is no node {full}; nodes: {", ".join(nodes)}')
        return nodes[full]

    def remove(self, node: Node) -> None:
        """Remove and destroy a node without stopping it, as if its process was killed when it is idle.

        What was sent to it is processed before. The fault `Kill` does not wait for that.

        Raises:
            LockstepError: The node was not added.
        """
        self._check_open()
        if node is self.node or node not in self._scheduler.nodes:
            raise LockstepError('the node to remove was not added')
        self._scheduler.killed.add(node)

        def remove() -> None:
            self._scheduler.remove(node)
            node.destroy_node()

        self._time.execute(remove)

    @property
    def nodes(self) -> list[Node]:
        """The nodes that are there now, with that of the test."""
        return self._scheduler.nodes

    @property
    def killed(self) -> set[Node]:
        """The nodes that were removed without being stopped."""
        return self._scheduler.killed

    def node_of(self, publisher: Publisher) -> Node | None:
        """Return the node that has a publisher; None: it was removed."""
        for node in self._scheduler.nodes:
            if any(one is publisher for one in node.publishers):
                return node
        return None

    def on_new_topics(self, callback: Callable[[], None]) -> None:
        """Call a function whenever a node is added, or has created or destroyed an entity."""
        self._nodes.on_change.append(callback)

    # --- Time

    @property
    def now(self) -> int:
        """Simulated time (ns)."""
        return self._scheduler.clocks.now

    @property
    def elapsed(self) -> float:
        """Simulated time since the start, by the clock of the nodes (s)."""
        return (self.now - self._start) / NANOSECONDS

    @property
    def world_time(self) -> int:
        """Time that has passed in the world since the start (ns).

        It always advances. The clock of the nodes, `now`, may jump or stand still.
        """
        return self._scheduler.agenda.now

    @property
    def world_seconds(self) -> float:
        """The same in seconds (s), as faults and properties count it."""
        return self.world_time / NANOSECONDS

    def settle(self) -> None:
        """Execute all callbacks that are due at the current time."""
        self._time.settle()

    def step(self, at_most: float | None = None) -> None:
        """Advance to the time at which the next timer expires.

        Args:
            at_most: Largest duration of the step (s).

        Raises:
            ValueError: `at_most` is not positive, or too long.
            LockstepError: No timer is running and `at_most` is not given, or time cannot advance.
        """
        self._time.step(at_most)

    def run_for(self, seconds: float) -> None:
        """Advance by a duration (s), from one timer to the next.

        Raises:
            ValueError: `seconds` is not positive, or too long.
            LockstepError: Time cannot advance.
        """
        self._time.run_for(seconds)

    def run_until(self, condition: Callable[[], object], timeout: float, what: str = '') -> None:
        """Advance until a condition is true.

        Args:
            condition: The condition. It is called once at each simulated time, after all callbacks.
            timeout: Longest simulated time (s).
            what: Description of the condition for the error message.

        Raises:
            ValueError: `condition` is no function, or `timeout` is not positive or too long.
            LockstepError: The condition did not become true in time, or time cannot advance.
        """
        self._time.run_until(condition, timeout, what)

    def jump(self, seconds: float) -> None:
        """Jump by a duration of time (s), forward or back, as when a simulator is reset.

        Timers do not expire one by one in between. rcl determines how they react to the jump.

        Raises:
            ValueError: `seconds` is zero or not finite, or the new time does not fit into a stamp.
        """
        self._time.jump(seconds)

    def pause_at(self, seconds: float) -> None:
        """Stop in the debugger before a world time, when all that comes before it has happened.

        `breakpoint()` is called. So the prompt of pdb, of pytest or of an IDE has this world as `world`:
        `world.step()` lets the next things happen, `world.report()` and `world.last(topic)` tell what
        has happened, `world.find(name)` returns a node. From now on nothing has a limit of wall time,
        neither callbacks nor other processes, so they can be debugged, too.

        Args:
            seconds: World time since the start (s).

        Raises:
            ValueError: `seconds` is negative, has passed, or is too long.
        """
        self._check_open()
        time = 0 if seconds == 0 else checked_nanoseconds('seconds', seconds)
        if time < self.world_time:
            raise ValueError(
                f'seconds must not have passed: {self.world_seconds:g} s have, got {seconds!r}'
            )
        self.pauses.add(time)
        self._guard.unlimited = True
        for process in self._processes:
            process.be_patient()

    # --- Messages and services

    def publish(self, topic: str, message: Any, *, latched: bool = False) -> None:
        """Publish a message and execute all callbacks that it causes (within a callback: later).

        Args:
            topic: Name of the topic.
            message: The message.
            latched: Whether latched (transient local) subscriptions receive it, too, also later ones.

        Raises:
            LockstepError: The topic has no subscription (and the message is not latched), one of another
                quality of service, or another type, or it is subscribed to by a node that was not added.
                Or the arguments are no topic and no message.
        """
        self._check_open()
        self._messaging.publish(topic, message, latched)

    def last(self, topic: str) -> Any:
        """Return the last message of a topic, as its subscriptions received it.

        Raises:
            LockstepError: No message was published on the topic.
        """
        self._check_open()
        return self._messaging.last(topic)

    def listen(self, message_type: type, topic: str, *, latched: bool = False) -> list[Any]:
        """Return a list to which the messages of a topic are appended.

        Args:
            message_type: Type of the topic.
            topic: Name of the topic.
            latched: Whether to include earlier messages of a latched topic.

        Raises:
            LockstepError: The topic has another type, or an argument is no type or no name.
        """
        self._check_open()
        return self._messaging.listen(message_type, topic, latched)

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
        return self._messaging.call(service_type, name, request, timeout)

    def report(self) -> str:
        """Return the last messages of all topics, and what faults did, as text."""
        scheduler = self._scheduler
        text = describe(
            scheduler.links.sources(), scheduler.nodes, scheduler.existing, self.now, self.world_time
        )
        text = '\n  '.join([text, *(process.describe() for process in self._processes)])
        return '\n'.join([text, *self._faults.describe()])

    # --- Faults

    def inject(self, *faults: Fault, seed: int = 0) -> None:
        """Inject faults. Their times count from the start of this `Lockstep`.

        Faults of one topic affect a message in the order in which they were injected. The random numbers
        of a fault depend on `seed` and the fault alone, not on other faults, unless they are equal.

        Args:
            faults: The faults, see `diffdrive_jacobian.faults`.
            seed: Seed of their random numbers.

        Raises:
            LockstepError: An argument is no fault, or a fault is over already.
        """
        self._check_open()
        self._faults.inject(faults, seed)

    @property
    def faults(self) -> list[Any]:
        """The faults that were injected."""
        return self._faults.faults

    @property
    def fault_events(self) -> list[FaultEvent]:
        """What the injected faults did so far."""
        return self._faults.events()

    def check_faults(self) -> None:
        """Check that every injected fault met something that it could affect.

        Raises:
            LockstepError: One did not, for example because the name of its topic is misspelt.
        """
        self._faults.check()

    # --- Properties

    def require(self, *properties: Property) -> None:
        """Require properties from now on, at each time step.

        A violation is raised as a PropertyViolation by the method that advanced time. The property is
        not required any longer afterwards.

        Args:
            properties: Objects such as `NeverFasterThan(0.5, 2.0)` of the package `properties`.

        Raises:
            LockstepError: An argument is not a property.
        """
        self._check_open()
        self._properties.require(self, properties)
        self._time.check = self._check

    def _check(self) -> None:
        try:
            self._properties.check()
        except PropertyViolation as violation:
            self.pauses.violated = violation
            raise

    def finish(self) -> None:
        """Check the properties at the end of a run. Nothing is required any longer afterwards.

        The fixture `lockstep` calls it at the end of a test that has passed.

        Raises:
            PropertyViolation: A property is violated: something that had to happen has not happened.
            LockstepError: A property observes a topic of which no node has had a publisher, or a service
                that no node has had, or a fault met nothing. A name may be misspelt.
        """
        self._check_open()
        self._time.check_threads()
        if self._properties:
            # Not otherwise: a test may have passed because a callback raises what it expects.
            self.settle()
        self._check_lost()
        self._properties.finish()
        self.check_faults()

    def expect(self, *names: str) -> None:
        """Expect that some node has a publisher of one of these topics, or one of these services.

        Called by properties. `finish` raises an error if none had.
        """
        self._properties.expect(names)

    def on_published(self, topic: str, observe: Callable[[Publisher, Any], None]) -> str:
        """Call a function with the publisher and the message after each message of a topic is published.

        The message is a `bytes` object if serialized bytes were published.

        Returns:
            The full name of the topic.
        """
        return self._properties.on_published(topic, observe)

    def on_delivered(self, topic: str, observe: Callable[[Node, Any, Any], None]) -> str:
        """Call a function with each message of a topic that the nodes receive, before their callbacks.

        The function receives the node, the type of the message, and the message, a `bytes` object if the
        subscription is raw.

        Returns:
            The full name of the topic.
        """
        return self._properties.on_delivered(topic, observe)

    def on_response(self, service: str, observe: Callable[[Node, Any], None]) -> str:
        """Call a function with the node and each response of a service, when the node has given it.

        A fault may delay the response on its way.

        Returns:
            The full name of the service.
        """
        return self._properties.on_response(service, observe)

    # --- Nodes in other processes

    def start(
        self,
        command: Sequence[str | os.PathLike[str]],
        *,
        use_sim_time: bool = True,
        cwd: str | os.PathLike[str] | None = None,
        env: Mapping[str, str] | None = None,
        clock_period: float = 0.01,
        queue_depth: int = 10,
        timeout: float = 30.0,
        patience: float = 5.0,
        wall_time: str = 'real',
        without: Collection[str] = (),
    ) -> NodeProcess:
        """Start a process, whose nodes take part as if they had been added.

        Only on Linux. A node of the world stands for each node of the process: `find` returns it. What
        that receives is sent to the process, which is then waited for until it is quiet. If such a node
        is removed or destroyed the process is ended, and a fault that kills it for a while starts the
        process again. The process receives the time before each message, and every `clock_period`. When
        the world is closed, it is ended with all that it has started.

        Args:
            command: The program and its arguments: `['ros2', 'run', 'my_package', 'my_node']`.
            use_sim_time: Whether to add `--ros-args -p use_sim_time:=true` to the command.
            cwd: Its working directory; None: that of this process.
            env: Further environment variables.
            clock_period: Period at which it receives the time (s). Its timers expire at multiples of it.
            queue_depth: Queue size of its subscriptions, which it does not tell.
            timeout: Longest time until its nodes have been discovered (s).
            patience: Longest time for a callback (s). For both, time during which it waited for a
                processor does not count.
            wall_time: `simulated` lets clocks, sleeps and timers on wall time follow the world, too. It
                needs a C compiler, once.
            without: Topics that stay in the process, such as `/diagnostics`.

        Returns:
            The process.

        Raises:
            LockstepError: It cannot be started, its nodes are not discovered in time, do not follow
                simulated time, or have a type that is not installed for Python. Or this is not Linux.
            ValueError: A duration is not positive, or too long.
        """
        self._check_open()
        check_platform()
        parameters = Command(
            command=command,
            use_sim_time=use_sim_time,
            cwd=cwd,
            env=env or {},
            clock_period=clock_period,
            queue_depth=queue_depth,
            timeout=timeout,
            patience=patience,
            wall_time=wall_time,
            without=without,
        )
        process = NodeProcess(
            parameters, self._nodes, self._scheduler, self._guard.extend, lambda: self.is_open
        )
        if self._guard.unlimited:
            process.be_patient()
        process.start()
        self._processes.append(process)
        process.join()
        self._time.arrive()
        return process

    @property
    def processes(self) -> list[NodeProcess]:
        """The processes that were started."""
        return list(self._processes)


def _refuse_init(*_: Any, **__: Any) -> None:
    """Raise the error of a second `rclpy.init`."""
    raise InitializedError(
        'lockstep has initialized rclpy: leave out rclpy.init() and rclpy.shutdown(), which belong into '
        'the main() of a program; ROS arguments: Lockstep(args=...), @pytest.mark.lockstep(args=...)'
    )
