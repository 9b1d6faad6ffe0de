"""Faults in a lockstep world."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._fault_log import TOPIC, FaultEvent, FaultLog
from diffdrive_jacobian.lockstep._injection import Injectable, Injections, check_faults, full_name
from diffdrive_jacobian.lockstep._messaging import Messaging, described
from diffdrive_jacobian.time_units import NANOSECONDS

N = TypeVar('N', bound=Node)


class Disturbed(Messaging):
    """Injection of faults. Base class of `Lockstep`."""

    def __init__(self, start: int) -> None:
        """Start at a time (ns)."""
        super().__init__(start)
        self._factories: dict[str, Callable[[], Node]] = {}
        self._log = FaultLog(lambda: (self.world_time, self.now))
        self._injections: Injections | None = None

    def add(self, node: N) -> N:
        """Add a node."""
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
        if full_name(name) not in nodes:
            raise LockstepError(f'there is no node {full_name(name)}; nodes: {", ".join(nodes)}')
        return nodes[full_name(name)]

    def inject(self, *faults: Injectable, seed: int = 0) -> None:
        """Let faults happen. Their times count from the start of this `Lockstep`.

        Faults of one topic affect a message in the order in which they were injected. Random numbers of
        a fault depend on `seed`, the fault and its position alone.

        Args:
            faults: The faults, see `diffdrive_jacobian.testing.faults`.
            seed: Seed of their random numbers.

        Raises:
            LockstepError: An argument is no fault, or a fault is over already.
        """
        self._check_open()
        if not isinstance(seed, int) or isinstance(seed, bool):
            raise LockstepError(f'seed must be an integer, got {seed!r}')
        check_faults(faults)
        now = self.world_time / NANOSECONDS
        for fault in faults:
            if fault.start + fault.duration <= now:
                raise LockstepError(
                    f'{fault!r} is over: {now:g} s have passed since the start of the Lockstep'
                )
        self.settle()
        if self._injections is None:
            self._injections = Injections(self._executor, self._log, self.node)
            publisher = self.node.create_publisher(String, TOPIC, QoSProfile(depth=1000))
            self._log.publish = publisher.publish
            # Recorders subscribe.
            self.settle()
        for fault in faults:
            self._injections.add(fault, seed)
        self._injections.enable()
        self.settle()

    @property
    def fault_events(self) -> list[FaultEvent]:
        """What the injected faults did so far."""
        return self._log.events

    def check_faults(self) -> None:
        """Check that every injected fault met something that it could affect.

        Raises:
            LockstepError: One did not, for example because the name of its topic is misspelt.
        """
        if self._injections is not None and (ineffective := self._injections.ineffective()):
            raise LockstepError('faults without effect: ' + '; '.join(ineffective))
