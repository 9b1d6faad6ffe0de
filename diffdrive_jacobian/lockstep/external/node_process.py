"""A process whose nodes take part in a lockstep world, unchanged, each with a node that stands for it.

Each process has a ROS domain of its own, in which the world has an endpoint for each of its topics and
services. So no process receives what another one sends directly. Names stay, but for /clock and for
topics that several nodes of a process share: those are remapped below the name of each node. In the
world stands a `StandIn` for each of its nodes, with the same name, topics and services. What that
receives is sent to the process, one message at a time, and the world waits until the process is quiet.
What it has sent meanwhile is published by the stand-in. So faults, properties and recordings treat it as
any other node.
"""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.task import Future
from rosgraph_msgs.msg import Clock

from diffdrive_jacobian.lockstep._clock import MAX_SECONDS
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._gate import FREE
from diffdrive_jacobian.lockstep._link import Link, Source, Stage
from diffdrive_jacobian.lockstep._nodes import Nodes
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep._simulated_time import checked_nanoseconds
from diffdrive_jacobian.lockstep.external import graph as graphs
from diffdrive_jacobian.lockstep.external import relays
from diffdrive_jacobian.lockstep.external.datagrams import LIMIT, QUEUE, Datagrams, sockets_of
from diffdrive_jacobian.lockstep.external.process import CLOSING, ExternalProcess, free_domain
from diffdrive_jacobian.lockstep.external.quiet import (
    LONGEST,
    Allowance,
    Quiet,
    own_run_times,
    threads_of_this_process,
)
from diffdrive_jacobian.lockstep.external.relays import CALL, INPUT, SERVICE, TOPIC, Arrived, Relay
from diffdrive_jacobian.lockstep.external.wall_time import WALL_TIMES, WallTime
from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.messages.names import node_of
from diffdrive_jacobian.messages.topics import CLOCK
from diffdrive_jacobian.ros.fastdds_profiles import for_other_process
from diffdrive_jacobian.ros.rclpy_internals import (
    graph_changed,
    raw_sender,
    send_request,
    take_response,
)
from diffdrive_jacobian.ros.runner import DISCOVERY, environment, ros_context
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS

__tracebackhide__ = True

PERIOD = 0.01
"""Period at which the graph is looked at while a process starts (s)."""
REPETITION = 1.0
"""Period at which a request is repeated while a process starts (s): a response may be lost then."""
SILENCE = 0.2
"""Time for which a process that has started must not send anything by itself (s)."""
SUBSCRIBING = 3.0
"""Least time until a node must be subscribed to /clock (s): its name may be discovered before."""
STARTING = 0.3
"""Time that nodes need at most to spin, unless they sleep or wait before (s)."""
MATCHING = 5.0
"""Time after which a process is started again if endpoints that were discovered are not matched (s)."""
LOOP = 2.0
"""Longest time until an executor that waits with a timeout does so again (s)."""
UNCONFIRMED = 0.5
"""Time for nodes without parameter services to discover the endpoints of the world (s)."""
UNASKED = 100
"""Largest number of deliveries after which the graph is looked at, although nothing new was told."""
DESTRUCTION = 0.5
"""Time in which all entities of a node that is destroyed disappear, and a new one appears (s)."""
END = 2.0
"""Time in which a process ends after a process of its nodes has (s)."""
SYNCHRONOUS = {'RMW_FASTRTPS_PUBLICATION_MODE': 'SYNCHRONOUS'}
"""Environment of processes: a thread of Fast DDS would publish later what is published at once."""
SIMULATED = "start(..., wall_time='simulated')"
"""What lets a program that lives by wall time take part."""
BEFORE = NANOSECONDS
"""For how long before it takes part a process may have the time that it waits for to start (ns)."""
WAKES = 20
"""How often a process that is to end is woken up before real time goes on in it."""
STUCK = 2 * NANOSECONDS
"""World time after which a callback that waits without a timeout is an error (ns)."""
ATTEMPTS = 2
"""Number of starts, if another program comes into the domain, or endpoints are not matched."""


class UnmatchedError(LockstepError):
    """DDS does not match endpoints that have been discovered, as happens rarely."""


class ForeignNodeError(LockstepError):
    """There is a node in the domain that is in no process of the world."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """How a process is started: the arguments of `Lockstep.start`."""

    command: Sequence[str | os.PathLike[str]]
    use_sim_time: bool
    cwd: str | os.PathLike[str] | None
    env: Mapping[str, str]
    clock_period: float
    queue_depth: int
    timeout: float
    patience: float
    wall_time: str = WALL_TIMES[0]
    without: Collection[str] = ()

    def __post_init__(self) -> None:
        """Check the command."""
        command = [] if isinstance(self.command, (str, bytes, os.PathLike)) else self.command
        if not (isinstance(command, Sequence) and command and all(map(_is_text, command))):
            raise _error(
                "start takes a program and its arguments, ['ros2', 'run', 'my_package', 'my_node']",
                self.command,
            )
        if not (self.cwd is None or _is_text(self.cwd)):
            raise _error('cwd must be a path', self.cwd)
        if self.cwd is not None and not os.path.isdir(self.cwd):
            raise _error('cwd must be a folder that exists', self.cwd)
        if not isinstance(self.use_sim_time, bool):
            raise _error('use_sim_time must be True or False', self.use_sim_time)
        if not isinstance(self.env, Mapping) or not all(map(_is_variable, self.env.items())):
            raise _error("env must be names with texts, {'NAME': 'value'}", self.env)
        if any(self.env.get(name, value) != value for name, value in SYNCHRONOUS.items()):
            raise _error(f'env must not differ from {SYNCHRONOUS}: messages would be lost', self.env)
        depth = self.queue_depth
        if isinstance(depth, bool) or not isinstance(depth, int) or not 0 < depth < relays.DEPTH:
            raise _error(f'queue_depth must be an integer from 1 to {relays.DEPTH - 1}', depth)
        if isinstance(self.without, str) or not all(str(one).startswith('/') for one in self.without):
            raise _error("without must be names of topics, ['/diagnostics']", self.without)
        if self.wall_time not in WALL_TIMES:
            raise _error(f'wall_time must be {" or ".join(WALL_TIMES)}', self.wall_time)
        for name in ('clock_period', 'timeout', 'patience'):
            checked_nanoseconds(name, getattr(self, name))

    def start(self, environment: Mapping[str, str], rules: Sequence[str]) -> ExternalProcess:
        """Start the process, with environment variables for it, and further arguments."""
        timed = ('--ros-args', '-p', 'use_sim_time:=true') if self.use_sim_time else ()
        hash_seed = {} if 'PYTHONHASHSEED' in os.environ else {'PYTHONHASHSEED': '0'}
        return ExternalProcess(
            [*(os.fspath(part) for part in self.command), *timed],
            {**environment, **for_other_process(), **hash_seed, **SYNCHRONOUS, **self.env},
            None if self.cwd is None else os.fspath(self.cwd),
            rules,
        )


def _error(allowed: str, got: object) -> LockstepError:
    return LockstepError(f'{allowed}, got {printable(repr(got), 200)}')


def _is_text(value: Any) -> bool:
    """Return whether a value is a text, or a path, that can be passed to a process."""
    return isinstance(value, (str, os.PathLike)) and '\0' not in str(os.fspath(value))


def _is_variable(item: tuple[Any, Any]) -> bool:
    """Return whether a name and a value are those of an environment variable."""
    name, value = item
    if not (isinstance(name, str) and isinstance(value, str)):
        return False
    return bool(name) and '=' not in name and '\0' not in name + value


class StandIn(Node):  # type: ignore[misc]
    """A node of the world for a node of a process. If it is destroyed, the process is ended."""

    def __init__(self, graph: graphs.NodeGraph, end: Callable[[StandIn], None]) -> None:
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


class NodeProcess:
    """A process with nodes in the world, as of `Lockstep.start`. It is ended with the world."""

    def __init__(
        self,
        command: Command,
        nodes: Nodes,
        scheduler: Scheduler,
        extend: Callable[[float], None],
        is_open: Callable[[], bool],
    ) -> None:
        """Start nothing yet.

        Args:
            command: How to start it.
            nodes: The nodes of the world.
            scheduler: Executes the nodes.
            extend: Receives the wall time (s) that was spent waiting for the process.
            is_open: Returns whether the world was not closed.
        """
        self._command, self._nodes, self._scheduler = command, nodes, scheduler
        self._extend, self._is_open = extend, is_open
        self._clocks = scheduler.clocks
        self._ended: list[ExternalProcess] = []
        self._names: set[str] = set()
        """Of all nodes that it has had."""
        self._apart = {CLOCK} if command.use_sim_time else set[str]()
        """Topics of which each of its nodes has its own."""
        self._closing = ExitStack()
        self._reset()
        self._scheduler.links.filter(self._drop_echoes, first=True)
        self._nodes.on_change.append(self._on_change)
        self.child: ExternalProcess

    def _reset(self) -> None:
        self._connected = False
        self._stand_ins: dict[str, StandIn] = {}
        self._relays: dict[tuple[int, str], Relay] = {}
        self._topics: dict[tuple[StandIn, str], str] = {}
        """Names in the domain of the process, by those in the world."""
        self._lasting: list[Arrived] = []
        self._calls: list[Arrived] = []
        self._unanswered: set[Future] = set()
        self._held: list[Callable[[], object]] = []
        self._qualities: dict[tuple[int, str], set[graphs.Quality]] = {}
        self._sent: dict[str, list[bytes]] = {}
        self._clock_publishers: dict[str, Publisher] = {}
        self._clock_owners: dict[str, StandIn] = {}
        self._marks: dict[str, bytes] = {}
        """What differs if a node is created anew."""
        self._participants: set[int] = set()
        self._called: dict[str, tuple[str, StandIn]] = {}
        self._services_changed = True
        self._given = -1
        self._before = -BEFORE
        self._exchanges = 0
        self._listeners: list[int] = []
        self._listened: list[int] = []
        self._wall_time: WallTime | None = None
        self._wakes = 0
        self._wall_begin = 0
        """Wall time when the world began (ns)."""
        self._sleepers: set[int] = set()
        """Threads that sleep in an idle process."""
        self._stuck: int | None = None
        """World time since which a callback has not returned (ns)."""
        self._cpp_threads = 0
        """Largest number of threads of the executors of a process in C++."""
        self._planned = 0
        """World time at which wall time goes on for somebody (ns)."""

    # --- What the test sees

    @property
    def nodes(self) -> list[Node]:
        """The nodes of the world that stand for those of the process."""
        return list(self._stand_ins.values())

    @property
    def pid(self) -> int:
        """Process id."""
        return self.child.pid

    @property
    def returncode(self) -> int | None:
        """Exit code, negative if a signal ended it. None: it runs. Its children end with it."""
        return self.child.returncode

    @property
    def stdout(self) -> str:
        """What it has printed on the standard output, also before a fault has started it again."""
        return ''.join(one.printed(0) for one in (*self._ended, self.child))

    @property
    def stderr(self) -> str:
        """What it has printed on the standard error stream, as `stdout`."""
        return ''.join(one.printed(1) for one in (*self._ended, self.child))

    @property
    def command(self) -> str:
        """The command line."""
        return self.child.command

    def signal(self, number: int) -> None:
        """Send a signal to it and its children. Nothing happens if it has ended."""
        self.child.signal(number)

    def stop(self, timeout: float = CLOSING) -> int:
        """End it by SIGINT, and kill it if it does not end. Return the exit code.

        What it publishes then is received by the others, unless it ends at the same moment. A fault does
        not start it again.

        Args:
            timeout: Longest time for its end (s).
        """
        checked_nanoseconds('timeout', timeout)
        self._forget()
        code = self._stop(timeout)
        self._scheduler.forget_destroyed()
        return code

    def _stop(self, timeout: float = CLOSING) -> int:
        code = self.child.stop(timeout)
        if self._connected:
            self._wait()
            self._forward(self._take())
            self.check_lost(now=True)
        self._leave()
        return code

    def kill(self) -> None:
        """Kill it. Nothing that was sent to it is processed, and a fault does not start it again."""
        self._forget()
        self._kill()
        self._scheduler.forget_destroyed()

    def _kill(self) -> None:
        self._scheduler.killed.update(self._stand_ins.values())
        self.child.kill()
        self._leave()

    def _wake(self) -> None:
        """Send the time that the nodes have, for nothing but to wake them up, so that they end."""
        self._wakes += 1
        # First it notices the signal, and then who sleeps looks whether to go on.
        if self._wall_time is not None and self._wakes > WAKES:
            self._wall_time.end()
        if self._connected:
            self._send_time()

    def _send_time(self, offset: int = 0) -> None:
        for publisher in self._clock_publishers.values():
            raw_sender(publisher)(self._time_message(max(1, self._clocks.now + offset)))

    def _forget(self) -> None:
        """Do not let a fault start it again."""
        for name in self._names:
            self._nodes.forget(name)

    def describe(self) -> str:
        """Return its state, and the end of what it printed."""
        return self.child.describe()

    # --- Start and end

    def start(self) -> list[StandIn]:
        """Start the process, wait until its nodes are discovered, and return their stand-ins.

        Raises:
            LockstepError: They are not within the timeout, or cannot take part.
        """
        if hasattr(self, 'child'):
            self.child.close()
            self._ended.append(self.child)
        with self._uncounted():
            self._launch_and_connect()
        return list(self._stand_ins.values())

    def _launch_and_connect(self) -> None:
        attempt = 0
        while True:
            try:
                self._launch()
                self._connect(MATCHING if attempt < ATTEMPTS - 1 else math.inf)
                # Others may have been discovered meanwhile.
                self._learn()
                if not self._share_topics():
                    break
                # Again, with topics of their own.
                self.close()
            except BaseException as error:
                self.close()
                attempt += 1
                if not isinstance(error, (ForeignNodeError, UnmatchedError)) or attempt == ATTEMPTS:
                    raise

    def _launch(self) -> None:
        """Start the process, and create what is needed to receive from it."""
        self._domain = free_domain()
        domain = {DISCOVERY[0]: 'LOCALHOST', 'ROS_DOMAIN_ID': str(self._domain)}
        before, others = threads_of_this_process(), sockets_of(os.getpid())
        with environment({**dict.fromkeys(DISCOVERY), **domain}):
            context = self._closing.enter_context(ros_context(['lockstep']))
        self._outside = Node(
            'lockstep_of_world',
            context=context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter('start_type_description_service', value=False)],
        )
        self._closing.callback(self._outside.destroy_node)
        receiving = threads_of_this_process() - before
        if self._command.wall_time == 'simulated':
            self._wall_time = WallTime(self._clocks.now)
            self._closing.callback(self._wall_time.close)
            domain |= self._wall_time.environment()
        self.child = self._command.start(domain, graphs.rules_apart(sorted(self._apart)))
        self.child.wake = self._wake
        self._quiet = Quiet(self.child.root, receiving)
        self._closing.callback(self._quiet.close)
        self.child.check_addresses()
        self._listeners = self._quiet.listeners()
        self._datagrams = Datagrams()
        self._datagrams.watch(os.getpid(), but=others)

    def join(self) -> None:
        """Add the nodes to the world. They receive the time."""
        self._add_nodes()
        self._connected = True
        if self._wall_time is not None:
            self._wall_begin = self._wall_time.steady - self._scheduler.agenda.now
            self._planned = 0
            self._plan()
        (first, *_) = self._stand_ins.values()
        first.create_timer(self._command.clock_period, self._give_time)
        first.executor.create_task(self._begin)

    def _add_nodes(self) -> None:
        for name, node in self._stand_ins.items():
            self._nodes.created(node, partial(self._restart, name))
            self._names.add(name)
            if node not in self._scheduler.nodes:
                self._nodes.check_new(node)
                self._nodes.add(node, observer=False)

    def _begin(self) -> None:
        """Forward what the process has sent before it took part, and give it the time."""
        lasting, self._lasting = self._lasting, []
        self._forward(lasting)
        self._give_time()

    def _restart(self, name: str) -> Node:
        """Start the process again, after a fault has killed it. Return the node of a name."""
        stand_ins = self.start()
        found = next((one for one in stand_ins if one.get_fully_qualified_name() == name), None)
        if found is None:
            raise LockstepError(f'{self.child.title} was started again, and has no node {name} now')
        self.join()
        return found

    def _on_destroyed(self, stand_in: StandIn) -> None:
        """End the process: a test or a fault has destroyed one of its nodes."""
        if not self._is_open() or stand_in not in self._stand_ins.values():
            return
        if stand_in in self._scheduler.killed:
            self._kill()
        else:
            self._stop()

    def _leave(self) -> None:
        """Remove the nodes from the world."""
        nodes, ended = self.nodes, self._relays
        self._reset()
        for node in nodes:
            node.destroy_node()
        for relay in ended.values():
            relay.close()
        self._closing.close()

    def close(self) -> None:
        """Kill the process if it has not ended, and forget its nodes."""
        if hasattr(self, 'child'):
            self.child.kill()
            self.child.close()
        self._leave()

    # --- Discovery

    def _connect(self, matching: float = math.inf) -> None:
        """Wait until the nodes of the process and the world have discovered each other.

        Args:
            matching: Longest time until what is discovered is matched, too (s).

        Raises:
            UnmatchedError: That has passed.
            LockstepError: They have not discovered each other, or cannot take part.
        """
        allowance = Allowance(self._quiet, self._command.timeout)
        matched_by: Allowance | None = None
        subscribing: Allowance | None = None
        begin = time.monotonic()
        while True:
            while not (self._learn() and self._is_matched()):
                self.child.check_running()
                if allowance.is_used_up():
                    raise LockstepError(self._not_discovered())
                if self._stand_ins:
                    matched_by = matched_by or Allowance(self._quiet, matching)
                    if matched_by.is_used_up():
                        raise UnmatchedError(self._not_discovered())
                elif time.monotonic() > begin + STARTING:
                    self._sleep_on()
                time.sleep(PERIOD)
            known = len(self._relays)
            self._confirm(allowance)
            graph_changed(self._outside)
            if self._learn() and len(self._relays) == known:
                if not (untimed := self._untimed()):
                    break
                subscribing = subscribing or Allowance(self._quiet, SUBSCRIBING)
                if subscribing.is_used_up():
                    raise LockstepError(
                        f'{", ".join(untimed)} of {self.child.title} is not subscribed to /clock: its '
                        'parameter use_sim_time must be true; if it needs no time: '
                        'start(..., use_sim_time=False)'
                    )
                time.sleep(SILENCE)
        self._wait()
        self._check_order()
        # A node may wait for something before it spins, with a timeout.
        looping = Allowance(self._quiet, LOOP)
        self._quiet.learn()
        while not (self._quiet.loops or looping.is_used_up()):
            time.sleep(PERIOD)
            self._wait()
            self._quiet.learn()
        # Others than latched ones came before anybody could be subscribed.
        self._lasting = [arrived for arrived in self._take() if arrived.lasting]
        time.sleep(SILENCE)
        self._wait()
        late = self._take()
        self._lasting += [arrived for arrived in late if arrived.lasting]
        self._refuse([arrived for arrived in late if not arrived.lasting])
        self._quiet.learn()
        for pid in self._participants:
            self._datagrams.watch(pid)
        if self._wall_time is not None:
            self._wall_time.check(self.child.title)
            self._wall_time.check_loaded(self._participants)
            self._sleepers = self._wall_time.sleeping()
        self._marks = graphs.marks(self._outside)
        self.child.note_shared_memory(self._participants)
        there = {topic for topic, _ in self._outside.get_topic_names_and_types()}
        if not self._connected and (unknown := sorted(set(self._command.without) - there)):
            raise LockstepError(f'{self.child.title} has no topic {", ".join(unknown)} (without=)')
        self._warn()

    def _warn(self) -> None:
        """Warn of what may differ from run to run without an error."""
        asleep = self._wall_time.sleeping() if self._wall_time is not None else ()
        pids = self._participants
        threads = max((self._quiet.cpp_executor_threads(pid, asleep) for pid in pids), default=0)
        self._cpp_threads = threads
        why = ''
        if threads > 1:
            why = 'an executor with several threads may execute callbacks at the same time'
        elif threads and len(self._stand_ins) > 1:
            why = 'rclcpp calls timers of one of several nodes that are due at once in any order'
        elif self._quiet.polls_files:
            why = (
                'a thread waits for files with a timeout, as an event loop of asyncio, and what it does '
                'by itself is not waited for'
            )
        if threads and self._quiet.timed_executors and self._wall_time is None and not self._connected:
            self._warn_of('its executor waits with a timeout, as with a timer of create_wall_timer', 7)
        if why and not self._connected:
            warnings.warn(f'{self.child.title}: {why}; check_repeats shows it', stacklevel=6)

    def _share_topics(self) -> bool:
        """Return whether several nodes of the process have a topic that they need not share.

        Which of them receives a message, or the time, first would differ.

        Raises:
            LockstepError: They share one although they were given topics of their own.
        """
        found = graphs.nodes_beside(self._outside, self._command.without)
        shared = graphs.shared_topics(found)
        if not shared:
            return False
        if self._connected or not self._apart.isdisjoint(shared):
            raise LockstepError(
                f'several nodes of {self.child.title} share {", ".join(shared)}, which cannot be '
                'separated: the command remaps it itself, or it was created after the start; which of '
                'them receives a message first would differ: start each node by itself, and load each '
                'component into a container of its own'
            )
        self._apart |= {graph.name_in_world(topic) for graph in found for topic in graph.topics}
        return True

    def _check_order(self) -> None:
        """Check that every message is received once, so that the order of callbacks is determined.

        Raises:
            LockstepError: It is not.
        """
        clocks = {(node, CLOCK): name for name, node in self._clock_owners.items()}
        for (stand_in, topic), name in {**self._topics, **clocks}.items():
            infos = self._outside.get_subscriptions_info_by_topic(name)
            owner = stand_in.get_fully_qualified_name()
            if (number := sum(node_of(info) == owner for info in infos)) > 1:
                raise LockstepError(
                    f'{owner} has {number} subscriptions to {topic}: which of them receives a message '
                    'first differs from run to run; it may have one for each topic'
                )

    def _is_matched(self) -> bool:
        """Return whether the world has discovered all endpoints of the process."""
        return all(relay.is_matched() for relay in self._relays.values()) and all(
            publisher.get_subscription_count() for publisher in self._clock_publishers.values()
        )

    def _learn(self) -> bool:
        """Create what the topics and services of the process need. Return whether it has nodes."""
        found = graphs.nodes_beside(self._outside, self._command.without)
        if len({graph.full_name for graph in found}) < len(found):
            names = [graph.full_name for graph in found]
            raise LockstepError(
                f'several nodes of {self.child.title} have the name '
                f'{", ".join(sorted({name for name in names if names.count(name) > 1}))}'
            )
        offered = {name for graph in found for name in graph.services}
        for graph in found:
            self._check_started_by_world(graph)
            name = graph.full_name
            if name not in self._stand_ins:
                self._stand_ins[name] = StandIn(graph, self._on_destroyed)
            node = self._stand_ins[name]
            self._learn_topics(graph, node)
            for service, kind in graph.services.items():
                self._relay(SERVICE, service, kind, node, relays.offered_service, self._deliver)
            for service, kind in graph.clients.items():
                # A request to a service that does not know its client yet would be lost.
                known = self._outside.get_publishers_info_by_topic(f'rq{service}Request', no_mangle=True)
                if service not in offered and known:
                    self._called.setdefault(service, (kind, node))
        self._offer_called()
        return bool(found)

    def _learn_topics(self, graph: graphs.NodeGraph, node: StandIn) -> None:
        outside, name = self._outside, graph.full_name
        for own, kind in graph.publishers.items():
            topic = graph.name_in_world(own)
            self._topics[node, topic] = own
            infos = outside.get_publishers_info_by_topic(own)
            profile = self._profile(TOPIC, own, graphs.qualities_of(infos, name), relays.DEPTH)
            sent = self._sent.setdefault(own, [])
            self._relay(TOPIC, own, kind, node, relays.from_topic, topic, profile, sent)
        for own, kind in graph.subscriptions.items():
            topic = graph.name_in_world(own)
            if kind == graphs.CLOCK_TYPE and topic.rpartition('/')[2] == 'clock':
                if own not in self._clock_publishers:
                    self._clock_publishers[own] = outside.create_publisher(Clock, own, 1)
                    self._clock_owners[own] = node
                continue
            self._topics[node, topic] = own
            depth = self._command.queue_depth
            infos = outside.get_subscriptions_info_by_topic(own)
            profile = self._profile(INPUT, own, graphs.qualities_of(infos, name), depth)
            sent = self._sent.setdefault(own, [])
            self._relay(
                *(INPUT, own, kind, node, relays.to_topic),
                *(topic, profile, self._deliver, sent, self._command.patience),
            )

    def _profile(
        self, role: int, topic: str, qualities: Iterable[graphs.Quality], depth: int
    ) -> QoSProfile:
        """Return the profile of a topic, whose depth the graph does not show.

        Raises:
            LockstepError: There are several.
        """
        known = self._qualities.setdefault((role, topic), set())
        known |= set(qualities)
        (quality, *others) = known
        if others:
            raise LockstepError(
                f'{self.child.title} uses {topic} with several qualities of service, at once or one '
                f'after the other: {", ".join(sorted(map(str, known)))}; a process may use one for each '
                'topic'
            )
        return quality.profile(depth)

    def _relay(
        self, role: int, name: str, kind: str, node: StandIn, create: Callable[..., Relay], *args: Any
    ) -> None:
        """Create a relay unless it is there. DDS does not promise an order between topics: by name."""
        if (role, name) not in self._relays:
            imported = graphs.import_type(kind, f'{name} of {node.get_fully_qualified_name()}')
            self._relays[role, name] = create(self._outside, node, name, imported, *args)
            self._relays = dict(sorted(self._relays.items()))

    def _on_change(self) -> None:
        self._services_changed = True

    def _offer_called(self) -> None:
        """Offer the process the services that it calls and that other nodes of the world have."""
        self._services_changed = False
        there = {
            service.service_name
            for node in self._scheduler.nodes
            if node not in self._stand_ins.values()
            for service in node.services
        }
        for key in [(role, name) for role, name in self._relays if role == CALL and name not in there]:
            self._relays.pop(key).close()
        for name, (kind, node) in self._called.items():
            if name in there:
                self._relay(
                    *(CALL, name, kind, node, relays.called_service),
                    *(self._respond, self._unanswered),
                )

    def _check_started_by_world(self, graph: graphs.NodeGraph) -> None:
        """Check that a node is in the process or one that it has started."""
        infos = [
            info
            for topic in graph.publishers.keys() | graph.subscriptions.keys()
            for info in (
                *self._outside.get_publishers_info_by_topic(topic),
                *self._outside.get_subscriptions_info_by_topic(topic),
            )
            if node_of(info) == graph.full_name
        ]
        numbers = {int.from_bytes(bytes(info.endpoint_gid)[graphs.PID], 'little') for info in infos}
        pids = {pid for pid in self._quiet.processes() if pid & 0xFFFF in numbers}
        if numbers and not pids:
            raise ForeignNodeError(
                f'node {graph.full_name} is in domain {self._domain}, but in no process that '
                f'{self.child.title} has started and that runs on: a container or another machine '
                'cannot take part in lockstep'
            )
        self._participants |= pids
        if len(self._participants) > 1:
            raise LockstepError(
                f'{self.child.title} has started several processes with nodes: '
                f'{", ".join(map(str, sorted(self._participants)))}; start each of them by itself, '
                'because messages between them would not be received one at a time'
            )

    def _confirm(self, allowance: Allowance) -> None:
        """Wait until the nodes respond, which shows that they have discovered what the world has.

        They discover endpoints in the order of their creation, so those of new clients come last.
        """
        names = [
            relay.client.service_name
            for relay in self._relays.values()
            if relay.client is not None and relay.client.srv_type is GetParameters
        ]
        for name in names:
            self._await_response(name, allowance)
        if len(names) < len(self._stand_ins):
            known = len(self._relays)
            time.sleep(UNCONFIRMED)
            self._learn()
            if len(self._relays) == known:
                self._wait()

    def _await_response(self, name: str, allowance: Allowance) -> None:
        """Ask a node for a parameter until it has responded to the last request, so to all of them."""
        client = self._outside.create_client(GetParameters, name)
        begin, periods, number, response = time.monotonic(), 0, 0, None
        while not number or response is None or response[0] != number:
            self.child.check_running()
            if allowance.is_used_up():
                raise LockstepError(
                    f'{name} does not respond: the executor of the node does not spin, or waits for '
                    'what comes later, as a service in its constructor (a node that is spun in '
                    'callbacks only needs start_parameter_services=False); '
                    f'{self._quiet.describe()}\n{self.describe()}'
                )
            if graph_changed(self._outside):
                # The node may wait for a service of the world before it spins.
                self._learn()
            passed = time.monotonic() - begin
            if number and passed > STARTING:
                self._sleep_on()
            if passed > periods * REPETITION and client.service_is_ready():
                periods += 1
                if response is None:
                    number = send_request(client, GetParameters.Request(names=['use_sim_time']))
                self._wait()
                if periods > 1 and not self._spins():
                    # A loop may wait for the time, as by a Rate on the clock of the node.
                    self._before = min(self._before + BEFORE // 20, 0)
                    self._send_time(self._before)
            time.sleep(PERIOD / 10)
            response = take_response(client) or response
        self._outside.destroy_client(client)

    def _sleep_on(self) -> None:
        """Let a process that sleeps before its nodes spin go on, in simulated wall time."""
        if self._wall_time is None or not self._quiet.is_quiet() or self._spins():
            return
        if self._wall_time.sleep_on():
            self._wait()

    def _spins(self) -> bool:
        return self._quiet.spins() if self._wall_time is None else self._wall_time.spins

    def _untimed(self) -> list[str]:
        """Return the nodes that should receive the time and do not, as far as is discovered."""
        timed = {
            node_of(info)
            for topic in self._clock_publishers
            for info in self._outside.get_subscriptions_info_by_topic(topic)
        }
        return sorted(self._stand_ins.keys() - timed) if self._command.use_sim_time else []

    def _check_present(self) -> None:
        """Check that the nodes of a process that runs are those that were there before.

        Raises:
            LockstepError: They are not, or do not follow simulated time any more.
        """
        end, before = time.monotonic() + DESTRUCTION, set(self._marks)
        while not (gone := self._gone()) and (untimed := self._untimed()):
            if time.monotonic() > end:
                names = ', '.join(untimed)
                if before.issuperset(untimed):
                    raise LockstepError(f'{names} has stopped to follow simulated time')
                raise LockstepError(
                    f'{names} does not follow simulated time: its parameter use_sim_time must be true; '
                    'a component has it from the request that loads it (LoadNode, parameters), not from '
                    'its container'
                )
            # A node that is destroyed loses its entities one by one.
            time.sleep(PERIOD)
        if gone:
            raise LockstepError(
                f'{", ".join(gone)} was destroyed, or created anew, while {self.child.title} runs: what '
                'is sent meanwhile would be lost or not, from run to run. In lockstep a process keeps '
                'its nodes until it ends; Kill, or stop() and start(), create them anew'
            )

    def _gone(self) -> list[str]:
        """Return the nodes that were destroyed, or created anew, since this was last asked."""
        there = {graph.full_name for graph in graphs.nodes_beside(self._outside, self._command.without)}
        marks = graphs.marks(self._outside)
        anew = {name for name, mark in marks.items() if self._marks.get(name, mark) != mark}
        self._marks = {**self._marks, **marks}
        return sorted(name for name in self._stand_ins if name in anew or name not in there)

    def _not_discovered(self) -> str:
        waited = f'within {self._command.timeout:g} s (timeout=)'
        missing = [name for (_, name), relay in self._relays.items() if not relay.is_matched()]
        if missing:
            return (
                f'{self.child.title}: not discovered {waited}: {", ".join(missing)}\n{self.describe()}'
            )
        hint = 'it has created none, or not yet'
        if others := _domains(self._quiet.processes()) - {self._domain}:
            hint = (
                f'it is in ROS domain {", ".join(map(str, sorted(others)))} instead of {self._domain}: '
                'it must not set ROS_DOMAIN_ID, which start() sets for it'
            )
        return f'no node of {self.child.title} was discovered {waited}: {hint}\n{self.describe()}'

    # --- Exchange

    def _deliver(self, send: Callable[[], object]) -> None:
        """Give the process the time, send something to it, and forward what it sends meanwhile."""
        self._give_time()
        self._exchange(send)

    def _give_time(self) -> object:
        """Give the process the time, unless it has it. Return FREE if it has sent nothing."""
        now, wall = self._clocks.now, self._wall_begin + self._scheduler.agenda.now
        sent = 0
        if self._wall_time is not None:
            self._wall_time.give(wall, now)
        if now != self._given:
            self._given = now
            data = self._time_message(now)
            # One after the other, so that the nodes of a process do not act at the same time.
            for publisher in self._clock_publishers.values():
                sent += self._exchange(partial(raw_sender(publisher), data))
        while self._wall_time is not None and (first := self._wall_time.next()) and first[0] <= wall:
            sent += self._exchange(partial(self._wall_time.let_go_on, first[1]))
        self._check_callbacks()
        return None if sent else FREE

    def _check_callbacks(self) -> None:
        """Check that callbacks return, unless they wait for a response or, by a timeout, for time."""
        asleep = self._wall_time.sleeping() if self._wall_time is not None else set[int]()
        # Threads that sleep in an idle process, too, end no callback of it: as one that writes logs.
        waits, now = bool(asleep - self._sleepers), self._scheduler.agenda.now
        if not self._connected or waits or self._unanswered or not self._quiet.stuck():
            self._stuck = None
        elif self._stuck is None:
            self._stuck = now
        elif now - self._stuck >= STUCK:
            raise LockstepError(
                f'a callback of {", ".join(self._stand_ins)} has not returned since '
                f'{self._stuck / NANOSECONDS:g} s: it waits, without a timeout, for something else than '
                'a message of the world, as for a mutex that is locked twice\n' + self.describe()
            )
        if self._cpp_threads and self._quiet.new_thread_waits and self._wall_time is None:
            self._cpp_threads = 0
            self._warn_of('a thread that it has started meanwhile waits with a timeout, as by a Rate')

    def _warn_of(self, what: str, stacklevel: int = 6) -> None:
        warnings.warn(
            f'{self.child.title}: {what}: that is wall time, so what it does differs from run to run; '
            f'{SIMULATED}',
            stacklevel=stacklevel,
        )

    def _plan(self) -> None:
        """Let the process go on when the time has come for which it waits."""
        if self._wall_time is None or (first := self._wall_time.next()) is None:
            return
        agenda, at = self._scheduler.agenda, first[0] - self._wall_begin
        if at != self._planned and agenda.now < at < MAX_SECONDS * NANOSECONDS:
            self._planned = at
            agenda.at(at, self._go_on)

    def _go_on(self) -> None:
        if self._connected and self._planned == self._scheduler.agenda.now:
            (first, *_) = self._stand_ins.values()
            first.executor.create_task(self._give_time)

    @staticmethod
    def _time_message(now: int) -> bytes:
        message = Clock()
        set_time(message.clock, now)
        return bytes(serialize_message(message))

    def _respond(self, send: Callable[[], object]) -> None:
        """Send a response to the process, and what had to wait for that."""
        held, self._held = self._held, []
        for one in (send, *held):
            self._exchange(one, response=one is send)

    def _exchange(self, send: Callable[[], object], *, response: bool = False) -> int:
        """Send something to the process, wait until it is quiet, and forward what it has sent.

        Args:
            send: Sends it.
            response: Whether it is a response. Others are held while a callback waits for one.

        Returns:
            How many messages it has sent.
        """
        if not self._connected:
            return 0
        if self._quiet.waits_in_callback:
            self._check_waits()
            if not response:
                self._held.append(send)
                return 0
        with self._uncounted():
            if self._services_changed:
                known = set(self._relays)
                self._offer_called()
                if self._relays.keys() - known:
                    # The process may call them at once.
                    self._confirm(Allowance(self._quiet, self._command.timeout))
                    self._wait()
            self._refuse(self._take())
            send()
            self._wait()
            if self._wall_time is not None:
                self._wall_time.check(self.child.title)
            arrived = self._take()
            self.check_lost()
            for sent in self._sent.values():
                sent.clear()
        self._forward(arrived)
        if any(map(self._quiet.has_ended, (self.child.root, *self._participants))):
            self._on_end()
        elif self._may_have_changed() and graph_changed(self._outside):
            self._learn_more()
        self._plan()
        return len(arrived)

    def _may_have_changed(self) -> bool:
        """Return whether the process may have told something new of its nodes: to ask takes time."""
        self._exchanges += 1
        before, self._listened = self._listened, own_run_times(self._listeners)
        return before != self._listened or not self._listeners or self._exchanges % UNASKED == 0

    def _learn_more(self) -> None:
        """Create what is needed for topics and services that the process has created meanwhile."""
        known = len(self._relays)
        self._learn()
        self._share_topics()
        self._check_order()
        self._check_present()
        if len(self._relays) > known:
            self._connect()
            self._add_nodes()
            lasting, self._lasting = self._lasting, []
            self._forward(lasting)

    def _wait(self, asks: Callable[[], bool] | None = None) -> None:
        """Wait until the process and the threads that receive from it are quiet."""
        try:
            self._quiet.wait(self._command.patience, asks or self._asks)
        except LockstepError as error:
            if self._wall_time is not None:
                self._wall_time.check(self.child.title)
            if self._connected:
                # What it did may be the cause.
                self._check_present()
            names = ', '.join(self._stand_ins) or self.child.title
            if self._wall_time is None:
                remedy = f'a loop or a thread that sleeps or waits on wall time: {SIMULATED}'
            else:
                remedy = (
                    'a loop that polls cannot run in lockstep, also in a program that it has started'
                )
            raise LockstepError(
                f'{names} {error}\n  {remedy}; a callback that takes longer: start(..., patience=)\n'
                + self.describe()
            ) from None

    @contextmanager
    def _uncounted(self) -> Iterator[None]:
        """Let wall time pass that is not that of callbacks in this process. It has limits of its own."""
        begin, longest = time.monotonic(), LONGEST * max(self._command.patience, self._command.timeout)
        self._extend(longest)
        try:
            yield
        finally:
            self._extend(time.monotonic() - begin - longest)

    def _check_waits(self) -> None:
        """Check that a callback which waits for a response of the world still does."""
        with self._uncounted():
            self._wait()
        if not self._quiet.waits_in_callback:
            raise LockstepError(
                f'a callback of {", ".join(self._stand_ins)} waited for the response of a service until '
                f'its timeout, which is wall time, at {self._clocks.now / NANOSECONDS:g} s: this '
                'machine is too slow\n' + self.describe()
            )

    def _asks(self) -> bool:
        """Return whether the process waits for responses of the world."""
        for (role, _), relay in self._relays.items():
            if role == CALL:
                self._calls += relay.take()
        return bool(self._calls or self._unanswered)

    def _take(self) -> list[Arrived]:
        """Return what has arrived: messages by the names of their topics, responses, requests."""
        calls, self._calls = self._calls, []
        try:
            return [*(arrived for relay in self._relays.values() for arrived in relay.take()), *calls]
        except LockstepError:
            # Datagrams that the system has counted as lost are the cause, and have another remedy.
            self.check_lost(now=True)
            raise

    @staticmethod
    def _forward(arrived: Sequence[Arrived]) -> None:
        for one in arrived:
            one.forward()

    def check(self) -> bool:
        """Check that it runs, lost nothing, and has sent nothing while nothing was delivered to it.

        Returns:
            Whether it does something still: a callback waits for a response that does not come now.
        """
        if not self._connected:
            return False
        self.child.check_running(', '.join(self._stand_ins))
        if self._quiet.waits_in_callback:
            next(iter(self._stand_ins.values())).executor.create_task(self._end_waits)
            return True
        self._refuse(self._take())
        self.check_lost()
        return False

    def _end_waits(self) -> None:
        """Wait until callbacks that wait for responses have waited in vain, and go on."""
        with self._uncounted():
            self._wait(lambda: False)
        held, self._held = self._held, []
        self._forward(self._take())
        self.check_lost()
        for send in held:
            self._exchange(send)

    def check_lost(self, *, now: bool = False) -> None:
        """Raise LockstepError if messages between the world and the process are known to be lost.

        Args:
            now: Whether to look, even if that was done just before.
        """
        if self._connected and self._datagrams.lost(now=now):
            raise LockstepError(
                f'messages to or from {", ".join(self._stand_ins)} were lost at '
                f'{self._clocks.now / NANOSECONDS:g} s or before: more was sent at once than a socket '
                f'can hold; {LIMIT} allows {Path(LIMIT).read_text().strip()} bytes, and may need '
                f'{QUEUE}: sysctl -w net.core.rmem_max={QUEUE}'
            )

    def _refuse(self, arrived: Sequence[Arrived]) -> None:
        """Raise LockstepError if something has arrived."""
        if arrived:
            # What was lost is sent again, later.
            self.check_lost(now=True)
            names = ', '.join(self._stand_ins)
            what = ', '.join(dict.fromkeys(one.what for one in arrived))
            raise LockstepError(
                f'{names} {what} at {self._clocks.now / NANOSECONDS:g} s, while nothing was delivered '
                'to it: what it sends then differs from run to run. Likely '
                f'{"" if self._command.use_sim_time else "use_sim_time=False, "}a timer on wall time '
                '(create_wall_timer), a thread of its own, or a callback that had not ended, because it '
                'waited for something else than a message'
                f'{"; " + SIMULATED if self._wall_time is None else ""}\n' + self.describe()
            )

    def _on_end(self) -> None:
        """Note that the process has ended while something was delivered to it."""
        allowance = Allowance(self._quiet, END)
        while (code := self.child.returncode) is None and not allowance.is_used_up():
            time.sleep(PERIOD)
        if code == 0:
            self._leave()
            return
        self.child.check_running(', '.join(self._stand_ins))
        raise LockstepError(f'a node of {self.describe()}\n  has ended')

    def _drop_echoes(self, end: Source | Link) -> Stage | None:
        """Return the stage that keeps from the process what it has received directly."""
        if not isinstance(end, Link) or end.owner not in self._stand_ins.values():
            return None
        name = self._topics.get((end.owner, end.topic), '')
        if (TOPIC, name) not in self._relays:
            return None
        own = [node for (node, topic), other in self._topics.items() if other == name]
        return relays.without_echo(
            self._scheduler.links.observers_of_published(end.topic).append,
            lambda publisher: any(publisher in node.publishers for node in own),
        )


def _domains(pids: Sequence[int]) -> set[int]:
    """Return the ROS domains in which processes receive, by their UDP ports."""
    sockets = set()
    for pid in pids:
        for descriptor in Path(f'/proc/{pid}/fd').glob('*'):
            try:
                sockets.add(os.readlink(descriptor))
            except OSError:
                continue
    found = set()
    for line in Path('/proc/net/udp').read_text().splitlines()[1:]:
        words = line.split()
        port = int(words[1].rpartition(':')[2], 16)
        # Lower ones are no ports of discovery, higher ones are given to clients.
        if f'socket:[{words[9]}]' in sockets and 7400 <= port < 32768:
            found.add((port - 7400) // 250)
    return found
