"""The faults of a world. The faults themselves are defined in `diffdrive_jacobian.faults`."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any, Protocol

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._fault_log import MAX_REPORTED, FaultEvent, in_seconds
from diffdrive_jacobian.lockstep._gated_reader import GatedReader, Stage
from diffdrive_jacobian.lockstep._gates import send_unless_destroyed
from diffdrive_jacobian.lockstep._injection_base import Timed, World
from diffdrive_jacobian.lockstep._node_injection import NodeInjection
from diffdrive_jacobian.lockstep._report import Traffic
from diffdrive_jacobian.lockstep._topic_injection import TopicInjection
from diffdrive_jacobian.time_units import NANOSECONDS


class Injection(TopicInjection, NodeInjection):
    """What one fault does to a world. A fault calls these methods in its method `install`."""


class Injectable(Timed, Protocol):
    """A fault."""

    def install(self, injection: Injection) -> None:
        """Schedule it."""


class Injections:
    """All faults of a world."""

    def __init__(self, world: World, traffic: Traffic) -> None:
        """Start without faults, and open all gates."""
        self._world = world
        self._traffic = traffic
        self._stages: dict[Publisher, list[Stage]] = {}
        self.all: list[Injection] = []
        """In the order of injection."""
        executor, keeper = world.executor, world.keeper
        executor.use(keeper)
        executor.deliveries.new_reader = self._reader
        executor.deliveries.replace(executor.nodes)
        traffic.intercept = self._intercept

    def add(self, fault: Injectable, seed: int) -> None:
        """Inject a fault."""
        same = sum(injection.fault == fault for injection in self.all)
        injection = Injection(self._world, fault, len(self.all), same, seed)
        fault.install(injection)
        self.all.append(injection)
        injection.schedule()
        for reader in self._world.executor.deliveries.readers():
            if isinstance(reader, GatedReader):
                injection.filter_reader(reader)
        for publisher, stages in self._stages.items():
            if (stage := injection.publisher_stage(self._owner(publisher), publisher)) is not None:
                stages.append(stage)

    def look(self) -> None:
        """Check which faults have met what they affect."""
        for injection in self.all:
            injection.look()

    def ineffective(self) -> list[str]:
        """Return descriptions of the faults that met nothing that they could affect."""
        return [text for injection in self.all if (text := injection.ineffective())]

    def missing(self) -> list[str]:
        """Return what these faults needed, as sentences."""
        return [injection.missing for injection in self.all if injection.missing]

    def events(self) -> list[FaultEvent]:
        """Return all events, also of the latest messages, of which there may be more."""
        log = self._world.log
        return [
            *log.events,
            *(log.event(one.fault, text) for one in self.all for text in one.unfinished()),
        ]

    def describe(self) -> str:
        """Return the faults and their latest events as text."""
        events = self.events()
        hidden = max(0, len(events) - MAX_REPORTED)
        return '\n'.join(
            [
                f'faults, {in_seconds(self._world.executor.agenda.now)} after the start:',
                *(f'  {one.fault!r}: {one.state()}' for one in self.all),
                f'events of faults{f", without the first {hidden}" if hidden else ""}:',
                *(f'  {event}' for event in events[hidden:]),
            ]
        )

    # --- In

    def _reader(self, subscription: Subscription, node: Node) -> GatedReader:
        reader = self._world.keeper.reader(subscription, node)
        for injection in self.all:
            injection.filter_reader(reader)
        return reader

    # --- Out

    def _intercept(self, publisher: Publisher, message: Any) -> bool:
        """Send a message of a node later, or another one. Return False if it can be sent now."""
        if publisher is self._world.log.publisher:
            return False
        gate = self._world.keeper.gates.running
        if gate is None and not self._stages_of(publisher):
            return False
        data = message if isinstance(message, bytes) else serialize_message(message)
        if gate is not None:
            gate.leave(partial(self._pass, publisher, 0, data))
        else:
            self._pass(publisher, 0, data)
        return True

    def _stages_of(self, publisher: Publisher) -> list[Stage]:
        if publisher not in self._stages:
            owner = self._owner(publisher)
            if owner is None:
                # Of a node that has not been added yet.
                return []
            found = [injection.publisher_stage(owner, publisher) for injection in self.all]
            self._stages[publisher] = [stage for stage in found if stage is not None]
        return self._stages[publisher]

    def _owner(self, publisher: Publisher) -> Node | None:
        nodes = self._world.executor.nodes
        return next((node for node in nodes if publisher in node.publishers), None)

    def _pass(self, publisher: Publisher, first: int, data: bytes) -> None:
        """Pass a message through the stages of its publisher from `first` on, and send it."""
        stages, agenda = self._stages_of(publisher), self._world.executor.agenda
        if first == len(stages):
            send_unless_destroyed(self._traffic.publish_now, publisher, data)
            return
        for delay, out in stages[first](data):
            if delay > 0:
                agenda.at(agenda.now + delay, partial(self._pass, publisher, first + 1, out))
            else:
                self._pass(publisher, first + 1, out)


def check_injectable(faults: Iterable[Any], now: int) -> None:
    """Check the arguments of `inject`.

    Raises:
        LockstepError: One is no fault, or over at the world time `now` (ns).
    """
    for fault in faults:
        if isinstance(fault, type) or not callable(getattr(fault, 'install', None)):
            raise LockstepError(f'inject takes faults, got {fault!r}')
        if fault.start + fault.duration <= now / NANOSECONDS:
            raise LockstepError(
                f'{fault!r} is over: {now / NANOSECONDS:g} s have passed since the start'
            )
