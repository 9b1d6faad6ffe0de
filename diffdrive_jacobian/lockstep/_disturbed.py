"""Faults in a lockstep world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from diffdrive_jacobian.lockstep._errors import IneffectiveFaultsError, LockstepError
from diffdrive_jacobian.lockstep._fault_log import TOPIC, FaultEvent, FaultLog
from diffdrive_jacobian.lockstep._injection import Injectable, Injections, check_injectable
from diffdrive_jacobian.lockstep._injection_base import World, full_name
from diffdrive_jacobian.lockstep._keeper import Keeper
from diffdrive_jacobian.lockstep._messaging import Messaging, described
from diffdrive_jacobian.lockstep._simulated_time import MAX_SECONDS
from diffdrive_jacobian.time_units import NANOSECONDS

N = TypeVar('N', bound=Node)


class Disturbed(Messaging):
    """Injection of faults. Base class of `Lockstep`."""

    def __init__(self, start: int) -> None:
        """Start at a time (ns)."""
        super().__init__(start)
        self._factories: dict[str, Callable[[], Node]] = {}
        self._observers: set[Node] = set()
        self._log = FaultLog(lambda: (self.world_time, self.now))
        self._injections: Injections | None = None

    def add(self, node: N, *, observer: bool = False) -> N:
        """Add a node."""
        raise NotImplementedError

    def _check_new(self, node: Node) -> None:
        """Raise LockstepError if a node cannot be added."""
        raise NotImplementedError

    def on_new_topics(self, callback: Callable[[], None]) -> None:
        """Call a function whenever a node is added, or has created or destroyed an entity."""
        raise NotImplementedError

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
        self._factories[node.get_fully_qualified_name()] = factory
        return node

    def find(self, name: str) -> Node:
        """Return the node that has a name now.

        Raises:
            LockstepError: There is none.
        """
        self._check_open()
        nodes = {node.get_fully_qualified_name(): node for node in self._executor.nodes}
        full = full_name(name, self.node)
        if full not in nodes:
            raise LockstepError(f'there is no node {full}; nodes: {", ".join(nodes)}')
        return nodes[full]

    def inject(self, *faults: Injectable, seed: int = 0) -> None:
        """Inject faults. Their times count from the start of this `Lockstep`.

        Faults of one topic affect a message in the order in which they were injected. The random numbers
        of a fault depend on `seed` and the fault alone, not on other faults, unless they are equal.

        Args:
            faults: The faults, see `diffdrive_jacobian.faults`.
            seed: Seed of their random numbers.

        Raises:
            LockstepError: An argument is no fault, or a fault is over already, or affects what nodes in
                other processes receive.
        """
        self._check_open()
        if not isinstance(seed, int) or isinstance(seed, bool):
            raise LockstepError(f'seed must be an integer, got {seed!r}')
        check_injectable(faults, self.world_time)
        self.settle()
        if self._injections is None:
            self._log.publisher = self.node.create_publisher(String, TOPIC, QoSProfile(depth=1000))
            # Recorders subscribe.
            self.settle()
            self._injections = Injections(self._world(), self._traffic)
            self.on_new_topics(self._injections.look)
        for fault in faults:
            self._check_receivers(fault)
            self._injections.add(fault, seed)
        self.settle()

    def _on_discovery(self) -> None:
        """Check that no fault affects what the discovered nodes receive."""
        for one in self._injections.all if self._injections is not None else ():
            self._check_receivers(one.fault)

    def _check_receivers(self, fault: Any) -> None:
        """Raise LockstepError if a fault affects the messages to a node in another process."""
        topic = getattr(fault, 'topic', '')
        if self._external is None or not topic or getattr(fault, 'at_publisher', False):
            return
        name = self.node.resolve_topic_name(topic)
        others = self._external.graph.subscribed_nodes(name)
        if fault.node:
            others &= {full_name(fault.node, self.node)}
        if others:
            raise LockstepError(
                f'{fault!r} cannot affect {", ".join(sorted(others))}: messages to other processes are '
                'not intercepted; give node= with the name of a node of this world'
            )

    def _world(self) -> World:
        self._observers.add(self.node)
        return World(
            executor=self._executor,
            keeper=Keeper(self._executor),
            node=self.node,
            log=self._log,
            observers=self._observers,
            shift_clock=self._shift_clock,
            restartable=self._factories.__contains__,
            restart=self._restart,
        )

    def _shift_clock(self, duration: int) -> int:
        """Shift the clock of the nodes by a time (ns). Return by how much it was shifted.

        The new time is one that a stamp can represent.
        """
        before = self._now
        self._now = min(max(1, before + duration), MAX_SECONDS * NANOSECONDS)
        self._executor.clocks.set(self._now)
        return self._now - before

    def _restart(self, name: str) -> None:
        """Make the node of a name again."""
        node = self._factories[name]()
        self._check_new(node)
        self._executor.add(node)
        if not self._executor.clock_pauses:
            self._executor.clocks.set(self._now)

    @property
    def fault_events(self) -> list[FaultEvent]:
        """What the injected faults did so far."""
        return self._injections.events() if self._injections is not None else []

    def report(self) -> str:
        """Return the last messages of all topics, and what faults did, as text."""
        text = super().report()
        return f'{text}\n{self._injections.describe()}' if self._injections is not None else text

    def check_faults(self) -> None:
        """Check that every injected fault met something that it could affect.

        Raises:
            LockstepError: One did not, for example because the name of its topic is misspelt.
        """
        if self._injections is not None and (ineffective := self._injections.ineffective()):
            raise IneffectiveFaultsError(ineffective, self._injections.missing())
