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

"""The faults of a world. What each of them does is in `diffdrive_jacobian.faults`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from diffdrive_jacobian.lockstep._errors import IneffectiveFaultsError, LockstepError
from diffdrive_jacobian.lockstep._fault_log import MAX_REPORTED, FaultEvent, FaultLog
from diffdrive_jacobian.lockstep._injection import Fault, Injection, Undo
from diffdrive_jacobian.lockstep._nodes import Nodes
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.messages.topics import FAULT_EVENTS
from diffdrive_jacobian.time_units import NANOSECONDS, in_seconds


class Faults:
    """All faults of a world, and what they can do to it.

    Attributes:
        scheduler: Executes the nodes.
        node: Node of the test, which resolves names.
        observers: Nodes that are affected only by faults that name them.
        restartable: Returns whether the node of a name can be created again.
        restart: Creates the node of a name again.
        log: Keeps the events.
        shared: Lists that faults share, by name.
        faults: The faults that were injected.
    """

    def __init__(self, scheduler: Scheduler, nodes: Nodes, settle: Callable[[], None]) -> None:
        """Start without faults.

        Args:
            scheduler: Executes the nodes.
            nodes: The nodes of the world.
            settle: Executes all callbacks that are due.
        """
        self.scheduler, self.node, self.observers = scheduler, nodes.own, nodes.observers
        self.restartable, self.restart = nodes.restartable, nodes.restart
        self.log = FaultLog(lambda: (scheduler.agenda.now, scheduler.clocks.now))
        self.shared: defaultdict[str, list[Any]] = defaultdict(list)
        self.faults: list[Any] = []
        self._settle = settle
        self._when_nodes_change = nodes.on_change
        self._injections: list[Injection] = []

    def inject(self, faults: tuple[Fault, ...], seed: int) -> None:
        """Inject faults, as `Lockstep.inject`."""
        if not isinstance(seed, int) or isinstance(seed, bool):
            raise LockstepError(f'seed must be an integer, got {seed!r}')
        for fault in faults:
            _check(fault, self.scheduler.agenda.now)
        self._settle()
        if self.log.publisher is None:
            self.log.publisher = self.node.create_publisher(String, FAULT_EVENTS, QoSProfile(depth=1000))
            self.scheduler.links.unaffected.add(self.log.publisher)
            # Recorders subscribe.
            self._settle()
            self._when_nodes_change.append(self._look)
        for fault in faults:
            self._add(fault, seed)
        self._settle()
        self.faults.extend(faults)

    def _add(self, fault: Fault, seed: int) -> None:
        same = sum(injection.fault == fault for injection in self._injections)
        injection = Injection(self, fault, len(self._injections), same, seed)
        fault.install(injection)
        self._injections.append(injection)
        injection.schedule()
        self.scheduler.links.add_stages(injection.stage_of)

    def _look(self) -> None:
        """Check which faults have met what they affect."""
        for injection in self._injections:
            injection.look()

    def check(self) -> None:
        """Check that every fault met something that it could affect.

        Raises:
            IneffectiveFaultsError: One did not.
        """
        missing = [(one.fault, one.missing) for one in self._injections if one.missing]
        if missing:
            raise IneffectiveFaultsError(
                [f'{fault!r}: {what}' for fault, what in missing], [what for _, what in missing]
            )

    def events(self) -> list[FaultEvent]:
        """Return all events, also of the latest messages, of which there may be more."""
        log = self.log
        return [
            *log.events,
            *(log.event(one.fault, text) for one in self._injections for text in one.unfinished()),
        ]

    def describe(self) -> list[str]:
        """Return the faults and their latest events as lines of text."""
        if self.log.publisher is None:
            return []
        events = self.events()
        hidden = max(0, len(events) - MAX_REPORTED)
        return [
            f'faults, {in_seconds(self.scheduler.agenda.now)} after the start:',
            *(f'  {one.fault!r}: {one.state()}' for one in self._injections),
            *[f'events of faults{f", without the first {hidden}" if hidden else ""}:'] * bool(events),
            *(f'  {event}' for event in events[hidden:]),
        ]

    # --- What faults can do

    def find(self, name: str) -> Node | None:
        """Return the node that has a fully qualified name now; None: there is none."""
        nodes = self.scheduler.nodes
        return next((node for node in nodes if node.get_fully_qualified_name() == name), None)

    def kill(self, node: Node) -> None:
        """Remove and destroy a node at once."""
        self.scheduler.kill(node)

    def shift_clock(self, duration: int) -> int:
        """Shift the clock of the nodes (ns). Return the difference that was applied (ns)."""
        return self.scheduler.clocks.shift(duration)

    def pause_clock(self) -> Undo:
        """Stop the clock of the nodes. Return what lets it go on."""
        clocks = self.scheduler.clocks
        clocks.pauses += 1

        def go_on() -> None:
            clocks.pauses -= 1

        return go_on

    def delay_responses(self, service: str, late: int | None, note: Callable[[], None]) -> Undo:
        """Delay the responses of a service, as `Responses.delay`. Return what ends that."""
        return self.scheduler.responses.delay(service, late, note)


def _check(fault: Any, now: int) -> None:
    """Raise LockstepError if an argument of `inject` is no fault, or over at a world time (ns)."""
    if isinstance(fault, type) or not callable(getattr(fault, 'install', None)):
        raise LockstepError(f'inject takes faults, got {fault!r}')
    if fault.start + fault.duration <= now / NANOSECONDS:
        raise LockstepError(f'{fault!r} is over: {now / NANOSECONDS:g} s have passed since the start')
